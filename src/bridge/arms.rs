//! The arms of a bridge. Only this module creates drivers.

use std::sync::Arc;

use tandem_bridge::service::{BoxDriver, Clock, Reconnect};
use tandem_bridge::work_cell::mico_cell;
use tandem_bridge::{DriverError, Executor, Settings};
use tandem_trials::simulated::RealTimePair;
use tandem_trials::{SimulatedConfig, SimulatedPair};

use crate::cli::{BridgeServeArgs, DriverName};
use crate::exit::{Exit, Failed, OrExit as _};

/// Initial height of a simulated tool above its workspace, metres.
const READY_M: f64 = 0.05;
/// Initial opening of a simulated gripper, 0 to 1.
const READY_OPENING: f64 = 0.5;

/// Returns the name of the driver that clients see.
pub(crate) const fn name(driver: DriverName) -> &'static str {
    match driver {
        DriverName::Sim => "sim",
        DriverName::Quarc => "quarc",
        DriverName::KinovaRos => "kinova-ros",
    }
}

/// Returns the limits and deadlines of the arms behind a driver.
pub(crate) fn settings(driver: DriverName) -> Settings {
    match driver {
        DriverName::Sim | DriverName::Quarc => Settings::default(),
        DriverName::KinovaRos => tandem_bridge::kinova_ros::settings(),
    }
}

/// Connects to the real arms at an address.
type Connect = fn(&str) -> Result<BoxDriver, DriverError>;

/// Creates the executor of the arms and, for real arms, a function that reconnects to them.
pub(crate) fn arms(
    args: &BridgeServeArgs,
    clock: Arc<dyn Clock>,
) -> Result<(Executor<BoxDriver>, Option<Reconnect>), Failed> {
    let settings = settings(args.driver);
    let connect = match args.driver {
        DriverName::Sim => {
            let driver = simulated(args.seed, clock)?;
            return Ok((executor(driver, settings)?, None));
        }
        DriverName::Quarc => quarc(),
        DriverName::KinovaRos => kinova_ros(),
    };
    let address = args.arms_at.clone().unwrap_or_default();
    let reconnect: Reconnect = Arc::new(move || connect(&address));
    let driver = reconnect().or_exit(Exit::TryAgain, String::new)?;
    Ok((executor(driver, settings)?, Some(reconnect)))
}

fn executor(driver: BoxDriver, settings: Settings) -> Result<Executor<BoxDriver>, Failed> {
    Executor::new(mico_cell(), driver, settings).or_exit(Exit::Bug, String::new)
}

/// Creates a simulated pair in real time, with its tools above their workspaces.
fn simulated(seed: u64, clock: Arc<dyn Clock>) -> Result<BoxDriver, Failed> {
    let cell = mico_cell();
    let at = cell.ready(READY_M).or_exit(Exit::Bug, String::new)?;
    let config = SimulatedConfig { seed, ..SimulatedConfig::default() };
    let pair = SimulatedPair::new(cell, &at, READY_OPENING, config);
    Ok(Box::new(RealTimePair::new(pair, clock)))
}

/// Returns how to connect to arms behind a Simulink model.
fn quarc() -> Connect {
    use tandem_bridge::quarc::{QuarcConfig, QuarcDriver};
    fn connect(address: &str) -> Result<BoxDriver, DriverError> {
        Ok(Box::new(QuarcDriver::connect(QuarcConfig::at(address))?))
    }
    connect
}

/// Returns how to connect to arms behind Kinova's ROS driver.
fn kinova_ros() -> Connect {
    use tandem_bridge::kinova_ros::{KinovaRosConfig, KinovaRosDriver};
    fn connect(address: &str) -> Result<BoxDriver, DriverError> {
        Ok(Box::new(KinovaRosDriver::connect(KinovaRosConfig::at(address))?))
    }
    connect
}
