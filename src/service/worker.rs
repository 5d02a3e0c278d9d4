//! `tandem worker`.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use tandem_net::{HealthReporter, Metrics, Pacing, ServerConfig};
use tandem_worker::{Error, Liveness, RecordedEpisodes, RecordingConfig, WorkerConfig};
use tokio_util::sync::CancellationToken;
use tonic::server::NamedService;
use tonic::{Code, Status};

use super::{bind, run};
use crate::cli::{ListenArgs, RecordedName, RecordingArgs, WorkerArgs};
use crate::environment_server::EnvironmentSource;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{access, metrics, signals};

/// The time that one step of the environments may take before the worker is no longer serving. It takes milliseconds.
const STEP_LIMIT: Duration = Duration::from_secs(60);
/// The interval at which the health of a worker is determined.
const HEALTH_INTERVAL: Duration = Duration::from_secs(1);

pub(crate) fn worker(args: WorkerArgs) -> Result<(), Failed> {
    if matches!(args.recording.record, RecordedName::All) && args.log_dir.is_none() {
        return Err(Failed::usage(
            "--record all needs --log-dir, the directory of the recorded episodes",
        ));
    }
    let own = metrics::of_process("worker");
    let client_config =
        access::client_config(&args.client_config, &args.secret)?.with_metrics(own.clone());
    let health = match args.listen {
        Some(address) => Some(HealthServer::new(address, &args, &own)?),
        None => None,
    };
    run(async move {
        let shutdown = signals::shutdown_token(args.exit_with_stdin)?;
        metrics::serve(&args.metrics, &own).await?;
        let server = EnvironmentSource::of(&args.environment, &client_config)?;
        let liveness = Liveness::default();
        if let Some(health) = health {
            health.start(liveness.clone(), own).await?;
        }
        let config = WorkerConfig {
            client: client_config,
            environment: server.config(),
            learner: args.connect,
            teacher: args.teacher,
            name: args.name,
            recording: recording(&args.recording, args.log_dir),
            pacing: Pacing::Concurrent,
            liveness,
        };
        let ended = tandem_worker::run(config, shutdown.clone()).await;
        server.end().await;
        ended.map_err(worker_failed)?;
        // A supervisor tells the end of the run, 0, from that of this worker alone.
        match shutdown.is_cancelled() && !args.exit_with_stdin {
            true => Err(Failed::new(Exit::Interrupted, anyhow::anyhow!("interrupted"))),
            false => Ok(()),
        }
    })
}

/// The name of the worker in health checks.
struct WorkerService;

impl NamedService for WorkerService {
    const NAME: &'static str = "tandem.v1.Worker";
}

/// The server of a worker's health.
struct HealthServer {
    listen: ListenArgs,
    config: ServerConfig,
}

impl HealthServer {
    /// Prepares a server at `address`, with the worker's token.
    fn new(address: SocketAddr, args: &WorkerArgs, metrics: &Metrics) -> Result<Self, Failed> {
        let listen = ListenArgs::plain(address);
        let config = access::server_config(&listen, &args.secret)?.with_metrics(metrics.clone());
        Ok(Self { listen, config })
    }

    /// Binds the address, prints it, and serves until the process ends.
    async fn start(self, liveness: Liveness, metrics: Metrics) -> Result<(), Failed> {
        let bound = bind(&self.listen).await?;
        let router = self.config.health_router::<WorkerService>().await;
        let (router, health) = router.or_exit(Exit::Bug, String::new)?;
        let incoming = bound.announce("");
        tokio::spawn(async move {
            let served = tandem_net::serve(router, incoming, CancellationToken::new()).await;
            if let Err(error) = served {
                let error = anyhow::Error::from(error);
                tracing::warn!("health checks are no longer answered: {error:#}");
            }
        });
        tokio::spawn(report_health(health, liveness, metrics));
        Ok(())
    }
}

/// Keeps setting the health according to the progress of rollouts.
async fn report_health(health: HealthReporter, liveness: Liveness, metrics: Metrics) {
    let mut was_alive = true;
    loop {
        tokio::time::sleep(HEALTH_INTERVAL).await;
        let since = liveness.computing_since();
        let is_alive = since.is_none_or(|since| metrics.now().saturating_sub(since) < STEP_LIMIT);
        if is_alive != was_alive {
            was_alive = is_alive;
            match is_alive {
                true => tracing::info!("the rollout makes progress again: serving"),
                false => tracing::error!(
                    limit_s = STEP_LIMIT.as_secs(),
                    "the rollout hangs in one step: no longer serving"
                ),
            }
            health.set_serving(is_alive).await;
        }
    }
}

/// Returns the recording of episodes in `directory`.
fn recording(args: &RecordingArgs, directory: Option<PathBuf>) -> Option<RecordingConfig> {
    let episodes = match args.record {
        RecordedName::None => return None,
        RecordedName::Evaluation => RecordedEpisodes::Evaluation,
        RecordedName::All => RecordedEpisodes::All,
    };
    let budget_bytes = args.log_budget.0;
    Some(RecordingConfig { directory: directory?, episodes, budget_bytes })
}

pub(crate) fn worker_failed(error: Error) -> Failed {
    use Error as E;
    let exit = match error {
        E::Address { .. }
        | E::NoTeacher { .. }
        | E::NoEnvironment(_)
        | E::NotBuiltIn { .. }
        | E::OtherTask { .. }
        | E::TooFewEnvironments { .. } => Exit::Usage,
        E::EnvironmentRefused { ref status, .. } if is_configuration(status) => Exit::Usage,
        E::InvalidReply { .. } | E::EpisodeLost { .. } | E::EnvironmentRefused { .. } => Exit::Data,
        E::Rollout { .. } | E::World(_) | E::Panicked(_) | E::NoAccount { .. } | E::NoServer => {
            Exit::Bug
        }
        E::EnvironmentFailed { .. } | E::Protocol { .. } | E::Parameters { .. } | E::Thread(_) => {
            Exit::TryAgain
        }
    };
    let error = anyhow::Error::from(error);
    match configuration_problem(&error) {
        Some(problem) => Failed::usage(format!("{error}: {problem}")),
        None => Failed::new(exit, error),
    }
}

/// Returns the message of a peer that requires another token or is another service.
fn configuration_problem(error: &anyhow::Error) -> Option<&str> {
    let mut statuses = error.chain().filter_map(|cause| cause.downcast_ref::<Status>());
    statuses.find(|status| is_configuration(status)).map(Status::message)
}

/// Returns true if a peer requires another token or is another service.
fn is_configuration(status: &Status) -> bool {
    matches!(status.code(), Code::Unauthenticated | Code::Unimplemented)
}
