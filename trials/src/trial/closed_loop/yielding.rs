//! Arms that press on something: they stop before the envelope stops them, and withdraw.
//!
//! In the training world the servo of a hand has a limited force, so a hand that meets an obstacle stands still. The
//! joints of an arm would press on.

use glam::{DQuat, DVec3};
use tandem_kinematics::Waypoint;

use super::{ClosedLoop, WantedStep};
use crate::trial::block_avoidance::ObservedBlock;
use crate::trial::outcome::FailureCause;

/// The force from which a hand withdraws, newtons, and the distance by which it does, metres.
const PRESSING_FORCE_N: f64 = 3.0;
const WITHDRAWAL_M: f64 = 0.006;
/// By how much a gripper that holds something is further open than commanded, metres on each side.
const GRIP_EXCESS_M: f64 = 0.002;

impl ClosedLoop<'_, '_> {
    /// Continues from where the arms stopped on their way from `first`. Hands that hold an object that all arms share
    /// keep their grip and do not withdraw.
    pub(super) fn yielded(&mut self, first: Waypoint) {
        let (mapping, state) = (&self.runner.mapping, &mut self.state);
        let forces_n = self.rig.forces_n();
        for (arm, (angles, opening)) in self.rig.encoders().into_iter().enumerate() {
            state.joint_angles[arm] = angles;
            let opening_m = mapping.policy_opening_m(opening);
            // A gripper that holds something keeps its grip, unless its hand presses on something.
            let grips = state.openings_m[arm] < opening_m - GRIP_EXCESS_M;
            let presses = forces_n[arm].length() >= PRESSING_FORCE_N && !state.holds[arm];
            if !grips || presses {
                state.openings_m[arm] = opening_m;
            }
        }
        let withdraw = forces_n.into_iter().enumerate().map(|(arm, force_n)| {
            if force_n.length() < PRESSING_FORCE_N || state.holds[arm] {
                return DVec3::ZERO;
            }
            let yaw_rad = mapping.cell().arms[arm].yaw_rad;
            DQuat::from_rotation_z(-yaw_rad) * (force_n.normalize() * WITHDRAWAL_M)
        });
        state.withdraw = Some(withdraw.collect());
        let reached = self.runner.tools(state);
        let [rise, corner, end] = std::array::from_fn(|_| reached.clone());
        state.append_waypoints([first, rise, corner, end, reached]);
    }

    /// Withdraws the hands that pressed on something in the step before. Returns whether there were any.
    pub(super) fn withdraw(&mut self, blocks: &[ObservedBlock]) -> Result<bool, FailureCause> {
        let Some(withdraw) = self.state.withdraw.take() else { return Ok(false) };
        let hands = self.runner.hands(&self.state);
        let hands = hands.iter().zip(withdraw).map(|(hand, by)| hand + by).collect();
        let wanted = WantedStep { hands, openings_m: self.state.openings_m.clone(), blocks };
        self.attempt(&wanted, &wanted.hands, &self.runner.check)?;
        // A withdrawal that meets something itself is not followed by another.
        self.state.withdraw = None;
        Ok(true)
    }
}
