//! Objects that lie side by side.
//!
//! A hand cannot grasp an object if another one lies where a pad has to be. In the training world its pads force their
//! way down; an arm's are [held up](crate::trial::block_avoidance). Such a hand pushes one of the objects along the
//! other one, with a closed gripper and across its closing direction, so that there is room for its pads.

use glam::{DQuat, DVec3};
use tandem_core::ArmIndex;

use super::step_motion::tool_axes;
use super::{ClosedLoop, LoopState, WantedStep};
use crate::simulated::ObjectPose;
use crate::trial::block_avoidance::ObservedBlock;
use crate::trial::outcome::FailureCause;
use crate::trial::runner::TrialRunner;

/// A hand that has been held up for this many steps in a row pushes its object.
const N_HELD_UP: usize = 6;
/// An object at most this far from a hand is below it, horizontally, metres.
const BELOW_DISTANCE_M: f64 = 0.03;
/// Objects whose centres are at most this far apart may lie side by side, in edges of an object.
const SIDE_BY_SIDE_EDGES: f64 = 1.6;
/// The distance by which an object is pushed, metres.
const PUSH_DISTANCE_M: f64 = 0.045;
/// Half the width of closed pads, metres.
pub(super) const PADS_HALF_WIDTH_M: f64 = 0.008;
/// The gap between the pads of an upright hand and the object before the push, metres. A tilted hand uses most of it
/// up.
pub(super) const PUSH_GAP_M: f64 = 0.012;
/// Tolerance of what counts as within reach, metres.
const REACH_TOLERANCE_M: f64 = 0.004;
/// Height by which a hand rises before it moves beside its object, metres, and the height of its pads above the blocks
/// that suffices.
const RISE_M: f64 = 0.06;
const CLEARANCE_ABOVE_M: f64 = 0.025;
/// Largest distance of one motion, metres, and largest number of motions to one position.
const MAX_PART_M: f64 = 0.1;
const MAX_PARTS: u32 = 20;
/// A hand has arrived within this distance, metres.
const ARRIVAL_TOLERANCE_M: f64 = 0.015;

/// A push along the table: the hand's positions before and after it, arm frame, metres.
#[derive(Debug, PartialEq)]
pub(super) struct Push {
    pub(super) from: DVec3,
    pub(super) to: DVec3,
}

impl ClosedLoop<'_, '_> {
    /// If a hand has been held up for [`N_HELD_UP`] steps, pushes its object along the neighbouring one, or the
    /// neighbour along its object.
    pub(super) fn nudge(&mut self) -> Result<(), FailureCause> {
        let (runner, state) = (self.runner, &mut self.state);
        if !runner.config.layout.task.grasps() || runner.task.shares_object() {
            return Ok(());
        }
        let mut arms = 0..state.joint_angles.len();
        let Some(arm) = arms.find(|arm| state.progress.n_held_up(*arm) >= N_HELD_UP) else {
            return Ok(());
        };
        state.progress.release(arm);
        let objects = self.rig.observe_objects()?;
        if let Some(push) = runner.push(arm, &objects, state) {
            self.carry_out(arm, &objects, &push)?;
        }
        Ok(())
    }

    /// Pushes with the closed gripper of `arm`, which comes from above and rises again. An object that it holds is set
    /// down first. Returns whether the hand got to both ends of the push.
    pub(super) fn carry_out(
        &mut self,
        arm: usize,
        objects: &[ObjectPose],
        push: &Push,
    ) -> Result<bool, FailureCause> {
        let runner = self.runner;
        let Push { from, to } = *push;
        let blocks = runner.observed_blocks(objects, None);
        let above_m = 2.0 * f64::from(runner.config.block.half_m) + CLEARANCE_ABOVE_M;
        let hand = runner.hands(&self.state)[arm];
        let down = hand.with_z(hand.z.min(runner.config.trained_half_m));
        let raised = hand.with_z(above_m.min(hand.z + RISE_M));
        let grasps = runner.config.layout.task.grasps();
        let open_m = if grasps { runner.mapping.max_opening_m() } else { 0.0 };
        if grasps && runner.lying(objects).nth(arm) == Some(false) {
            let holding_m = self.state.openings_m[arm];
            self.move_hand(arm, (down, holding_m), &blocks)?;
            self.move_hand(arm, (runner.hands(&self.state)[arm], open_m), &blocks)?;
        }
        let positions = [
            (raised, open_m),
            (from.with_z(raised.z), 0.0),
            (from, 0.0),
            (to, 0.0),
            (to.with_z(raised.z), open_m),
        ];
        let mut arrives = true;
        for (hand, opening_m) in positions {
            arrives = self.move_hand(arm, (hand, opening_m), &blocks)?;
            if !arrives {
                break;
            }
        }
        self.state.velocities.fill(DVec3::ZERO);
        Ok(arrives)
    }

