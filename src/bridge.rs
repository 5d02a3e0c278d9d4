//! `tandem bridge`: serves a pair of arms, and operates it.

use std::fs::File;
use std::io::Read as _;
use std::sync::Arc;

use anyhow::Context as _;
use tandem_bridge::service::{Bridge, Config, Error};
use tokio::runtime::{Builder, Runtime};

use self::arms::Arms;
use self::cell::Cell;
use crate::cli::{BridgeArgs, BridgeCommand, BridgeServeArgs, DriverName};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::version::VERSION;
use crate::{access, clock, metrics, service, signals};

mod arms;
mod calibrate;
mod cell;
mod file;
mod first_day;
mod inject;
mod model;
mod operator;
mod play;
mod priority;
mod show;
mod trial;
mod view;
mod watch;

/// The system's source of random secrets.
const ENTROPY: &str = "/dev/urandom";
/// Number of threads for sockets.
const SOCKET_THREADS: usize = 2;

pub(crate) fn bridge(args: BridgeArgs) -> Result<(), Failed> {
    match args.command {
        None => serve(args.serve),
        Some(BridgeCommand::Status(args)) => operator::status(&args),
        Some(BridgeCommand::Stop(args)) => operator::stop(&args),
        Some(BridgeCommand::Describe(args)) => operator::describe(&args),
        Some(BridgeCommand::Reset(args)) => operator::reset(&args),
        Some(BridgeCommand::Move(args)) => play::play(&args),
        Some(BridgeCommand::Cell(args)) => cell::cell(&args),
        Some(BridgeCommand::Arms(args)) => model::serve(&args),
        Some(BridgeCommand::Calibrate(args)) => calibrate::calibrate(args),
        Some(BridgeCommand::Home(args)) => first_day::home(args),
        Some(BridgeCommand::ToStart(args)) => first_day::to_start(args),
        Some(BridgeCommand::Inject(args)) => inject::inject(&args),
        Some(BridgeCommand::Trial(args)) => trial::trial(&args),
    }
}

fn serve(args: BridgeServeArgs) -> Result<(), Failed> {
    arms::check_address(&args.arms)?;
    let cell = Cell::load(args.arms.cell.as_deref())?;
    cell.require_measured(args.arms.driver, args.accept_defaults)?;
    let own = metrics::of_process("bridge");
    let server_config =
        access::server_config(&args.listen, &args.secret)?.with_metrics(own.clone());
    let secret = secret().or_exit(Exit::TryAgain, || format!("cannot read {ENTROPY}"))?;
    let live = watch::live(&args, cell.file.arms.len())?;
    let runtime = runtime().or_exit(Exit::TryAgain, String::new)?;
    runtime.block_on(async move {
        let shutdown = signals::shutdown_token(args.listen.exit_with_stdin)?;
        let clock = Arc::new(clock::BridgeClock::new());
        metrics::serve(&args.metrics, &own).await?;
        let plan = watch::Plan::of(&args, &cell, &server_config, live).await?;
        let bound = service::bind(&args.listen).await?;
        // Last, because a bridge that fails after it has connected stops arms that another one may move.
        let arms = Arms::connect(&args.arms, &cell, clock.clone())?;
        let listener = bound.announce("");
        let config = Config {
            driver: arms::name(args.arms.driver).to_owned(),
            version: VERSION.to_owned(),
            speed: args.speed,
            clock,
            reconnect: arms.reconnect,
            timings: cell.file.timings(&arms::default_settings(args.arms.driver)),
            cell: cell.file,
            cell_name: cell.name,
            injector: arms.injector,
            prepare_thread: Some(match args.arms.driver {
                DriverName::Sim => priority::raise_if_permitted,
                DriverName::Quarc | DriverName::KinovaRos => priority::raise,
            }),
            secret,
        };
        let injector = config.injector.clone();
        let (observer, snapshots) = plan.observer();
        let bridge =
            Bridge::start(arms.executor, config, observer, &shutdown).map_err(bridge_failed)?;
        let watching = plan.start(&args, &bridge.operator(), injector, snapshots)?;
        let served = bridge.serve(listener, &server_config).await;
        watching.finish();
        served.map_err(bridge_failed)
    })
}

/// Creates a runtime with several threads, so that a stop is handled while a long motion is decoded.
fn runtime() -> anyhow::Result<Runtime> {
    let mut runtime = Builder::new_multi_thread();
    runtime.worker_threads(SOCKET_THREADS).enable_all().build().context("cannot start the runtime")
}

/// Returns a secret that cannot be guessed.
fn secret() -> std::io::Result<[u8; 32]> {
    let mut secret = [0; 32];
    File::open(ENTROPY)?.read_exact(&mut secret)?;
    Ok(secret)
}

fn bridge_failed(error: Error) -> Failed {
    let exit = match &error {
        Error::Panicked => Exit::Bug,
        Error::ServerConfig(_) => Exit::Usage,
        _ => Exit::TryAgain,
    };
    Failed::new(exit, error)
}
