//! The arms of a bridge. Only this module creates drivers.

use std::sync::Arc;

use tandem_bridge::cell_file::CellFile;
use tandem_bridge::injection::Injector;
use tandem_bridge::kinova_ros::{Efforts, KinovaArm, KinovaRosConfig, KinovaRosDriver};
use tandem_bridge::quarc::{QuarcConfig, QuarcDriver};
use tandem_bridge::service::{BoxDriver, Clock, Reconnect};
use tandem_bridge::{DriverError, Executor, Settings};
use tandem_kinematics::{Joints, WorkCell};
use tandem_trials::simulated::{Drill, RealTimePair};
use tandem_trials::{SimulatedConfig, SimulatedPair};

use super::cell::Cell;
use crate::cli::{ArmsArgs, DriverName};
use crate::exit::{Exit, Failed, OrExit as _};

/// Initial height of a simulated tool above its workspace, metres.
const READY_M: f64 = 0.05;
/// Time constant of the mean that is subtracted from the efforts of kinova-ros, seconds.
const TORQUE_MEAN_S: f64 = 0.4;
/// Joint angles of raised simulated arms, degrees.
const RAISED_DEGREES: [f64; 4] = [20.0, 180.0, 250.0, 180.0];
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

/// Returns the limits and deadlines of arms behind a driver, before a measurement.
pub(super) fn default_settings(driver: DriverName) -> Settings {
    match driver {
        DriverName::Sim | DriverName::Quarc => Settings::default(),
        DriverName::KinovaRos => tandem_bridge::kinova_ros::settings(),
    }
}

/// Connects to the real arms at an address.
type Connect = Box<dyn Fn(&str) -> Result<BoxDriver, DriverError> + Send + Sync>;

/// Arms and what their service needs.
pub(super) struct Arms {
    pub(super) executor: Executor<BoxDriver>,
    /// Reconnects to real arms.
    pub(super) reconnect: Option<Reconnect>,
    /// Injects faults into simulated arms.
    pub(super) injector: Option<Injector>,
}

impl Arms {
    /// Connects to the arms and creates their executor.
    pub(super) fn connect(
        args: &ArmsArgs,
        cell: &Cell,
        clock: Arc<dyn Clock>,
    ) -> Result<Self, Failed> {
        let settings = cell.settings(args.driver);
        let (driver, reconnect, injector) = connect(args, cell, &settings, clock)?;
        let executor = Executor::new(cell.file.work_cell(), driver, settings);
        let executor = executor.or_exit(Exit::Bug, String::new)?;
        Ok(Self { executor, reconnect, injector })
    }
}

/// Checks that the address of the arms fits their driver, before anything is connected.
pub(super) fn check_address(args: &ArmsArgs) -> Result<(), Failed> {
    let Some(address) = &args.arms_at else { return Ok(()) };
    let scheme = match args.driver {
        DriverName::Sim => {
            return Err(Failed::usage(
                "--arms-at belongs to real arms: give --driver quarc or --driver kinova-ros with it",
            ));
        }
        DriverName::Quarc => "tcpip://",
        DriverName::KinovaRos => "ws://",
    };
    let bare = address.strip_prefix(scheme).unwrap_or(address);
    let parts = bare.strip_suffix('/').unwrap_or(bare).rsplit_once(':');
    let is_good = parts.is_some_and(|(host, port)| {
        !host.is_empty() && !host.contains("//") && port.parse::<u16>().is_ok_and(|port| port > 0)
    });
    if is_good {
        return Ok(());
    }
    let driver = name(args.driver);
    Err(Failed::usage(format!("--arms-at {address:?}: {driver} expects {scheme}HOST:PORT")))
}

/// Connects to the arms. Returns their driver, how to reconnect to real ones, and what injects faults into simulated
/// ones.
pub(super) fn connect(
    args: &ArmsArgs,
    cell: &Cell,
    settings: &Settings,
    clock: Arc<dyn Clock>,
) -> Result<(BoxDriver, Option<Reconnect>, Option<Injector>), Failed> {
    let connect = match args.driver {
        DriverName::Sim => {
            let injector = Injector::default();
            let drill = Drill::new(injector.clone(), settings);
            let pair = simulated(args.seed, &cell.file, settings)?;
            let driver = Box::new(RealTimePair::new(pair, clock).with_drill(drill));
            return Ok((driver, None, Some(injector)));
        }
        DriverName::Quarc => quarc(&cell.file)?,
        DriverName::KinovaRos => kinova_ros(&cell.file)?,
    };
    let address = args.arms_at.clone().unwrap_or_default();
    let reconnect: Reconnect = Arc::new(move || connect(&address));
    let driver = reconnect().or_exit(Exit::TryAgain, String::new)?;
    Ok((driver, Some(reconnect), None))
}

