//! `tandem learner`.

use std::time::Duration;

use tandem_learner::checkpoint::CheckpointError;
use tandem_learner::{Error, LearnerConfig, LingerPolicy, ServeOptions};
use tandem_net::Pacing;

use super::{listen, run};
use crate::cli::LearnerArgs;
use crate::exit::{Exit, Failed};
use crate::run_pages::RunPages;
use crate::version::VERSION;
use crate::{access, clock, metrics, policy_file, run_directory, run_file, signals};

pub(crate) fn learner(args: LearnerArgs) -> Result<(), Failed> {
    let run_config = run_file::resolve(Some(&args.run), &[])?;
    let start_from = args.start_from.as_deref().map(policy_file::load).transpose()?;
    let own = metrics::of_process("learner");
    let server_config =
        access::server_config(&args.listen, &args.secret)?.with_metrics(own.clone());
    let client_config =
        access::client_config(&args.client_config, &args.secret)?.with_metrics(own.clone());
    run_directory::check_path(&args.out)?;
    // With --out-is-locked the parent process writes the run file.
    let keeps_run_file = !args.out_is_locked || args.keep_run_file;
    let run_file = keeps_run_file.then(|| run_file::to_text(&run_config)).transpose()?;
    // `tandem train` writes the pages of its runs itself.
    let pages_of = (!args.out_is_locked).then(|| (run_config.clone(), args.out.clone()));
    run(async move {
        let shutdown = signals::shutdown_token(args.listen.exit_with_stdin)?;
        let options = serve_options(&args).await?;
        let listener = listen(&args.listen).await?;
        let unix_start_ms = clock::unix_millis();
        let config = LearnerConfig {
            run: run_config,
            server_config,
            client_config,
            teacher: args.teacher,
            start_from,
            out: args.out,
            resume: args.resume || args.start_or_resume,
            out_is_locked: args.out_is_locked,
            run_file,
            n_threads: usize::from(args.threads),
            clock: clock::since_now(),
            unix_start: Duration::from_millis(unix_start_ms),
            version: VERSION.to_owned(),
            first_worker: unix_start_ms << 12,
            pacing: Pacing::Concurrent,
        };
        let served = tandem_learner::serve_with(config, listener, shutdown, options).await;
        let ended = served.map_err(learner_failed)?;
        if let Some((config, out)) = pages_of
            && let Err(failed) = RunPages::write_if_evaluated(&config, &out)
        {
            tracing::warn!(reason = %failed.line(), "the report of the run cannot be written");
        }
        match ended.interrupted {
            true => Err(Failed::new(Exit::Interrupted, anyhow::anyhow!(ended.reason))),
            false => Ok(()),
        }
    })
}

/// Returns the options of the service, and binds the address of the metrics, if there is one.
async fn serve_options(args: &LearnerArgs) -> Result<ServeOptions, Failed> {
    let metrics = metrics::listen(&args.metrics).await?;
    let linger = if args.stay { LingerPolicy::UntilShutdown } else { LingerPolicy::default() };
    Ok(ServeOptions { metrics, linger })
}

/// Chooses the exit code of an error of a learner or a relay.
pub(super) fn learner_failed(error: Error) -> Failed {
    if let error @ (Error::RunDirectory { .. } | Error::Checkpoint(CheckpointError::Io { .. })) =
        error
    {
        return Failed::of_write(error);
    }
    let exit = match error {
        Error::Config(_)
        | Error::NoTeacher(_)
        | Error::Teacher(_)
        | Error::StartFrom(_)
        | Error::Checkpoint(CheckpointError::OtherSettings { .. }) => Exit::Usage,
        Error::Checkpoint(_) => Exit::Data,
        Error::RunDirectory { .. } | Error::Serve(_) => Exit::TryAgain,
        Error::ServerConfig(_) | Error::Address(_) => Exit::Usage,
        Error::Diverged(_) | Error::Panicked => Exit::Bug,
    };
    Failed::new(exit, error)
}
