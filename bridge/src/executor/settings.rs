//! The settings of the executor.

use tandem_kinematics::{CheckSettings, WorkCell};

use crate::work_cell::check_settings;

/// The limits of the executor and its assumptions about the drives.
///
/// Numbers are finite and above 0, but the lag and the feedback gain may be 0. The lag and a period are at most the
/// reaction, `brake_s` is at most `ramp_s` of the limits and at most half of `pause_s`, gaps are smaller than those of
/// `check`, and of hold, stop and lease each time is at most the next one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// The limits that a motion has to keep to be started, and the largest speeds and accelerations during playback.
    pub check: CheckSettings,
    /// Smallest gap between the table and any part of an arm except its base on the stopping path, metres.
    pub table_gap_m: f64,
    /// Smallest gap between the parts of two arms on their stopping paths, metres.
    pub arms_gap_m: f64,
    /// Smallest gap between parts of one arm that can collide on its stopping path, metres.
    pub self_gap_m: f64,
    /// Smallest distance of a motion from the ends of the joints' ranges, radians. The envelope allows the full ranges.
    pub range_margin_rad: f64,
    /// Longest time from the measurement of a state until a command based on it takes effect, seconds.
    pub reaction_s: f64,
    /// Time in which the drives brake a joint from its highest speed to rest, seconds.
    pub brake_s: f64,
    /// Usual time from a command until measured angles reflect it, seconds.
    pub lag_s: f64,
    /// Feedback gain of the joints' angles, 1/s. Its product with the lag is below 0.5.
    pub gain_per_s: f64,
    /// Largest tracking error of a joint, radians.
    pub tracking_rad: f64,
    /// Largest distance of a settled joint from the motion's end, radians.
    pub settled_rad: f64,
    /// Longest time for the arms to settle after the motion's end and the last change of an opening, seconds.
    pub settle_s: f64,
    /// Largest change of an angle between two states beyond what the highest speed explains, radians.
    pub jump_rad: f64,
    /// Highest measured speed of a joint, as a share of its limit.
    pub overspeed_share: f64,
    /// Largest external torque on a joint, newton metres.
    pub torque_nm: f64,
    /// A joint that is commanded to move faster than this has to report changing angles, radians per second.
    pub frozen_radps: f64,
    /// Highest speed of a joint at rest, radians per second.
    pub rest_radps: f64,
    /// The motion pauses if the newest state is older than a period plus this, seconds.
    pub state_hold_s: f64,
    /// The arms are stopped if the newest state is older than a period plus this, or delayed by this much more than
    /// earlier states; seconds.
    pub state_stop_s: f64,
    /// Longest time until a command takes effect, if the arms report that; seconds.
    pub command_s: f64,
    /// The motion pauses after the owner was silent for this long, seconds.
    pub owner_hold_s: f64,
    /// The arms are stopped after the owner of a motion was silent for this long, seconds.
    pub owner_stop_s: f64,
    /// A lease ends after its owner was silent for this long, seconds.
    pub lease_s: f64,
    /// Longest time from one tick to the next, seconds. The drives brake by themselves soon after.
    pub tick_s: f64,
    /// Time in which a pause brings a motion to rest along its path, seconds.
    pub pause_s: f64,
    /// Time in which a motion returns to its full speed, seconds.
    pub resume_s: f64,
}

impl Default for Settings {
    /// Values for the simulated pair and for similar arms: commands take effect within 30 ms, joints brake within 50
    /// ms.
    fn default() -> Self {
        Self {
            check: check_settings(),
            table_gap_m: 0.001,
            arms_gap_m: 0.012,
            self_gap_m: 0.002,
            range_margin_rad: 1.0_f64.to_radians(),
            reaction_s: 0.040,
            brake_s: 0.050,
            lag_s: 0.025,
            gain_per_s: 4.0,
            tracking_rad: 2.0_f64.to_radians(),
            settled_rad: 0.2_f64.to_radians(),
            settle_s: 2.0,
            jump_rad: 0.5_f64.to_radians(),
            overspeed_share: 1.25,
            torque_nm: 4.0,
            frozen_radps: 2.0_f64.to_radians(),
            rest_radps: 0.5_f64.to_radians(),
            state_hold_s: 0.015,
            state_stop_s: 0.035,
            command_s: 0.035,
            owner_hold_s: 0.3,
            owner_stop_s: 1.0,
            lease_s: 5.0,
            tick_s: 0.045,
            pause_s: 0.1,
            resume_s: 1.0,
        }
    }
}

