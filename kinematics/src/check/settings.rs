//! The limits that the check enforces.

use tandem_core::ArmIndex;

use crate::limits::Limits;
use crate::refusal::{Reason, Refusal};
use crate::self_collision::SELF_GAP_M;

/// The limits that a motion must keep. Numbers are finite and 0 or more.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CheckSettings {
    /// Speeds and accelerations. Those of the joints are the arm's own.
    pub limits: Limits,
    /// Largest angle between a gripper's direction and straight down, radians.
    pub tilt_rad: f64,
    /// Largest distance between tool and shoulder as a share of the arm's reach. Near 1 the configuration is singular.
    pub reach_share: f64,
    /// Smallest gap between an arm's parts, except its base, and the table, metres.
    pub table_gap_m: f64,
    /// Smallest gap between the parts of two arms, metres.
    pub arms_gap_m: f64,
    /// Smallest gap between parts of one arm that can collide ([`SelfPair`](crate::model::SelfPair)), metres.
    pub self_gap_m: f64,
    /// Largest difference between a joint's first angle and its present angle, radians.
    pub start_rad: f64,
    /// Longest duration of a motion, seconds.
    pub duration_s: f64,
}

impl Default for CheckSettings {
    /// Returns a tilt of 25 degrees, 97 per cent of the reach, gaps of 2 mm to the table, 20 mm between arms and 5 mm
    /// within an arm, a start within 1 degree and at most 10 minutes.
    fn default() -> Self {
        Self {
            limits: Limits::default(),
            tilt_rad: 25.0_f64.to_radians(),
            reach_share: 0.97,
            table_gap_m: 0.002,
            arms_gap_m: 0.020,
            self_gap_m: SELF_GAP_M,
            start_rad: 1.0_f64.to_radians(),
            duration_s: 600.0,
        }
    }
}

impl CheckSettings {
    /// Refuses settings that are negative or not finite.
    pub(super) fn validate(&self) -> Result<(), Refusal> {
        let non_negative = [
            ("tilt_rad", self.tilt_rad),
            ("reach_share", self.reach_share),
            ("table_gap_m", self.table_gap_m),
            ("arms_gap_m", self.arms_gap_m),
            ("self_gap_m", self.self_gap_m),
            ("start_rad", self.start_rad),
            ("duration_s", self.duration_s),
        ];
        let bad = non_negative.into_iter().find(|(_, value)| !(value.is_finite() && *value >= 0.0));
        match self.limits.bad_setting().or(bad) {
            Some((name, value)) => Err(Reason::Setting(name, value).at(ArmIndex(0), 0.0)),
            None => Ok(()),
        }
    }
}
