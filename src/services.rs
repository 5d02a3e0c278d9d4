//! The services as subcommands: bind, say where, serve until asked to end.

use std::ffi::OsString;
use std::future::Future;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use tandem_learner::checkpoint::CheckpointError;
use tandem_learner::{Error as LearnerError, LingerPolicy, ServeOptions};
use tandem_net::{Capacity, Incoming, Pacing};
use tandem_system::fd_limit;
use tandem_teacher::Advisor;
use tandem_teacher::ledger::SqliteLedger;
use tandem_teacher::policy::OneArmPolicy;
use tandem_telemetry::logging::{LevelFilter, LogConfig};
use tokio::net::TcpListener;
use tokio::runtime::{Builder, Runtime};
use tokio_util::sync::CancellationToken;

use crate::cli::{Cli, Command, LearnerArgs, ListenArgs, RelayArgs, TeacherArgs, WorkerArgs};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{access, clock, output, run_directory, run_file, signals};

/// Version and commit of this program.
pub(crate) const VERSION: &str = env!("TANDEM_VERSION");

/// Sends log lines to standard error: of services from `info` up, of everything else warnings.
pub(crate) fn start_logging(cli: &Cli) -> Result<(), Failed> {
    let level = match &cli.command {
        Command::Teacher(_) | Command::Learner(_) | Command::Worker(_) | Command::Relay(_) => {
            LevelFilter::INFO
        }
        Command::Bridge(args) if args.command.is_none() => LevelFilter::INFO,
        _ => LevelFilter::WARN,
    };
    let directives = cli.log.clone().or_else(rust_log);
    let config = LogConfig { console: Some(level), file: None, directives };
    tandem_telemetry::logging::init(&config).or_exit(Exit::Usage, String::new)
}

#[expect(clippy::disallowed_methods, reason = "RUST_LOG is read here, before anything is logged")]
fn rust_log() -> Option<String> {
    std::env::var("RUST_LOG").ok().filter(|filter| !filter.is_empty())
}

pub(crate) fn teacher(args: TeacherArgs) -> Result<(), Failed> {
    crate::files::load_policy(&args.policy)?;
    let gate = access::gate(&args.listen, &args.secret)?;
    run(async move {
        let shutdown = shutdown(args.listen.exit_with_stdin)?;
        let advisor = advisor(args.policy, args.ledger).map_err(teacher_failed)?;
        let listener = listen(&args.listen).await?;
        let served =
            tandem_teacher::serve_advisor(advisor, listener, &gate, shutdown, Pacing::Concurrent)
                .await;
        served.map_err(teacher_failed)
    })
}

/// The teacher's policy with its ledger; a ledger whose name is not UTF-8 can only be a file.
fn advisor(policy: PathBuf, ledger: OsString) -> Result<Advisor, tandem_teacher::Error> {
    match ledger.into_string() {
        Ok(ledger) => tandem_teacher::open(&tandem_teacher::Config { policy, ledger }),
        Err(file) => {
            let policy = OneArmPolicy::load(&policy)?;
            Advisor::new(Box::new(policy), Box::new(SqliteLedger::open(Path::new(&file))?))
        }
    }
}

pub(crate) fn learner(args: LearnerArgs) -> Result<(), Failed> {
    let run_config = run_file::resolve(Some(&args.run), &[])?;
    let start_from = args.start_from.as_deref().map(crate::files::load_policy).transpose()?;
    let gate = access::gate(&args.listen, &args.secret)?;
    let dial = access::dial(&args.dial, &args.secret)?;
    run_directory::check_place(&args.out)?;
    let keeps_run_file = args.start_or_resume || args.keep_run_file;
    let run_file = keeps_run_file.then(|| run_file::to_text(&run_config)).transpose()?;
    run(async move {
        let shutdown = shutdown(args.listen.exit_with_stdin)?;
        let options = serve_options(&args).await?;
        let listener = listen(&args.listen).await?;
        let config = tandem_learner::LearnerConfig {
            run: run_config,
            gate,
            dial,
            teacher: args.teacher,
            start_from,
            out: args.out,
            resume: args.resume || args.start_or_resume,
            out_is_locked: args.out_is_locked,
            run_file,
            n_threads: usize::from(args.threads),
            clock: clock::since_now(),
            version: VERSION.to_owned(),
            first_worker: clock::unix_millis() << 12,
            pacing: Pacing::Concurrent,
        };
        let served = tandem_learner::serve_with(config, listener, shutdown, options).await;
        let ended = served.map_err(learner_failed)?;
        if ended.interrupted {
            Err(Failed::new(Exit::Interrupted, anyhow::anyhow!(ended.reason)))
        } else {
            Ok(())
        }
    })
}

/// Returns the options of the service that the command line asks for.
async fn serve_options(args: &LearnerArgs) -> Result<ServeOptions, Failed> {
    let metrics = match args.metrics_listen {
        Some(address) => {
            let bound = TcpListener::bind(address).await;
            let cannot = || format!("cannot listen on {address} for --metrics-listen");
            Some(bound.or_exit(Exit::TryAgain, cannot)?)
        }
        None => None,
    };
    if let Some(Ok(address)) = metrics.as_ref().map(TcpListener::local_addr) {
        tracing::info!(%address, "figures for Prometheus, without a token");
    }
    let linger = if args.stay { LingerPolicy::UntilShutdown } else { LingerPolicy::default() };
    Ok(ServeOptions { metrics, linger })
}

