//! `tandem relay`.

use super::learner::learner_failed;
use super::{listen, run};
use crate::cli::RelayArgs;
use crate::exit::Failed;
use crate::{access, signals};

pub(crate) fn relay(args: RelayArgs) -> Result<(), Failed> {
    let server_config = access::server_config(&args.listen, &args.secret)?;
    let client_config = access::client_config(&args.client_config, &args.secret)?;
    run(async move {
        let shutdown = signals::shutdown_token(args.listen.exit_with_stdin)?;
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