    /// Moves the hand of `arm` `to` a position (arm frame, metres) with an opening (metres on each side), in parts that
    /// the check of a motion allows. Returns whether the hand is there, rather than above a block or on its way.
    fn move_hand(
        &mut self,
        arm: usize,
        (to, opening_m): (DVec3, f64),
        blocks: &[ObservedBlock],
    ) -> Result<bool, FailureCause> {
        let runner = self.runner;
        let from = runner.hands(&self.state)[arm];
        let n_parts = ((to - from).length() / MAX_PART_M).floor() + 1.0;
        for part in (1..=MAX_PARTS).map(f64::from).take_while(|part| *part <= n_parts) {
            let mut hands = runner.hands(&self.state);
            let mut openings_m = self.state.openings_m.clone();
            hands[arm] = from.lerp(to, part / n_parts);
            openings_m[arm] = opening_m;
            let wanted = WantedStep { hands, openings_m, blocks };
            if !self.attempt(&wanted, &wanted.hands, &runner.check)? {
                return Ok(false);
            }
        }
        Ok((runner.hands(&self.state)[arm] - to).length() < ARRIVAL_TOLERANCE_M)
    }
}

impl TrialRunner {
    /// Returns the push that makes room for the pads of `arm`: of its own object, rather away from the other one than
    /// past it, or else of the other one. There is none if no other object lies beside the arm's own, or if hands
    /// cannot reach the places.
    fn push(&self, arm: usize, objects: &[ObjectPose], state: &LoopState) -> Option<Push> {
        let in_arm = |object: &ObjectPose| self.mapping.object_in_arm(ArmIndex(arm), object.at_m);
        let half_m = f64::from(self.config.block.half_m);
        let object = in_arm(&objects[arm]);
        let is_below = (object - self.hands(state)[arm]).truncate().length() < BELOW_DISTANCE_M;
        let is_beside = |other: &usize| {
            let apart_m = (in_arm(&objects[*other]) - object).truncate().length();
            *other != arm && apart_m < 2.0 * half_m * SIDE_BY_SIDE_EDGES
        };
        let other = (0..objects.len()).find(is_beside).filter(|_| is_below)?;
        let across = self.across(arm, state);
        let apart = object - in_arm(&objects[other]);
        let away = if apart.dot(across) < 0.0 { -across } else { across };
        let pushes = [(arm, away), (arm, -away), (other, -away), (other, away)];
        let corner_m = std::f64::consts::SQRT_2 * half_m;
        pushes.into_iter().find_map(|(pushed, along)| {
            let beside = object - apart;
            let (position, rests) = if pushed == arm { (object, beside) } else { (beside, object) };
            let push = Push {
                from: position - along * (corner_m + PADS_HALF_WIDTH_M + PUSH_GAP_M),
                to: position + along * (PUSH_DISTANCE_M - half_m - PADS_HALF_WIDTH_M),
            };
            let has_room = (rests - push.from).truncate().length() > corner_m + PADS_HALF_WIDTH_M;
            let then =
                self.mapping.object_in_world(ArmIndex(arm), position + along * PUSH_DISTANCE_M);
            let then = self.mapping.object_in_arm(ArmIndex(pushed), then);
            let is_reached = self.is_reached(push.from) && self.is_reached(push.to);
            (has_room && is_reached && self.is_reached(then)).then_some(push)
        })
    }

    /// The horizontal direction across the closing direction of the hand of `arm`, arm frame.
    pub(super) fn across(&self, arm: usize, state: &LoopState) -> DVec3 {
        let placed = &self.mapping.cell().arms[arm];
        let in_world = tool_axes(placed, &state.joint_angles[arm]).y_axis;
        let in_arm = DQuat::from_rotation_z(-placed.yaw_rad) * in_world;
        in_arm.with_z(0.0).normalize_or(DVec3::X)
    }

    /// Returns whether hands reach the place above or at `position`, arm frame, metres.
    pub(super) fn is_reached(&self, position: DVec3) -> bool {
        (self.mapping.reachable_hand(position) - position).truncate().length() < REACH_TOLERANCE_M
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::Task;

    use super::*;
    use crate::trial::{TrialMode, test_config};

    #[test]
    fn an_object_is_pushed_along_the_one_beside_it() {
        let config = test_config(Task::SharedPickAndPlace, TrialMode::ClosedLoop, 1);
        let mut runner = TrialRunner::new(config).unwrap();
        let start = runner.start(0).unwrap();
        let joint_angles = runner.mapping.cell().ready(0.2).unwrap();
        let state = LoopState::new(&start, &joint_angles);
        let hand = runner.hands(&state)[0];
        let half_m = f64::from(runner.config.block.half_m);
        let object = hand.with_z(half_m);
        let push = |other: DVec3, object: DVec3| {
            let pose = |in_arm| ObjectPose {
                at_m: runner.mapping.object_in_world(ArmIndex(0), in_arm),
                orientation: DQuat::IDENTITY,
                time_s: 0.0,
            };
            runner.push(0, &[pose(object), pose(other)], &state)
        };
        let beside = DVec3::Y * (2.0 * half_m + 0.002);
        let outward = push(object + beside - DVec3::X * 0.01, object).unwrap();
        assert!(outward.from.x < object.x - half_m - PADS_HALF_WIDTH_M, "{outward:?}");
        let moved_m = outward.to.x + PADS_HALF_WIDTH_M + half_m - object.x;
        assert!((moved_m - PUSH_DISTANCE_M).abs() < 1e-6, "{outward:?}");
        let inward = push(object + beside + DVec3::X * 0.01, object).unwrap();
        assert!(inward.from.x > object.x && inward.to.x < inward.from.x, "{inward:?}");
        assert_eq!(push(object + 2.0 * beside, object), None, "there is room already");
        let far = object + DVec3::X * 0.05;
        assert_eq!(push(far + beside, far), None, "the hand is elsewhere");
    }
}
