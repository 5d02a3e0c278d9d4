//! The cell file: where the arms stand, what they are, and how fast they react.
//!
//! The file is TOML. `cell_file/default.toml` explains every key. Unknown keys are refused, and every number has to be
//! finite and within its range. Margins may be wider than the defaults, never narrower.

use serde::de::Error as _;
use serde::{Deserialize, Deserializer};
use tandem_kinematics::model::MICO_4;
use tandem_kinematics::{ArmModel, PlacedArm, WorkCell};

use crate::executor::Settings;
use crate::work_cell::mico_cell;

pub use edit::with_timings;

mod edit;
mod ranges;

/// The text of the default cell with comments, to start from.
pub const DEFAULT_TEXT: &str = include_str!("cell_file/default.toml");

/// Number of arms in a cell.
const N_ARMS: usize = 2;
/// The models that a cell may have.
const MODELS: [&ArmModel; 1] = [&MICO_4];

/// A cell file.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellFile {
    /// True if the arms report torques without those that carry their own weight; `None` for the driver's default.
    pub reports_torques: Option<bool>,
    /// Behind kinova-ros, the time constant of the mean that is subtracted from efforts, 0.1 to 2 seconds; `None` for
    /// the default, 0.4. Only without `reports_torques`.
    pub torque_mean_s: Option<f64>,
    /// The table.
    pub table: Table,
    /// The two arms, in the order of commands, with bases 0.15 to 4 metres apart.
    pub arms: Vec<Arm>,
    /// The limits of motions.
    #[serde(default)]
    pub limits: Limits,
    /// The properties of simulated arms.
    #[serde(default)]
    pub simulated: Simulated,
}

/// The table.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Table {
    /// Height of its top in the world, −1 to 1 metre.
    pub height_m: f64,
}

/// An arm.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Arm {
    /// Name for operators: 1 to 32 lower-case letters, digits, `-` and `_`.
    pub name: String,
    /// Kinova's name of the model: `m1n4s200`.
    pub model: String,
    /// Origin of the base frame in the world: x, y, z, each −3 to 3 metres, and at most 0.3 metres above or below the
    /// table.
    #[serde(deserialize_with = "exactly")]
    pub base_m: [f64; 3],
    /// Rotation of the base frame about the world's z axis, −360 to 360 degrees. Its x axis points at the workspace.
    pub yaw_degrees: f64,
    /// Usual time from a command until measured angles reflect it, 0 to 0.12 seconds and at most `reaction_s`; `None`
    /// if it was not measured. The three times are given together or not at all.
    pub lag_s: Option<f64>,
    /// Longest time from the measurement of a state until a command based on it takes effect, 0.01 to 0.2 seconds;
    /// `None` if it was not measured.
    pub reaction_s: Option<f64>,
    /// Time in which the drives brake a joint from its highest speed to rest, 0.001 to 0.25 seconds and at most
    /// `ramp_s` of the limits; `None` if it was not measured.
    pub brake_s: Option<f64>,
    /// ROS node of the arm's driver; `None` for `/NAME/MODEL_driver`.
    pub ros_node: Option<String>,
    /// Prefix of the joints' names in ROS; `None` for `MODEL_`.
    pub ros_joint_prefix: Option<String>,
}

/// The limits of motions. Gaps are at least those of the default.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// Largest speed of a tool, 0.01 to 0.5 metres per second.
    pub tool_speed_mps: f64,
    /// Time in which a joint may accelerate from rest to its largest speed, 0.1 to 2 seconds.
    pub ramp_s: f64,
    /// Largest change of a gripper's opening, 0.05 to 2 per second; 1 is from closed to open.
    pub opening_per_s: f64,
    /// Largest angle between a gripper's direction and straight down, 5 to 90 degrees.
    pub tilt_degrees: f64,
    /// Largest extension of an arm, as a share of its reach, 0.3 to 0.99.
    pub reach_share: f64,
    /// Smallest gap to the table in a motion, metres, at most 0.2 and at least 1 mm more than `table_gap_m`.
    pub check_table_gap_m: f64,
    /// Smallest gap between the arms in a motion, metres, at most 0.4 and at least 1 mm more than `arms_gap_m`.
    pub check_arms_gap_m: f64,
    /// Smallest gap between parts of one arm in a motion, metres, at most 0.1 and at least 1 mm more than `self_gap_m`.
    pub check_self_gap_m: f64,
    /// Gap to the table below which the envelope stops the arms, metres, at most 0.1.
    pub table_gap_m: f64,
    /// Gap between the arms below which the envelope stops them, metres, at most 0.2.
    pub arms_gap_m: f64,
    /// Gap between parts of one arm below which the envelope stops it, metres, at most 0.05.
    pub self_gap_m: f64,
    /// Largest tracking error of a joint, 0.2 to 5 degrees.
    pub tracking_degrees: f64,
    /// Largest external torque on a joint, 0.5 to 20 newton metres.
    pub torque_nm: f64,
}

