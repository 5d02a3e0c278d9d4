//! Objects that lie where the policy's hand cannot get at them.
//!
//! The hand of the training world stays within a box. An object that noise, a neighbour or the other arm has pushed to
//! the edge of that box cannot be pushed back, because the hand does not get behind it. The arms reach farther: before
//! the next episode, one of them pushes such an object back.

use glam::DVec3;
use tandem_core::ArmIndex;

use super::ClosedLoop;
use super::nudging::{PADS_HALF_WIDTH_M, PUSH_GAP_M, Push};
use super::sparing::PUSHING_DISTANCE_M;
use crate::simulated::ObjectPose;
use crate::trial::outcome::FailureCause;
use crate::trial::runner::TrialRunner;

/// Distance from an object that can be grasped to the edge of the hand's box, metres.
const EDGE_DISTANCE_M: f64 = 0.02;
/// Unit of the distance by which an object is pushed, metres, and largest number of units.
const PUSH_UNIT_M: f64 = 0.01;
const MAX_UNITS: u32 = 100;

impl ClosedLoop<'_, '_> {
    /// Pushes the objects that lie out of the reach of their arms toward their goals, as far as it takes for a hand to
    /// get at them.
    pub(super) fn recall(&mut self) -> Result<(), FailureCause> {
        let (runner, start) = (self.runner, self.start);
        for owner in runner.config.layout.arms() {
            let objects = self.rig.observe_objects()?;
            let is_misplaced = runner.misplaced(&objects, start).nth(owner.0) == Some(true);
            if !is_misplaced || runner.lying(&objects).nth(owner.0) != Some(true) {
                continue;
            }
            for (arm, push) in runner.recalls(owner, &objects, start.goals[owner.0]) {
                let is_pushed = self.carry_out(arm, &objects, &push)?;
                let mut pushing = vec![false; self.state.joint_angles.len()];
                pushing[arm] = true;
                self.retreat(&pushing)?;
                if is_pushed {
                    break;
                }
            }
        }
        Ok(())
    }
}

impl TrialRunner {
    /// Returns the pushes that may bring the object of `owner` back, each with the arm that makes it and in its frame,
    /// best first: straight toward the goal or along an axis, and within the hand's box or not. There are none if the
    /// hand of `owner` can get at its object.
    fn recalls(&self, owner: ArmIndex, objects: &[ObjectPose], goal: DVec3) -> Vec<(usize, Push)> {
        let object = self.mapping.object_in_arm(owner, objects[owner.0].at_m);
        let away_m =
            if self.config.layout.task.grasps() { EDGE_DISTANCE_M } else { PUSHING_DISTANCE_M };
        let is_at_hand = |position: DVec3| {
            self.is_reached(position - (goal - position).with_z(0.0).normalize_or_zero() * away_m)
        };
        if is_at_hand(object) {
            return Vec::new();
        }
        let to_goal = (goal - object).with_z(0.0);
        let displacements = [to_goal, to_goal.with_x(0.0), to_goal.with_y(0.0)];
        let half_m = f64::from(self.config.block.half_m);
        let corner_m = std::f64::consts::SQRT_2 * half_m;
        let mut recalls = Vec::new();
        for displacement in displacements.into_iter().filter(|by| by.length() > PUSH_UNIT_M) {
            let along = displacement.normalize();
            let n_units = (displacement.length() / PUSH_UNIT_M).floor();
            let is_back = |n: &f64| is_at_hand(object + along * (*n * PUSH_UNIT_M));
            let mut units = (1..MAX_UNITS).map(f64::from).take_while(|n| *n < n_units);
            let n_units = units.find(is_back).map_or(n_units, |n| n + 1.0);
            let from = object - along * (corner_m + PADS_HALF_WIDTH_M + PUSH_GAP_M);
            let to = object + along * (n_units * PUSH_UNIT_M - half_m - PADS_HALF_WIDTH_M);
            recalls.extend((0..objects.len()).map(|arm| {
                let seen = |in_arm| {
                    let position = self.mapping.object_in_world(owner, in_arm);
                    self.mapping.object_in_arm(ArmIndex(arm), position)
                };
                (arm, Push { from: seen(from), to: seen(to) })
            }));
        }
        let is_reached = |push: &Push| self.is_reached(push.from) && self.is_reached(push.to);
        recalls.sort_by_key(|(arm, push)| (!is_reached(push), *arm != owner.0));
        recalls
    }
}

