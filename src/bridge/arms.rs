//! Creates the driver of the arms that a bridge serves.

use std::sync::Arc;

use tandem_bridge::service::{BoxDriver, Clock, Reconnect};
use tandem_bridge::work_cell::mico_cell;
use tandem_bridge::{DriverError, Executor, Settings};
use tandem_trials::simulated::RealTimePair;
use tandem_trials::{SimulatedConfig, SimulatedPair};

use crate::cli::{BridgeServeArgs, DriverName};
use crate::exit::{Exit, Failed, OrExit as _};

/// The initial height of a simulated tool above its workspace, metres, and the initial opening of its gripper.
const READY_M: f64 = 0.05;
const READY_OPENING: f64 = 0.5;

/// The name of the driver for clients.
pub(crate) const fn name(driver: DriverName) -> &'static str {
    match driver {
        DriverName::Sim => "sim",
        DriverName::Quarc => "quarc",
        DriverName::KinovaRos => "kinova-ros",
    }
}

/// Connects to the real arms at an address.
type Connect = fn(&str) -> Result<BoxDriver, DriverError>;

/// Returns an executor for the arms that the command line names, and the function that connects to them again.
/// Simulated arms do not lose their connection.
pub(crate) fn arms(
    args: &BridgeServeArgs,
    clock: Arc<dyn Clock>,
) -> Result<(Executor<BoxDriver>, Option<Reconnect>), Failed> {
    let (connect, settings) = match args.driver {
        DriverName::Sim => {
            let driver = simulated(args.seed, clock)?;
            return Ok((executor(driver, Settings::default())?, None));
        }
        DriverName::Quarc => quarc()?,
        DriverName::KinovaRos => kinova_ros()?,
    };
    let address = args.arms_at.clone().unwrap_or_default();
    let reconnect: Reconnect = Arc::new(move || connect(&address));
    let driver = reconnect().or_exit(Exit::TryAgain, String::new)?;
    Ok((executor(driver, settings)?, Some(reconnect)))
}

fn executor(driver: BoxDriver, settings: Settings) -> Result<Executor<BoxDriver>, Failed> {
    Executor::new(mico_cell(), driver, settings).or_exit(Exit::Bug, String::new)
}

/// Creates a simulated pair in real time, its tools above their workspaces.
fn simulated(seed: u64, clock: Arc<dyn Clock>) -> Result<BoxDriver, Failed> {
    let cell = mico_cell();
    let at = cell.ready(READY_M).or_exit(Exit::Bug, String::new)?;
    let config = SimulatedConfig { seed, ..SimulatedConfig::default() };
    let pair = SimulatedPair::new(cell, &at, READY_OPENING, config);
    Ok(Box::new(RealTimePair::new(pair, clock)))
}

/// Arms behind a Simulink model.
fn quarc() -> Result<(Connect, Settings), Failed> {
    use tandem_bridge::quarc::{QuarcConfig, QuarcDriver};
    fn connect(address: &str) -> Result<BoxDriver, DriverError> {
        Ok(Box::new(QuarcDriver::connect(QuarcConfig::at(address))?))
    }
    Ok((connect, Settings::default()))
}

/// Arms behind Kinova's ROS driver.
fn kinova_ros() -> Result<(Connect, Settings), Failed> {
    use tandem_bridge::kinova_ros::{KinovaRosConfig, KinovaRosDriver, settings};
    fn connect(address: &str) -> Result<BoxDriver, DriverError> {
        Ok(Box::new(KinovaRosDriver::connect(KinovaRosConfig::at(address))?))
    }
    Ok((connect, settings()))
}
