//! The arms of a bridge. Only this module creates drivers.

use std::sync::Arc;

use tandem_bridge::layout::mico_cell;
use tandem_bridge::service::{AnyDriver, Dial, Paced, Time};
use tandem_bridge::{DriverError, Executor, Settings, SimulatedConfig, SimulatedPair};

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

/// Connects to real arms at an address.
type Connect = fn(&str) -> Result<AnyDriver, DriverError>;

/// Creates the executor of the arms and, for real arms, a function that reconnects to them.
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

/// Creates a simulated pair in real time, with its tools above their workspaces.
fn simulated(seed: u64, time: Arc<dyn Time>) -> Result<AnyDriver, Failed> {
    let cell = mico_cell();
    let at = cell.ready(READY_M).or_exit(Exit::Bug, String::new)?;
    let config = SimulatedConfig { seed, ..SimulatedConfig::default() };
    let pair = SimulatedPair::new(cell, &at, READY_OPENING, config);
    Ok(Box::new(Paced::new(pair, time)))
}

/// Returns how to connect to arms behind a Simulink model.
fn quarc() -> Result<(Connect, Settings), Failed> {
    use tandem_bridge::quarc::{QuarcConfig, QuarcDriver};
    fn connect(address: &str) -> Result<AnyDriver, DriverError> {
        Ok(Box::new(QuarcDriver::connect(QuarcConfig::at(address))?))
    }
    Ok((connect, Settings::default()))
}

/// Returns how to connect to arms behind Kinova's ROS driver.
fn kinova_ros() -> Result<(Connect, Settings), Failed> {
    use tandem_bridge::kinova_ros::{KinovaRosConfig, KinovaRosDriver, settings};
    fn connect(address: &str) -> Result<AnyDriver, DriverError> {
        Ok(Box::new(KinovaRosDriver::connect(KinovaRosConfig::at(address))?))
    }
    Ok((connect, settings()))
}