#[cfg(test)]
mod tests {
    use glam::DQuat;
    use tandem_core::Task;

    use super::*;
    use crate::trial::{TrialMode, test_config};

    fn recalls(task: Task, object: DVec3, goal: DVec3) -> Vec<(usize, Push)> {
        let runner = TrialRunner::new(test_config(task, TrialMode::ClosedLoop, 1)).unwrap();
        let pose = |(arm, in_arm)| ObjectPose {
            at_m: runner.mapping.object_in_world(ArmIndex(arm), in_arm),
            orientation: DQuat::IDENTITY,
            time_s: 0.0,
        };
        let objects = [(0, object), (1, DVec3::new(0.1, 0.1, object.z))].map(pose);
        runner.recalls(ArmIndex(0), &objects, goal)
    }

    /// The position of a hand that is to go far in the direction `to`, arm frame, metres.
    fn farthest(to: DVec3) -> DVec3 {
        let config = test_config(Task::SharedPush, TrialMode::ClosedLoop, 1);
        TrialRunner::new(config).unwrap().mapping.reachable_hand(DVec3::new(0.1, 0.05, 0.03) + to)
    }

    #[test]
    fn an_object_that_a_hand_can_push_back_is_left_alone() {
        let goal = DVec3::new(0.1, 0.0, 0.03);
        let edge_m = farthest(DVec3::Y).y;
        let object = |room_m: f64| DVec3::new(0.1, edge_m - room_m, 0.03);
        assert!(recalls(Task::SharedPush, object(PUSHING_DISTANCE_M + 0.001), goal).is_empty());
        assert!(!recalls(Task::SharedPush, object(PUSHING_DISTANCE_M - 0.01), goal).is_empty());
        let pick = Task::SharedPickAndPlace;
        assert!(
            recalls(pick, object(PUSHING_DISTANCE_M - 0.01), goal).is_empty(),
            "it can be grasped"
        );
        assert!(!recalls(pick, object(0.0), goal).is_empty());
    }

    #[test]
    fn an_object_at_the_edge_is_pushed_toward_its_goal_until_a_hand_gets_behind_it() {
        let goal = DVec3::new(0.1, 0.0, 0.03);
        let object = DVec3::new(0.1, farthest(DVec3::Y).y - 0.02, 0.03);
        let found = recalls(Task::SharedPush, object, goal);
        let (arm, Push { from, to }) = &found[0];
        assert_eq!(*arm, 0);
        assert!((from.x - 0.1).abs() < 1e-9 && from.y > object.y + 0.04, "{from}");
        let half_m = 0.0325;
        let then_m = to.y - half_m - PADS_HALF_WIDTH_M;
        let room_m = farthest(DVec3::Y).y - then_m;
        assert!(room_m > PUSHING_DISTANCE_M && room_m < PUSHING_DISTANCE_M + 0.03, "{then_m}");
        let goal_at_side = DVec3::new(0.1, object.y, 0.03) + DVec3::X * 0.05;
        assert!(recalls(Task::SharedPush, object, goal_at_side).is_empty());
    }

    #[test]
    fn an_object_that_its_own_arm_cannot_push_back_is_pushed_by_the_other_one() {
        let goal = DVec3::new(0.1, 0.05, 0.03);
        let far = DVec3::new(farthest(DVec3::X).x - 0.035, 0.05, 0.03);
        let found = recalls(Task::SharedPush, far, goal);
        assert_eq!((found[0].0, found[found.len() - 1].0), (1, 0), "{found:?}");
        // Toward the goal of the first arm, seen from the other one, which faces it.
        let Push { from, to } = &found[0].1;
        assert!(to.x > from.x && (to.y - from.y).abs() < 1e-6, "{from} {to}");
    }
}
