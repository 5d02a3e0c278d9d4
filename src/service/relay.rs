//! `tandem relay`.

use super::learner::learner_failed;
use super::{listen, run};
use crate::cli::RelayArgs;
use crate::exit::Failed;
use crate::{access, metrics, signals};

pub(crate) fn relay(args: RelayArgs) -> Result<(), Failed> {
    let own = metrics::of_process("relay");
    let server_config =
        access::server_config(&args.listen, &args.secret)?.with_metrics(own.clone());
    let client_config =
        access::client_config(&args.client_config, &args.secret)?.with_metrics(own.clone());
    run(async move {
        let shutdown = signals::shutdown_token(args.listen.exit_with_stdin)?;
        metrics::serve(&args.metrics, &own).await?;
        let listener = listen(&args.listen).await?;
        let relayed = tandem_learner::relay::serve(
            &args.connect,
            &client_config,
            &server_config,
            listener,
            shutdown,
        )
        .await;
        relayed.map_err(learner_failed)
    })
}
