//! `tandem bridge home` and `tandem bridge to-start`: what arms need before their first motion.

use std::fmt::Display;
use std::io::{BufRead as _, IsTerminal as _};
use std::sync::Arc;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::Duration;

use anyhow::anyhow;
use serde_json::json;
use tandem_bridge::kinova_ros::{self, HomingError, KinovaRosConfig};
use tandem_bridge::service::BoxDriver;
use tandem_bridge::to_start::{Operator, ToStartError, to_start as move_to_start};
use tandem_kinematics::Motion;
use tandem_trials::simulated::RealTimePair;
use tokio_util::sync::CancellationToken;

use super::cell::Cell;
use super::{arms, priority, runtime};
use crate::cli::{DriverName, HomeArgs, ToStartArgs};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{clock, output, signals};

/// Homes arms behind kinova-ros, one after the other.
pub(super) fn home(args: HomeArgs) -> Result<(), Failed> {
    if args.arms.driver != DriverName::KinovaRos {
        return Err(Failed::usage(
            "only arms behind --driver kinova-ros are homed: simulated arms need no homing, and a Simulink model homes \
             its arms itself",
        ));
    }
    arms::check_address(&args.arms)?;
    let cell = Cell::load(args.arms.cell.as_deref())?;
    let names: Vec<String> = cell.file.arms.iter().map(|arm| arm.name.clone()).collect();
    let chosen = chosen_arms(args.arm.as_deref(), &names)?;
    let json = args.confirmation.json;
    let homed = block_on(move |interrupted| {
        let config = KinovaRosConfig {
            address: args.arms.arms_at.clone().unwrap_or_default(),
            ..arms::kinova_ros_config(&cell.file)?
        };
        chosen.into_iter().try_fold(Vec::new(), |mut homed, arm| {
            let name = &names[arm];
            let question = format!(
                "{name}: its node moves the arm along a path of its own and opens the gripper; only the emergency stop \
                 ends it. Nothing is near the arm or in its gripper"
            );
            confirm(args.confirmation.yes, &question, name, interrupted)?;
            output::message(format_args!("tandem: homing {name}"));
            home_arm(&config, arm, interrupted).map_err(|error| homing_failed(name, &error))?;
            homed.push(name.clone());
            Ok(homed)
        })
    })?;
    if json {
        return output::print(json!({"homed": homed}));
    }
    homed.iter().try_for_each(|name| output::print(format_args!("{name}: homed and stopped")))
}

fn home_arm(
    config: &KinovaRosConfig,
    arm: usize,
    interrupted: &CancellationToken,
) -> Result<(), HomingError> {
    let clock = clock::BridgeClock::new();
    kinova_ros::home(config, arm, &clock, &|| interrupted.is_cancelled())
}

fn homing_failed(name: &str, error: &HomingError) -> Failed {
    let exit = match error {
        HomingError::Interrupted => Exit::Interrupted,
        _ => Exit::TryAgain,
    };
    if exit == Exit::Interrupted {
        output::message(format_args!("tandem: {name}: {error}"));
    }
    Failed::new(exit, anyhow!("{name} is not homed: {error}"))
}

/// Returns the indices of the arms to home.
fn chosen_arms(wanted: Option<&str>, names: &[String]) -> Result<Vec<usize>, Failed> {
    let Some(wanted) = wanted else { return Ok((0..names.len()).collect()) };
    let found = names.iter().position(|name| name == wanted);
    found.map(|arm| vec![arm]).ok_or_else(|| {
        Failed::usage(format!("--arm {wanted:?}: the arms are {}", names.join(" and ")))
    })
}

/// Moves the arms slowly to their start posture.
pub(super) fn to_start(args: ToStartArgs) -> Result<(), Failed> {
    arms::check_address(&args.arms)?;
    let cell = Cell::load(args.arms.cell.as_deref())?;
    if args.arms.driver != DriverName::Sim {
        cell.require_places()?;
        let question = "Both arms move slowly to their start posture. A person must watch them with a hand on the \
                        emergency stop, and their way must be clear";
        // Nothing handles Ctrl-C yet, so that it ends the process.
        confirm(args.confirmation.yes, question, "yes", &CancellationToken::new())?;
    }
    let json = args.confirmation.json;
    block_on(move |interrupted| move_arms(&args, &cell, interrupted))?;
    if json {
        return output::print(json!({"at_start": true}));
    }
    output::print("the arms are at their start posture and stopped")
}