/// Creates a simulated pair with its tools above their workspaces.
pub(super) fn simulated(
    seed: u64,
    file: &CellFile,
    settings: &Settings,
) -> Result<SimulatedPair, Failed> {
    let cell = file.work_cell();
    let at = start_posture(&cell)?;
    let gaps = cell.gaps_with(&at, &vec![READY_OPENING; at.len()]);
    let table_m = gaps.table_m.iter().copied().fold(f64::INFINITY, f64::min);
    for (gap_m, least_m, what) in [
        (gaps.arms_m, settings.check.arms_gap_m, "each other"),
        (table_m, settings.check.table_gap_m, "the table"),
    ] {
        if gap_m < least_m {
            return Err(Failed::new(
                Exit::Data,
                anyhow::anyhow!(
                    "simulated arms would start {:.0} mm from {what}, at least {:.0}: move arms[].base_m or \
                     table.height_m in the cell file",
                    1e3 * gap_m,
                    1e3 * least_m
                ),
            ));
        }
    }
    Ok(SimulatedPair::new(cell, &at, READY_OPENING, simulated_config(seed, file)))
}

/// Creates a simulated pair with raised arms, whose grippers do not point down.
pub(super) fn raised(seed: u64, file: &CellFile) -> SimulatedPair {
    let raised = Joints::new(&RAISED_DEGREES.map(f64::to_radians));
    let at = vec![raised; file.arms.len()];
    SimulatedPair::new(file.work_cell(), &at, READY_OPENING, simulated_config(seed, file))
}

/// Returns the joint angles of arms whose tools are above their workspaces, radians.
pub(super) fn start_posture(cell: &WorkCell) -> Result<Vec<Joints>, Failed> {
    cell.ready(READY_M).or_exit(Exit::Data, || "the arms have no start posture".to_owned())
}

fn simulated_config(seed: u64, file: &CellFile) -> SimulatedConfig {
    let defaults = SimulatedConfig::default();
    SimulatedConfig {
        seed,
        latency_periods: file.simulated.latency_periods,
        lag_s: file.simulated.lag_s,
        brake_s: file.simulated.brake_s,
        reports_torques: file.reports_torques.unwrap_or(defaults.reports_torques),
        ..defaults
    }
}

/// Returns how to connect to arms behind a Simulink model.
fn quarc(file: &CellFile) -> Result<Connect, Failed> {
    if file.reports_torques.is_some() {
        return Err(Failed::new(
            Exit::Data,
            anyhow::anyhow!(
                "cell file: reports_torques is given, expected no such key behind QUARC: the model reports it"
            ),
        ));
    }
    Ok(Box::new(|address| Ok(Box::new(QuarcDriver::connect(QuarcConfig::at(address))?))))
}

/// Returns how to connect to arms behind Kinova's ROS driver.
fn kinova_ros(file: &CellFile) -> Result<Connect, Failed> {
    let config = kinova_ros_config(file)?;
    Ok(Box::new(move |address| {
        let config = KinovaRosConfig { address: address.to_owned(), ..config.clone() };
        Ok(Box::new(KinovaRosDriver::connect(config)?))
    }))
}

/// Returns the configuration of Kinova's ROS driver, without the address.
pub(super) fn kinova_ros_config(file: &CellFile) -> Result<KinovaRosConfig, Failed> {
    let arms: Vec<KinovaArm> = file
        .arms
        .iter()
        .map(|arm| KinovaArm { node: arm.ros_node(), joint_prefix: arm.ros_joint_prefix() })
        .collect();
    let arms = arms.try_into().map_err(|_arms| Failed::usage("kinova-ros drives two arms"))?;
    Ok(KinovaRosConfig {
        arms,
        efforts: match (file.reports_torques, file.torque_mean_s) {
            (Some(true), _) => Efforts::Compensated,
            (Some(false), _) => Efforts::Unused,
            (None, mean_s) => Efforts::Changes { mean_s: mean_s.unwrap_or(TORQUE_MEAN_S) },
        },
        ..KinovaRosConfig::at("")
    })
}