pub(crate) fn worker(args: WorkerArgs) -> Result<(), Failed> {
    let dial = access::dial(&args.dial, &args.secret)?;
    run(async move {
        let shutdown = shutdown(args.exit_with_stdin)?;
        let config = tandem_worker::WorkerConfig {
            dial,
            learner: args.connect,
            teacher: args.teacher,
            name: args.name,
            log_dir: args.log_dir,
            pacing: Pacing::Concurrent,
        };
        tandem_worker::run(config, shutdown).await.map_err(worker_failed)
    })
}

pub(crate) fn relay(args: RelayArgs) -> Result<(), Failed> {
    let gate = access::gate(&args.listen, &args.secret)?;
    let dial = access::dial(&args.dial, &args.secret)?;
    run(async move {
        let shutdown = shutdown(args.listen.exit_with_stdin)?;
        let listener = listen(&args.listen).await?;
        let relayed =
            tandem_learner::relay::serve(&args.connect, &dial, &gate, listener, shutdown).await;
        relayed.map_err(learner_failed)
    })
}

/// A runtime for sockets; whatever computes has threads of its own.
pub(crate) fn runtime() -> anyhow::Result<Runtime> {
    Builder::new_current_thread().enable_all().build().context("cannot start the runtime")
}

fn run(service: impl Future<Output = Result<(), Failed>>) -> Result<(), Failed> {
    fd_limit::raise();
    runtime().or_exit(Exit::TryAgain, String::new)?.block_on(service)
}

pub(crate) fn shutdown(exit_with_stdin: bool) -> Result<CancellationToken, Failed> {
    signals::shutdown_token(exit_with_stdin)
        .or_exit(Exit::TryAgain, || "cannot watch for signals".to_owned())
}

/// Binds and prints the address, on one line of standard output. A service whose line cannot be written serves all the
/// same. It keeps as many connections as the process may have open files.
pub(crate) async fn listen(args: &ListenArgs) -> Result<Incoming, Failed> {
    let capacity = Capacity::for_open_files(fd_limit::raise());
    let bind = async {
        let listener = TcpListener::bind(args.listen).await?;
        let address: SocketAddr = listener.local_addr()?;
        Ok::<_, std::io::Error>((listener, address))
    };
    let (listener, address) =
        bind.await.or_exit(Exit::TryAgain, || format!("cannot listen on {}", args.listen))?;
    if let Err(failed) = output::print(format_args!("listening on {address}")) {
        let error = failed.into_error();
        tracing::warn!(%address, "the address is not on standard output: {error:#}");
    }
    Ok(Incoming::from(listener).with_capacity(capacity))
}

pub(crate) fn teacher_failed(error: tandem_teacher::Error) -> Failed {
    use tandem_teacher::Error as E;
    use tandem_teacher::ledger::OpenError;
    let exit = match &error {
        E::OpenLedger(OpenError::InvalidLocation(_) | OpenError::BadPath { .. }) => Exit::Usage,
        E::OpenLedger(OpenError::InUse(_) | OpenError::Io { .. } | OpenError::Server { .. }) => {
            Exit::TryAgain
        }
        E::Transport(_) | E::Thread(_) => Exit::TryAgain,
        E::Panicked => Exit::Bug,
        _ => Exit::Data,
    };
    Failed::new(exit, error)
}

fn worker_failed(error: tandem_worker::Error) -> Failed {
    use tandem_worker::Error as E;
    let exit = match error {
        E::Address { .. } | E::NoTeacher { .. } => Exit::Usage,
        E::Rollout { .. } | E::World(_) | E::Panicked(_) | E::NoAccount { .. } => Exit::Bug,
        E::Protocol { .. } | E::Parameters { .. } | E::LogDir { .. } | E::Thread(_) => {
            Exit::TryAgain
        }
    };
    let error = anyhow::Error::from(error);
    match misdirected(&error) {
        Some(told) => Failed::usage(format!("{error}: {told}")),
        None => Failed::new(exit, error),
    }
}

/// What to do when a peer wants another token or is another service, if that is what went wrong.
fn misdirected(error: &anyhow::Error) -> Option<&str> {
    use tonic::Code;
    let mut statuses = error.chain().filter_map(|cause| cause.downcast_ref::<tonic::Status>());
    let is_final = |code| matches!(code, Code::Unauthenticated | Code::Unimplemented);
    let status = statuses.find(|status| is_final(status.code()));
    status.map(tonic::Status::message)
}

fn learner_failed(error: LearnerError) -> Failed {
    if let error @ (LearnerError::RunDirectory { .. }
    | LearnerError::Checkpoint(CheckpointError::Io { .. })) = error
    {
        return Failed::of_write(error);
    }
    let exit = match error {
        LearnerError::Config(_)
        | LearnerError::NoTeacher(_)
        | LearnerError::Teacher(_)
        | LearnerError::StartFrom(_)
        | LearnerError::Checkpoint(CheckpointError::OtherSettings { .. }) => Exit::Usage,
        LearnerError::Checkpoint(_) => Exit::Data,
        LearnerError::RunDirectory { .. } | LearnerError::Serve(_) => Exit::TryAgain,
        LearnerError::Gate(_) | LearnerError::Address(_) => Exit::Usage,
        LearnerError::Diverged(_) | LearnerError::Panicked => Exit::Bug,
    };
    Failed::new(exit, error)
}