fn move_arms(
    args: &ToStartArgs,
    cell: &Cell,
    interrupted: &CancellationToken,
) -> Result<(), Failed> {
    let settings = cell.settings(args.arms.driver);
    let work_cell = cell.file.work_cell();
    let start = arms::start_posture(&work_cell)?;
    let clock = Arc::new(clock::BridgeClock::new());
    let driver: BoxDriver = if args.arms.driver == DriverName::Sim {
        priority::raise_if_permitted();
        Box::new(RealTimePair::new(arms::raised(args.arms.seed, &cell.file), clock.clone()))
    } else {
        priority::raise();
        arms::connect(&args.arms, cell, &settings, clock.clone())?.0
    };
    let mut announce = |motion: &Motion| {
        let seconds = motion.duration_s();
        output::message(format_args!(
            "tandem: {seconds:.0} s to the start posture; Ctrl-C stops the arms"
        ));
    };
    let mut told_s = 0.0;
    let mut report = |progress: tandem_bridge::Progress| {
        if progress.played_s >= told_s + 5.0 {
            told_s = progress.played_s;
            let (played_s, duration_s) = (progress.played_s, progress.duration_s);
            output::message(format_args!("tandem: {played_s:.0} of {duration_s:.0} s"));
        }
    };
    let operator = Operator {
        clock: &*clock,
        announce: &mut announce,
        report: &mut report,
        is_interrupted: &|| interrupted.is_cancelled(),
    };
    move_to_start(&work_cell, driver, settings, &start, operator).map_err(to_start_failed)
}

fn to_start_failed(error: ToStartError) -> Failed {
    use ToStartError as E;
    let exit = match &error {
        E::Interrupted => Exit::Interrupted,
        E::StopUnconfirmed(Some(first)) if **first == E::Interrupted => Exit::Interrupted,
        E::Setting(_) | E::NoWay(_) => Exit::Data,
        _ => Exit::TryAgain,
    };
    if exit == Exit::Interrupted {
        report_interruption(&error, error == E::Interrupted);
    }
    let place = match &error {
        E::StopUnconfirmed(None) => "the arms are at their start",
        _ => "the arms are not at their start",
    };
    Failed::new(exit, anyhow::Error::new(error).context(place))
}

/// Reports the interruption of a command that has moved the arms: the program prints no error that ends in one.
pub(super) fn report_interruption(error: &impl Display, is_stopped: bool) {
    let arms = if is_stopped { ": the arms are stopped" } else { "" };
    output::message(format_args!("tandem: {error}{arms}"));
}

/// Runs `work` on a thread of its own, with a token that is cancelled by Ctrl-C and SIGTERM.
fn block_on<T: Send + 'static>(
    work: impl FnOnce(&CancellationToken) -> Result<T, Failed> + Send + 'static,
) -> Result<T, Failed> {
    let runtime = runtime().or_exit(Exit::TryAgain, String::new)?;
    runtime.block_on(async move {
        let interrupted = signals::shutdown_token(false)?;
        let working = tokio::task::spawn_blocking(move || work(&interrupted));
        working.await.or_exit(Exit::Bug, String::new)?
    })
}

/// Asks the operator to type `answer`, unless that was done on the command line.
pub(super) fn confirm(
    is_given: bool,
    question: &str,
    answer: &str,
    interrupted: &CancellationToken,
) -> Result<(), Failed> {
    if is_given {
        return Ok(());
    }
    if !std::io::stdin().is_terminal() {
        return Err(Failed::usage(format!("{question}: confirm with --yes")));
    }
    output::message(format_args!("{question}.\nType {answer:?} to begin:"));
    let line = read_line(interrupted)?;
    let line = line.or_exit(Exit::TryAgain, || "cannot read the answer".to_owned())?;
    if line.trim() == answer { Ok(()) } else { Err(Failed::usage("not confirmed: nothing moved")) }
}

/// Reads a line that the operator types. Returns an error once `interrupted` is cancelled.
fn read_line(interrupted: &CancellationToken) -> Result<std::io::Result<String>, Failed> {
    let (sender, lines) = mpsc::sync_channel(1);
    // Nothing interrupts a read, so another thread reads. It ends with the process.
    std::thread::spawn(move || {
        let mut line = String::new();
        let read = std::io::stdin().lock().read_line(&mut line);
        sender.send(read.map(|_n_bytes| line)).ok();
    });
    loop {
        match lines.recv_timeout(Duration::from_millis(50)) {
            Ok(read) => return Ok(read),
            Err(RecvTimeoutError::Disconnected) => return Ok(Ok(String::new())),
            Err(RecvTimeoutError::Timeout) if interrupted.is_cancelled() => {
                let nothing_moves = "interrupted: nothing moves";
                output::message(format_args!("tandem: {nothing_moves}"));
                return Err(Failed::new(Exit::Interrupted, anyhow!(nothing_moves)));
            }
            Err(RecvTimeoutError::Timeout) => {}
        }
    }
}