/// The properties of simulated arms.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Simulated {
    /// Smallest and largest number of periods of 10 ms until a command takes effect, each 1 to 10.
    #[serde(deserialize_with = "exactly")]
    pub latency_periods: [u32; 2],
    /// Time constant with which a joint's speed follows its command, 0.001 to 0.1 seconds.
    pub lag_s: f64,
    /// Time in which a drive brakes a joint from its highest speed to rest, 0.005 to 0.25 seconds.
    pub brake_s: f64,
}

/// The times in which an arm reacts, as measured or assumed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmTiming {
    /// Usual time from a command until measured angles reflect it, seconds.
    pub lag_s: f64,
    /// Longest time from the measurement of a state until a command based on it takes effect, seconds.
    pub reaction_s: f64,
    /// Time in which the drives brake a joint from its highest speed to rest, seconds.
    pub brake_s: f64,
}

/// The reason why a cell file is refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CellFileError {
    /// The text is not TOML, has unknown keys, or lacks some.
    #[error("line {line}: {what}")]
    Syntax {
        /// Line, counted from 1.
        line: usize,
        /// The problem.
        what: String,
    },
    /// A number is out of its range.
    #[error("{key} is {value}, expected {low} to {high}{}", with_unit(.unit))]
    Range {
        /// The key, such as `arms[0].base_m[1]`.
        key: String,
        /// Its value.
        value: f64,
        /// The smallest allowed value.
        low: f64,
        /// The largest allowed value.
        high: f64,
        /// The unit; empty for a number without one.
        unit: &'static str,
    },
    /// A value does not fit.
    #[error("{key} is {value}, expected {expected}")]
    Value {
        /// The key.
        key: String,
        /// Its value.
        value: String,
        /// The allowed values.
        expected: String,
    },
}

fn with_unit(unit: &str) -> String {
    if unit.is_empty() { String::new() } else { format!(" {unit}") }
}

impl CellFile {
    /// Parses and checks the text of a cell file.
    ///
    /// # Errors
    /// Returns the first problem.
    pub fn parse(text: &str) -> Result<Self, CellFileError> {
        let file: Self = toml::from_str(text).map_err(|error| {
            let start = error.span().map_or(0, |span| span.start);
            let line = text.get(..start).unwrap_or(text).matches('\n').count() + 1;
            CellFileError::Syntax { line, what: error.message().replace('\n', " ") }
        })?;
        file.checked()
    }

    /// Returns the work cell: arms of these models at these places, with a task frame of scale 1.
    #[must_use]
    pub fn work_cell(&self) -> WorkCell {
        let place = |arm: &Arm| PlacedArm {
            model: model(&arm.model).unwrap_or(&MICO_4),
            base_in_world_m: arm.base_m.into(),
            yaw_rad: arm.yaw_degrees.to_radians(),
        };
        WorkCell {
            arms: self.arms.iter().map(place).collect(),
            table_z_m: self.table.height_m,
            ..mico_cell()
        }
    }

    /// Returns the settings of the executor: `defaults`, the limits of the file, and the times of the slower arm.
    /// Pauses take at least twice its braking time.
    #[must_use]
    pub fn settings(&self, defaults: &Settings) -> Settings {
        let limits = &self.limits;
        let mut settings = *defaults;
        let check = &mut settings.check;
        check.limits.tool_speed_mps = limits.tool_speed_mps;
        check.limits.ramp_s = limits.ramp_s;
        check.limits.gripper_opening_per_s = limits.opening_per_s;
        check.tilt_rad = limits.tilt_degrees.to_radians();
        check.reach_share = limits.reach_share;
        check.table_gap_m = limits.check_table_gap_m;
        check.arms_gap_m = limits.check_arms_gap_m;
        check.self_gap_m = limits.check_self_gap_m;
        settings.table_gap_m = limits.table_gap_m;
        settings.arms_gap_m = limits.arms_gap_m;
        settings.self_gap_m = limits.self_gap_m;
        settings.tracking_rad = limits.tracking_degrees.to_radians();
        settings.torque_nm = limits.torque_nm;
        let timings = self.timings(defaults);
        let slowest = |time: fn(&ArmTiming) -> f64| timings.iter().map(time).fold(0.0, f64::max);
        settings.lag_s = slowest(|timing| timing.lag_s);
        settings.reaction_s = slowest(|timing| timing.reaction_s);
        settings.brake_s = slowest(|timing| timing.brake_s);
        settings.pause_s = settings.pause_s.max(2.0 * settings.brake_s);
        settings
    }

