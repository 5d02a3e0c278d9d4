//! `tandem learner`.

use std::net::SocketAddr;
use std::num::NonZero;
use std::path::PathBuf;
use std::time::Duration;

use tandem_dashboard::{Access, Site};
use tandem_learner::checkpoint::CheckpointError;
use tandem_learner::{Error, LearnerConfig, LingerPolicy, ServeOptions};
use tandem_net::Pacing;
use tandem_telemetry::RunView;
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio_util::sync::{CancellationToken, DropGuard};

use super::resume_command::interrupted;
use super::{listen, run};
use crate::cli::LearnerArgs;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::run_pages::RunPages;
use crate::version::VERSION;
use crate::{
    access, clock, dashboard, metrics, output, policy_file, run_directory, run_file, signals,
};

pub(crate) fn learner(args: LearnerArgs) -> Result<(), Failed> {
    let mut run_config = run_file::resolve(Some(&args.run), &[])?;
    // A run file that is missing or cannot be read is reported when the run starts.
    if (args.resume || args.start_or_resume)
        && let Ok(existing) = run_file::resolve(Some(&args.out.join("run.toml")), &[])
    {
        run_file::keep_interval(&mut run_config, &existing);
    }
    // With --out-is-locked the parent process has written the run file.
    if args.resume && !args.out_is_locked && !args.out.join("run.toml").exists() {
        let out = args.out.display();
        return Err(run_directory::no_run(&format!(
            "{out} holds no run to resume (--start-or-resume begins one)"
        )));
    }
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
        let (page, views) = dashboard(&args).await?;
        let options = ServeOptions { views, ..serve_options(&args).await? };
        let listener = listen(&args.listen).await?;
        let unix_start_ms = clock::unix_millis();
        let serving_page = page.map(|page| page.serve(args.dashboard_is_optional));
        let config = LearnerConfig {
            run: run_config,
            server_config,
            client_config,
            teacher: args.teacher.clone(),
            start_from,
            out: args.out.clone(),
            resume: args.resume || args.start_or_resume,
            out_is_locked: args.out_is_locked,
            run_file,
            n_threads: args.threads.map_or_else(default_threads, usize::from),
            clock: clock::since_now(),
            unix_start: Duration::from_millis(unix_start_ms),
            version: VERSION.to_owned(),
            first_worker: unix_start_ms << 12,
            pacing: Pacing::Concurrent,
        };
        let served = tandem_learner::serve_with(config, listener, shutdown, options).await;
        drop(serving_page);
        let ended = served.map_err(learner_failed)?;
        if let Some((config, out)) = pages_of
            && let Err(failed) = RunPages::write_if_evaluated(&config, &out)
        {
            tracing::warn!(reason = %failed.line(), "the report of the run cannot be written");
        }
        match ended.interrupted {
            true => Err(interrupted(&args)),
            false => Ok(()),
        }
    })
}

/// Returns the number of threads of the update: the number of cores, up to the tasks of a step of an update.
fn default_threads() -> usize {
    const MAX_THREADS: usize = 16;
    std::thread::available_parallelism().map_or(1, NonZero::get).min(MAX_THREADS)
}

/// A bound dashboard.
struct Page {
    bound: Result<(TcpListener, SocketAddr), std::io::Error>,
    access: Access,
    views: watch::Receiver<RunView>,
}

impl Page {
    /// Serves the dashboard until the returned value is dropped. If `prints` is set, prints the outcome as a line of
    /// standard output.
    fn serve(self, prints: bool) -> DropGuard {
        let stop = CancellationToken::new();
        let line = match &self.bound {
            Ok((_, address)) => format!("dashboard on {}", dashboard::url(*address)),
            Err(error) => format!("no dashboard: {error}"),
        };
        if prints && let Err(failed) = output::print(&line) {
            tracing::warn!("cannot print {line:?}: {:#}", failed.into_error());
        }
        tracing::info!("{line}");
        if let Ok((listener, _)) = self.bound {
            let site = Site::of_run(self.views);
            drop(tokio::spawn(dashboard::serve(site, self.access, listener, stop.clone())));
        }
        stop.drop_guard()
    }
}

/// Binds the address of the dashboard, if there is one, and returns the sender of its data.
async fn dashboard(
    args: &LearnerArgs,
) -> Result<(Option<Page>, Option<watch::Sender<RunView>>), Failed> {
    let Some(address) = args.dashboard_listen else { return Ok((None, None)) };
    let token_file = args.dashboard_token_file.as_ref().or(args.secret.token_file.as_ref());
    let insecure = args.listen.insecure;
    let token_file = token_file.map(PathBuf::as_path);
    let access = dashboard::access("--dashboard-listen", address, token_file, insecure)?;
    let bound = match args.dashboard_is_optional {
        true => dashboard::bind_free(address).await,
        false => {
            let cannot = || format!("cannot listen on {address} for --dashboard-listen");
            Ok(TcpListener::bind(address).await.or_exit(Exit::TryAgain, cannot)?)
        }
    };
    let bound = bound.and_then(|listener| {
        let address = listener.local_addr()?;
        Ok((listener, address))
    });
    let (sender, views) = watch::channel(RunView::default());
    Ok((Some(Page { bound, access, views }), Some(sender)))
}

/// Returns the options of the service, and binds the address of the metrics, if there is one.
async fn serve_options(args: &LearnerArgs) -> Result<ServeOptions, Failed> {
    let metrics = metrics::listen(&args.metrics).await?;
    let linger = if args.stay { LingerPolicy::UntilShutdown } else { LingerPolicy::default() };
    Ok(ServeOptions { metrics, linger, views: None })
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
        | Error::NetworksTooLarge { .. }
        | Error::SlotTooLarge { .. }
        | Error::Checkpoint(
            CheckpointError::OtherSettings { .. }
            | CheckpointError::RunExists(_)
            | CheckpointError::Config(_),
        ) => Exit::Usage,
        Error::Checkpoint(_) => Exit::Data,
        Error::RunDirectory { .. }
        | Error::Unwritten { .. }
        | Error::Thread(_)
        | Error::Serve(_) => Exit::TryAgain,
        Error::ServerConfig(_) | Error::Address(_) => Exit::Usage,
        Error::Diverged(_) | Error::Panicked => Exit::Bug,
    };
    Failed::new(exit, error)
}
