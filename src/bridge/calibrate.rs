//! `tandem bridge calibrate`: measures how fast the arms react, and writes the times into their cell file.

use std::path::Path;
use std::sync::Arc;

use anyhow::anyhow;
use serde_json::json;
use tandem_bridge::calibration::{CalibrationError, JointTiming, Operator, calibrate as measure};
use tandem_bridge::cell_file::{ArmTiming, CellFile, with_timings};
use tandem_system::atomic_file;
use tokio_util::sync::CancellationToken;

use super::cell::{self, Cell};
use super::first_day::{confirm, report_interruption};
use super::{arms, priority, runtime};
use crate::cli::{CalibrateArgs, DriverName};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{clock, output, signals};

pub(super) fn calibrate(args: CalibrateArgs) -> Result<(), Failed> {
    arms::check_address(&args.arms)?;
    let Some(path) = args.arms.cell.clone() else {
        return Err(Failed::usage("--cell FILE is missing: write one with `tandem bridge cell`"));
    };
    let cell = Cell::load(Some(&path))?;
    if args.arms.driver != DriverName::Sim {
        let question = "Every joint of both arms turns by some degrees and back. A person must watch them with a hand \
                        on the emergency stop, and their way must be clear";
        // Nothing handles Ctrl-C yet, so that it ends the process.
        confirm(args.confirmation.yes, question, "yes", &CancellationToken::new())?;
    }
    let runtime = runtime().or_exit(Exit::TryAgain, String::new)?;
    let names: Vec<String> = cell.file.arms.iter().map(|arm| arm.name.clone()).collect();
    let json = args.confirmation.json;
    let measured = runtime.block_on(async move {
        let interrupted = signals::shutdown_token(false)?;
        let measuring =
            tokio::task::spawn_blocking(move || measure_arms(&args, &cell, &interrupted));
        measuring.await.or_exit(Exit::Bug, String::new)?
    })?;
    save(&path, &names, &measured)?;
    if json {
        let arm = |(name, timing): (&String, &ArmTiming)| {
            json!({
                "name": name, "lag_s": timing.lag_s, "reaction_s": timing.reaction_s,
                "brake_s": timing.brake_s,
            })
        };
        let arms: Vec<_> = names.iter().zip(&measured).map(arm).collect();
        return output::print(json!({"cell_file": path.display().to_string(), "arms": arms}));
    }
    for (name, timing) in names.iter().zip(&measured) {
        output::print(format_args!("{name}: {}", times(timing)))?;
    }
    output::print(format_args!("written to {}", path.display()))
}

/// Writes the times of the arms called `names` into the cell file, which may have been edited during the measurement.
fn save(path: &Path, names: &[String], measured: &[ArmTiming]) -> Result<(), Failed> {
    let is_unchanged = || {
        let arms = names.iter().zip(measured);
        let arms: Vec<_> =
            arms.map(|(name, timing)| format!("{name}: {}", times(timing))).collect();
        format!("{path:?} is unchanged; measured {}", arms.join("; "))
    };
    let text = cell::text(path).map_err(|failed| failed.context(is_unchanged()))?;
    let present = CellFile::parse(&text).or_exit(Exit::Data, is_unchanged)?;
    if !present.arms.iter().map(|arm| &arm.name).eq(names) {
        let other = anyhow!("the file has been edited and has other arms");
        return Err(Failed::new(Exit::Data, other).context(is_unchanged()));
    }
    let text = with_timings(&text, measured).or_exit(Exit::Data, is_unchanged)?;
    let written = atomic_file::replace(path, text.as_bytes());
    written.or_cannot_write(|| format!("cannot write {}", path.display()))
}

fn measure_arms(
    args: &CalibrateArgs,
    cell: &Cell,
    interrupted: &CancellationToken,
) -> Result<Vec<ArmTiming>, Failed> {
    let settings = cell.settings(args.arms.driver);
    let clock = Arc::new(clock::BridgeClock::new());
    let (driver, ..) = arms::connect(&args.arms, cell, &settings, clock.clone())?;
    if args.arms.driver == DriverName::Sim {
        priority::raise_if_permitted();
    } else {
        priority::raise();
    }
    let mut report = |joint: JointTiming| {
        let name = &cell.file.arms[joint.arm.0].name;
        let line =
            format_args!("tandem: {name}, joint {}: {}", joint.joint + 1, times(&joint.timing));
        output::message(line);
    };
    let work_cell = cell.file.work_cell();
    let is_interrupted = || interrupted.is_cancelled();
    let operator =
        Operator { clock: &*clock, report: &mut report, is_interrupted: &is_interrupted };
    measure(&work_cell, driver, settings, args.speed, operator).map_err(measuring_failed)
}

fn measuring_failed(error: CalibrationError) -> Failed {
    use CalibrationError as E;
    let exit = match &error {
        E::Interrupted => Exit::Interrupted,
        E::StopUnconfirmed(Some(first)) if **first == E::Interrupted => Exit::Interrupted,
        E::Setting(_) => Exit::Data,
        _ => Exit::TryAgain,
    };
    if exit == Exit::Interrupted {
        report_interruption(&error, error == E::Interrupted);
    }
    Failed::new(exit, anyhow::Error::new(error).context("the cell file is unchanged"))
}

fn times(timing: &ArmTiming) -> String {
    let [lag, reaction, brake] = [timing.lag_s, timing.reaction_s, timing.brake_s].map(|s| 1e3 * s);
    format!("lag {lag:.1} ms, reaction {reaction:.1} ms, brake {brake:.1} ms")
}

#[cfg(test)]
mod tests {
    use tandem_bridge::cell_file::DEFAULT_TEXT;

    use super::*;

    #[test]
    fn an_interruption_is_one_even_if_the_stop_is_not_confirmed() {
        use CalibrationError as E;
        let unconfirmed = |first: E| E::StopUnconfirmed(Some(Box::new(first)));
        let interrupted = measuring_failed(unconfirmed(E::Interrupted));
        assert_eq!(interrupted.exit(), Exit::Interrupted);
        assert!(interrupted.line().contains("interrupted; the arms have not confirmed"));
        let failed = measuring_failed(E::StopUnconfirmed(None));
        assert_eq!(failed.exit(), Exit::TryAgain);
        assert!(failed.line().ends_with("within 1 s: use the emergency stop"), "{}", failed.line());
    }

    #[test]
    fn edits_during_the_measurement_are_kept() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("cell.toml");
        let names: Vec<_> =
            CellFile::parse(DEFAULT_TEXT).unwrap().arms.into_iter().map(|arm| arm.name).collect();
        let measured =
            [0.021, 0.022].map(|lag_s| ArmTiming { lag_s, reaction_s: 0.03, brake_s: 0.2 });

        let edited = format!("{DEFAULT_TEXT}\n# The left base was measured again.\n");
        std::fs::write(&path, &edited).unwrap();
        save(&path, &names, &measured).unwrap();
        let saved = std::fs::read_to_string(&path).unwrap();
        assert!(saved.contains("measured again"), "{saved}");
        assert!(saved.contains("lag_s = 0.021") && saved.contains("lag_s = 0.022"), "{saved}");

        let exchanged: Vec<_> = names.iter().rev().cloned().collect();
        let refused = save(&path, &exchanged, &measured).unwrap_err().line();
        assert!(refused.contains("other arms") && refused.contains("lag 22.0 ms"), "{refused}");
        assert_eq!(std::fs::read_to_string(&path).unwrap(), saved);
    }
}
