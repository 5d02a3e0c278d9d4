//! What the executor allows.

use tandem_kinematics::{CheckSettings, WorkCell};

use crate::layout::check_settings;

/// What the executor allows, and what it takes for granted about the drives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// What a motion has to keep to be started; also the largest speeds and accelerations while it is played.
    pub check: CheckSettings,
    /// Smallest gap between the table and any part of an arm but its base, until it could stand still; metres.
    pub table_gap_m: f64,
    /// Smallest gap between the parts of two arms, until both could stand still; metres.
    pub arms_gap_m: f64,
    /// Smallest gap between parts of one arm that can meet, until it could stand still; metres.
    pub self_gap_m: f64,
    /// A motion has to stay this far from the ends of the joints' ranges, radians. The envelope itself goes to the ends.
    pub range_margin_rad: f64,
    /// Longest time from what a state says to the moment at which a command given upon it takes effect, seconds.
    pub reaction_s: f64,
    /// Time in which the drives brake a joint from its largest speed to rest, seconds.
    pub brake_s: f64,
    /// Usual time from a command to the moment at which angles are read that show it, seconds.
    pub lag_s: f64,
    /// How fast an error of a joint's angle is corrected, 1/s.
    pub gain_per_s: f64,
    /// Largest distance of a joint from where the motion has it, radians.
    pub tracking_rad: f64,
    /// A joint at its goal is at most this far from it, radians.
    pub settled_rad: f64,
    /// Longest time that the arms may take to settle after the motion's end, seconds.
    pub settle_s: f64,
    /// What an angle may change from state to state beyond what the largest speed explains, radians.
    pub jump_rad: f64,
    /// Largest measured speed of a joint, as a share of its limit.
    pub overspeed_share: f64,
    /// Largest torque that may be left unexplained, newton metres.
    pub torque_nm: f64,
    /// A joint that is told to move faster than this has to report new angles, radians per second.
    pub frozen_radps: f64,
    /// A joint that moves slower than this rests, radians per second.
    pub rest_radps: f64,
    /// The motion pauses when no new state has come for this much longer than a period, seconds.
    pub state_hold_s: f64,
    /// The arms are stopped when no new state has come for this much longer than a period, or the newest is older than
    /// states were by this much; seconds.
    pub state_stop_s: f64,
    /// Commands have to take effect within this time, where the arms tell; seconds.
    pub command_s: f64,
    /// The motion pauses when its owner has not been heard for this long, seconds.
    pub owner_hold_s: f64,
    /// The arms are stopped when the owner of a motion has not been heard for this long, seconds.
    pub owner_stop_s: f64,
    /// A lease ends when its owner has not been heard for this long, seconds.
    pub lease_s: f64,
    /// Longest time from one tick to the next, seconds: the drives brake by themselves soon after.
    pub tick_s: f64,
    /// Time in which a pause brings a motion to rest along its path, seconds.
    pub pause_s: f64,
    /// Time in which a motion takes up its full speed again, seconds.
    pub resume_s: f64,
}

impl Default for Settings {
    /// Values for the simulated pair and for arms like it: commands take effect within 30 ms, joints brake within 50 ms.
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

/// A setting that makes no sense.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("{name} is {value}, which is out of its range")]
pub struct BadSetting {
    /// The setting.
    pub name: &'static str,
    /// Its value.
    pub value: f64,
}

impl Settings {
    /// Passes settings that make sense for `cell` and exchanges every `period_s` seconds.
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

    /// A setting that does not go with the others.
    fn bad_relation(&self, period_s: f64) -> Option<(&'static str, f64)> {
        let fits = [
            // A feedback that answers faster than its delay swings.
            (
                "gain_per_s",
                self.gain_per_s,
                self.gain_per_s >= 0.0 && self.gain_per_s * self.lag_s < 0.5,
            ),
            ("lag_s", self.lag_s, (0.0..=self.reaction_s).contains(&self.lag_s)),
            ("reaction_s", self.reaction_s, self.reaction_s >= period_s),
            // The emergency brake is at least as hard as what motions use.
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