    /// Returns how fast each arm reacts: the times of the file, or else those of `defaults`.
    #[must_use]
    pub fn timings(&self, defaults: &Settings) -> Vec<ArmTiming> {
        let timing = |arm: &Arm| ArmTiming {
            lag_s: arm.lag_s.unwrap_or(defaults.lag_s),
            reaction_s: arm.reaction_s.unwrap_or(defaults.reaction_s),
            brake_s: arm.brake_s.unwrap_or(defaults.brake_s),
        };
        self.arms.iter().map(timing).collect()
    }
}

impl Arm {
    /// Returns true if all times of the arm were measured.
    #[must_use]
    pub fn is_measured(&self) -> bool {
        self.times().iter().all(|(_, value)| value.is_some())
    }

    /// Returns the ROS node of the arm's driver.
    #[must_use]
    pub fn ros_node(&self) -> String {
        self.ros_node.clone().unwrap_or_else(|| format!("/{}/{}_driver", self.name, self.model))
    }

    /// Returns the prefix of the joints' names in ROS.
    #[must_use]
    pub fn ros_joint_prefix(&self) -> String {
        self.ros_joint_prefix.clone().unwrap_or_else(|| format!("{}_", self.model))
    }

    fn times(&self) -> [(&'static str, Option<f64>); 3] {
        [("lag_s", self.lag_s), ("reaction_s", self.reaction_s), ("brake_s", self.brake_s)]
    }
}

impl Default for CellFile {
    /// Two Micos that face each other, with the default limits.
    fn default() -> Self {
        let cell = mico_cell();
        let arm = |(placed, name): (&PlacedArm, &str)| Arm {
            name: name.to_owned(),
            model: placed.model.name.to_owned(),
            base_m: placed.base_in_world_m.into(),
            yaw_degrees: placed.yaw_rad.to_degrees(),
            lag_s: None,
            reaction_s: None,
            brake_s: None,
            ros_node: None,
            ros_joint_prefix: None,
        };
        Self {
            reports_torques: None,
            torque_mean_s: None,
            table: Table { height_m: cell.table_z_m },
            arms: cell.arms.iter().zip(["left", "right"]).map(arm).collect(),
            limits: Limits::default(),
            simulated: Simulated::default(),
        }
    }
}

impl Default for Limits {
    fn default() -> Self {
        let settings = Settings::default();
        let check = &settings.check;
        Self {
            tool_speed_mps: check.limits.tool_speed_mps,
            ramp_s: check.limits.ramp_s,
            opening_per_s: check.limits.gripper_opening_per_s,
            tilt_degrees: 45.0,
            reach_share: check.reach_share,
            check_table_gap_m: check.table_gap_m,
            check_arms_gap_m: check.arms_gap_m,
            check_self_gap_m: check.self_gap_m,
            table_gap_m: settings.table_gap_m,
            arms_gap_m: settings.arms_gap_m,
            self_gap_m: settings.self_gap_m,
            tracking_degrees: 2.0,
            torque_nm: settings.torque_nm,
        }
    }
}

impl Default for Simulated {
    fn default() -> Self {
        Self { latency_periods: [1, 2], lag_s: 0.010, brake_s: 0.040 }
    }
}

/// Deserializes an array of `N` numbers. Unlike the array types of serde, it refuses further ones.
fn exactly<'de, T: Deserialize<'de>, D: Deserializer<'de>, const N: usize>(
    deserializer: D,
) -> Result<[T; N], D::Error> {
    let numbers = Vec::deserialize(deserializer)?;
    let wrong = |numbers: Vec<T>| {
        let expected = format!("{N} numbers");
        D::Error::invalid_length(numbers.len(), &expected.as_str())
    };
    numbers.try_into().map_err(wrong)
}

fn model(name: &str) -> Option<&'static ArmModel> {
    MODELS.into_iter().find(|model| model.name == name)
}

#[cfg(test)]
mod tests;
