//! Which arms stand behind a bridge: the one place that makes drivers.

use std::sync::Arc;

use tandem_bridge::layout::mico_cell;
use tandem_bridge::service::{AnyDriver, Paced, Time};
use tandem_bridge::{Executor, Settings, SimulatedConfig, SimulatedPair};

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

/// The arms that the command line asks for, behind what lets checked motions through only.
pub(crate) fn executor(
    args: &BridgeServeArgs,
    time: Arc<dyn Time>,
) -> Result<Executor<AnyDriver>, Failed> {
    let address = args.arms_at.as_deref().unwrap_or_default();
    let (driver, settings) = match args.driver {
        DriverName::Sim => (simulated(args.seed, time)?, Settings::default()),
        DriverName::Quarc => quarc(address)?,
        DriverName::KinovaRos => kinova_ros(address)?,
    };
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
#[cfg(feature = "quarc")]
fn quarc(address: &str) -> Result<(AnyDriver, Settings), Failed> {
    use tandem_bridge::quarc::{QuarcConfig, QuarcDriver};
    let driver = QuarcDriver::connect(QuarcConfig::at(address));
    Ok((Box::new(driver.or_exit(Exit::TryAgain, String::new)?), Settings::default()))
}

#[cfg(not(feature = "quarc"))]
fn quarc(_: &str) -> Result<(AnyDriver, Settings), Failed> {
    Err(not_built("quarc"))
}

/// Arms behind Kinova's ROS driver.
#[cfg(feature = "kinova-ros")]
fn kinova_ros(address: &str) -> Result<(AnyDriver, Settings), Failed> {
    use tandem_bridge::kinova_ros::{KinovaRosConfig, KinovaRosDriver, settings};
    let driver = KinovaRosDriver::connect(KinovaRosConfig::at(address));
    Ok((Box::new(driver.or_exit(Exit::TryAgain, String::new)?), settings()))
}

#[cfg(not(feature = "kinova-ros"))]
fn kinova_ros(_: &str) -> Result<(AnyDriver, Settings), Failed> {
    Err(not_built("kinova-ros"))
}

#[cfg(not(all(feature = "quarc", feature = "kinova-ros")))]
fn not_built(feature: &str) -> Failed {
    Failed::usage(format!(
        "this program was built without the driver {feature}: build it with --features {feature}"
    ))
}
