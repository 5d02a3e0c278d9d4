//! Limits on speed and acceleration.

/// Limits on a motion, shared by the planner and the check.
///
/// Numbers are finite and above 0. Ranges and speeds of the joints are the arm's own ([`Joint`](crate::model::Joint)).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Largest speed of the tool's origin, metres per second. The paper's arms move at 0.20 (its Table 3).
    pub tool_speed_mps: f64,
    /// Time in which a joint may accelerate from rest to its largest speed, seconds. It defines the largest
    /// acceleration.
    ///
    /// Kinova publishes no accelerations. The default of 0.25 s allows 144 and 192 degrees per second squared: one
    /// joint alone accelerates the tool of an outstretched Mico by at most 0.15 g, so that inertia adds little to the
    /// static load of the motors, and a stop from full speed takes 5 degrees.
    pub ramp_s: f64,
    /// Largest change of a gripper's opening per second, where 0 is closed and 1 open. The default of 0.8 is a choice:
    /// the arm's description gives no speed of the fingers.
    pub gripper_opening_per_s: f64,
}

impl Default for Limits {
    fn default() -> Self {
        Self { tool_speed_mps: 0.20, ramp_s: 0.25, gripper_opening_per_s: 0.8 }
    }
}

impl Limits {
    /// Returns the name and value of the first limit that is not positive and finite.
    pub(crate) fn bad_setting(&self) -> Option<(&'static str, f64)> {
        let settings = [
            ("tool_speed_mps", self.tool_speed_mps),
            ("ramp_s", self.ramp_s),
            ("gripper_opening_per_s", self.gripper_opening_per_s),
        ];
        settings.into_iter().find(|(_, value)| !(value.is_finite() && *value > 0.0))
    }
}
