//! `tandem env`.

use tandem_core::Layout;
use tandem_environment::{Config, Error};

use super::listen::listen_with_scheme;
use super::run;
use crate::cli::EnvArgs;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::version::VERSION;
use crate::{access, metrics, output, signals};

pub(crate) fn environment(args: EnvArgs) -> Result<(), Failed> {
    let layout = Layout::new(args.task.in_named_world(args.world)?, usize::from(args.arms));
    let (task, n_arms) = (layout.task, layout.n_arms);
    if n_arms < task.min_arms() {
        return Err(Failed::usage(format!("--arms {n_arms}: {task} takes {}", task.min_arms())));
    }
    if args.describe {
        let described = serde_json::to_string(&layout.description());
        return output::print(described.or_exit(Exit::Bug, String::new)?);
    }
    let own = metrics::of_process("environment");
    let server_config =
        access::server_config(&args.listen, &args.secret)?.with_metrics(own.clone());
    run(async move {
        let shutdown = signals::shutdown_token(args.listen.exit_with_stdin)?;
        metrics::serve(&args.metrics, &own).await?;
        let listener = listen_with_scheme(&args.listen).await?;
        let config = Config {
            layout,
            max_environments: usize::from(args.max_environments),
            server: format!("tandem {VERSION}"),
        };
        let served = tandem_environment::serve(config, listener, &server_config, shutdown).await;
        served.map_err(environment_failed)
    })
}

/// Chooses the exit code of an error of the service.
fn environment_failed(error: Error) -> Failed {
    let exit = match error {
        Error::World(_) | Error::ServerConfig(_) => Exit::Usage,
        Error::Transport(_) => Exit::TryAgain,
    };
    Failed::new(exit, error)
}