/// A setting is out of its range.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("{name} is {value}, which is out of its range")]
pub struct BadSetting {
    /// The name of the setting.
    pub name: &'static str,
    /// Its value.
    pub value: f64,
}

impl Settings {
    /// Checks the settings for `cell` and exchanges every `period_s` seconds.
    pub(crate) fn checked(self, cell: &WorkCell, period_s: f64) -> Result<Self, BadSetting> {
        let positive = [
            ("period_s", period_s),
            ("table_gap_m", self.table_gap_m),
            ("arms_gap_m", self.arms_gap_m),
            ("self_gap_m", self.self_gap_m),
            ("range_margin_rad", self.range_margin_rad),
            ("reaction_s", self.reaction_s),
            ("brake_s", self.brake_s),
            ("tracking_rad", self.tracking_rad),
            ("settled_rad", self.settled_rad),
            ("settle_s", self.settle_s),
            ("jump_rad", self.jump_rad),
            ("overspeed_share", self.overspeed_share),
            ("torque_nm", self.torque_nm),
            ("frozen_radps", self.frozen_radps),
            ("rest_radps", self.rest_radps),
            ("state_hold_s", self.state_hold_s),
            ("state_stop_s", self.state_stop_s),
            ("command_s", self.command_s),
            ("owner_hold_s", self.owner_hold_s),
            ("owner_stop_s", self.owner_stop_s),
            ("lease_s", self.lease_s),
            ("tick_s", self.tick_s),
            ("pause_s", self.pause_s),
            ("resume_s", self.resume_s),
            ("ramp_s", self.check.limits.ramp_s),
            ("tool_speed_mps", self.check.limits.tool_speed_mps),
        ];
        let bad = positive.into_iter().find(|(_, value)| !(value.is_finite() && *value > 0.0));
        let bad = bad.or_else(|| self.bad_relation(period_s));
        let bad = bad.or_else(|| (cell.arms.is_empty()).then_some(("arms", 0.0)));
        match bad {
            Some((name, value)) => Err(BadSetting { name, value }),
            None => Ok(self),
        }
    }

    /// Returns a setting that contradicts the others.
    fn bad_relation(&self, period_s: f64) -> Option<(&'static str, f64)> {
        let fits = [
            // Feedback that is faster than its delay oscillates.
            (
                "gain_per_s",
                self.gain_per_s,
                self.gain_per_s >= 0.0 && self.gain_per_s * self.lag_s < 0.5,
            ),
            ("lag_s", self.lag_s, (0.0..=self.reaction_s).contains(&self.lag_s)),
            ("reaction_s", self.reaction_s, self.reaction_s >= period_s),
            // The emergency brake decelerates at least as hard as motions do.
            ("brake_s", self.brake_s, self.brake_s <= self.check.limits.ramp_s),
            ("pause_s", self.pause_s, self.pause_s >= 2.0 * self.brake_s),
            ("arms_gap_m", self.arms_gap_m, self.arms_gap_m < self.check.arms_gap_m),
            ("table_gap_m", self.table_gap_m, self.table_gap_m < self.check.table_gap_m),
            ("self_gap_m", self.self_gap_m, self.self_gap_m < self.check.self_gap_m),
            ("state_stop_s", self.state_stop_s, self.state_hold_s <= self.state_stop_s),
            ("owner_stop_s", self.owner_stop_s, self.owner_hold_s <= self.owner_stop_s),
            ("lease_s", self.lease_s, self.owner_stop_s <= self.lease_s),
        ];
        fits.into_iter().find(|(_, _, fits)| !fits).map(|(name, value, _)| (name, value))
    }
}
