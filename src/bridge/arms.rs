//! Which arms stand behind a bridge: the one place that makes drivers.

use std::sync::Arc;

use tandem_bridge::layout::mico_cell;
use tandem_bridge::service::{AnyDriver, Dial, Time};
use tandem_bridge::{DriverError, Executor, Settings};
use tandem_trials::simulated::Paced;
use tandem_trials::{SimulatedConfig, SimulatedPair};

use crate::cli::{BridgeServeArgs, DriverName};
use crate::exit::{Exit, Failed, OrExit as _};

/// How high above its workspace a simulated tool is at first, metres, and how far its gripper is open.
const READY_M: f64 = 0.05;
const READY_OPENING: f64 = 0.5;

/// What clients are told of the driver.
pub(crate) const fn name(driver: DriverName) -> &'static str {
    match driver {
        DriverName::Sim => "sim",
        DriverName::Quarc => "quarc",
        DriverName::KinovaRos => "kinova-ros",
    }
}

/// Connects to real arms at an address.
type Connect = fn(&str) -> Result<AnyDriver, DriverError>;

/// The arms that the command line asks for, behind what lets checked motions through only, and how to connect to them again.
/// Simulated arms do not lose their connection.
pub(crate) fn arms(
    args: &BridgeServeArgs,
    time: Arc<dyn Time>,
) -> Result<(Executor<AnyDriver>, Option<Dial>), Failed> {
    let (connect, settings) = match args.driver {
        DriverName::Sim => {
            let driver = simulated(args.seed, time)?;
            return Ok((executor(driver, Settings::default())?, None));
        }
        DriverName::Quarc => quarc()?,
        DriverName::KinovaRos => kinova_ros()?,
    };
    let address = args.arms_at.clone().unwrap_or_default();
    let dial: Dial = Arc::new(move || connect(&address));
    let driver = dial().or_exit(Exit::TryAgain, String::new)?;
    Ok((executor(driver, settings)?, Some(dial)))
}

fn executor(driver: AnyDriver, settings: Settings) -> Result<Executor<AnyDriver>, Failed> {
    Executor::new(mico_cell(), driver, settings).or_exit(Exit::Bug, String::new)
}

/// A simulated pair in real time, its tools above their workspaces.
fn simulated(seed: u64, time: Arc<dyn Time>) -> Result<AnyDriver, Failed> {
    let cell = mico_cell();
    let at = cell.ready(READY_M).or_exit(Exit::Bug, String::new)?;
    let config = SimulatedConfig { seed, ..SimulatedConfig::default() };
    let pair = SimulatedPair::new(cell, &at, READY_OPENING, config);
    Ok(Box::new(Paced::new(pair, time)))
}

/// Arms behind a Simulink model.
fn quarc() -> Result<(Connect, Settings), Failed> {
    use tandem_bridge::quarc::{QuarcConfig, QuarcDriver};
    fn connect(address: &str) -> Result<AnyDriver, DriverError> {
        Ok(Box::new(QuarcDriver::connect(QuarcConfig::at(address))?))
    }
    Ok((connect, Settings::default()))
}

/// Arms behind Kinova's ROS driver.
fn kinova_ros() -> Result<(Connect, Settings), Failed> {
    use tandem_bridge::kinova_ros::{KinovaRosConfig, KinovaRosDriver, settings};
    fn connect(address: &str) -> Result<AnyDriver, DriverError> {
        Ok(Box::new(KinovaRosDriver::connect(KinovaRosConfig::at(address))?))
    }
    Ok((connect, settings()))
}
