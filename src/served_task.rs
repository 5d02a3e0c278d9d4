//! The task of a server of environments, as the settings of a run.

use tandem_core::TaskSpec;
use tandem_net::ClientConfig;
use tandem_worker::ServedTask;
use toml::Value;

use crate::cli::EnvironmentArgs;
use crate::environment_server::EnvironmentSource;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::runtime;
use crate::service::worker_failed;

/// Starts the server if it is a command, and asks it for its task. Returns `None` if the options name no server.
pub(crate) fn of_server(args: &EnvironmentArgs) -> Result<Option<ServedTask>, Failed> {
    let runtime = runtime::new().or_exit(Exit::TryAgain, String::new)?;
    runtime.block_on(async {
        let source = EnvironmentSource::of(args, &ClientConfig::default())?;
        let served = source.served_task().await;
        source.end().await;
        served.map_err(worker_failed)
    })
}

/// Returns the settings of a run for a task, unless the task is built-in.
pub(crate) fn settings(task: &TaskSpec) -> Result<Vec<(String, Value)>, Failed> {
    if task.as_built_in().is_some() {
        return Ok(Vec::new());
    }
    let description = Value::try_from(task.description()).or_exit(Exit::Bug, String::new)?;
    let n_arms = i64::try_from(task.n_arms()).unwrap_or(i64::MAX);
    let settings = [
        ("task", Value::String(task.name().to_owned())),
        ("arms", Value::Integer(n_arms)),
        ("description", description),
    ];
    Ok(settings.map(|(key, value)| (key.to_owned(), value)).into())
}
