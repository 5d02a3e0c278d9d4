//! `tandem worker`.

use std::path::PathBuf;

use tandem_net::Pacing;
use tandem_worker::{Error, RecordedEpisodes, RecordingConfig, WorkerConfig};
use tonic::{Code, Status};

use super::run;
use crate::cli::{RecordedName, RecordingArgs, WorkerArgs};
use crate::environment_server::EnvironmentSource;
use crate::exit::{Exit, Failed};
use crate::{access, metrics, signals};

pub(crate) fn worker(args: WorkerArgs) -> Result<(), Failed> {
    if matches!(args.recording.record, RecordedName::All) && args.log_dir.is_none() {
        return Err(Failed::usage(
            "--record all needs --log-dir, the directory of the recorded episodes",
        ));
    }
    let own = metrics::of_process("worker");
    let client_config =
        access::client_config(&args.client_config, &args.secret)?.with_metrics(own.clone());
    run(async move {
        let shutdown = signals::shutdown_token(args.exit_with_stdin)?;
        metrics::serve(&args.metrics, &own).await?;
        let server = EnvironmentSource::of(&args.environment, &client_config)?;
        let config = WorkerConfig {
            client: client_config,
            environment: server.config(),
            learner: args.connect,
            teacher: args.teacher,
            name: args.name,
            recording: recording(&args.recording, args.log_dir),
            pacing: Pacing::Concurrent,
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
