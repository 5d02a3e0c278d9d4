//! Steps of a policy that would push objects where hands can neither grasp them nor push them back.
//!
//! A hand that misses its object pushes it ahead, and so does one whose path leads past the other arm's object.

use glam::DVec3;
use tandem_core::ArmIndex;

use super::{LoopState, WantedStep};
use crate::trial::mapping::ArmObservation;
use crate::trial::runner::TrialRunner;

/// An object within this horizontal distance of a hand is between its pads, metres.
pub(super) const BETWEEN_PADS_DISTANCE_M: f64 = 0.012;
/// The centre of a held object is within this horizontal distance of the hand, metres.
pub(super) const HELD_DISTANCE_M: f64 = 0.02;
/// Distance from a hand to the centre of the object that it pushes ahead, metres.
pub(super) const PUSHING_DISTANCE_M: f64 = 0.045;
/// Distance from the inner side of a pad to its middle, metres.
const PAD_HALF_THICKNESS_M: f64 = 0.005;
/// Distance by which a step has to bring an object farther out of reach to count, metres.
const REACH_EXCESS_M: f64 = 0.001;
/// A hand that grasps does not push the object of another arm farther than this in one step, metres. The two objects
/// may end up side by side at the edge of the table's area.
const MAX_PUSH_M: f64 = 0.02;
/// Height by which a hand rises instead of pushing its object out of reach, metres.
const RISE_M: f64 = 0.06;

impl TrialRunner {
    /// Replaces what the policy wants of hands that would push an object out of the reach of that object's arm, or that
    /// grasp and would push the other arm's object: they rise. Grippers that grasp also [open and close when and where
    /// they should](Self::prepare_grasp).
    pub(super) fn spare_objects(
        &self,
        state: &mut LoopState,
        seen: &[ArmObservation],
        goals: &[DVec3],
        wanted: &mut WantedStep<'_>,
    ) {
        if self.task.shares_object() {
            return;
        }
        for (arm, now) in seen.iter().enumerate() {
            if self.config.layout.task.grasps() {
                self.prepare_grasp(arm, state, now, wanted);
            }
            let to = &mut wanted.hands[arm];
            let across = self.across(arm, state);
            let moves_away =
                |other| other != arm && self.pushes_from_its_arm([arm, other], seen, *to, across);
            if self.pushes_out_of_reach(now, *to, goals[arm]) || (0..seen.len()).any(moves_away) {
                *to = self.mapping.reachable_hand(now.hand + DVec3::Z * RISE_M);
                state.velocities[arm] = DVec3::ZERO;
            }
        }
    }

    /// Returns whether a hand that moves `to` (arm frame, metres) would push its object to where no hand can follow. A
    /// policy that pushes may do so toward the object's `goal`, arm frame, metres.
    fn pushes_out_of_reach(&self, now: &ArmObservation, to: DVec3, goal: DVec3) -> bool {
        let top_m = now.object.z + self.config.trained_half_m;
        let to_object = (now.object - now.hand).truncate();
        let displacement = (to - now.hand).truncate();
        if now.hand.z.min(to.z) >= top_m
            || to_object.length() < BETWEEN_PADS_DISTANCE_M
            || displacement.dot(to_object) <= 0.0
        {
            return false;
        }
        let to_goal = (goal - now.object).truncate();
        if !self.config.layout.task.grasps() && (to_goal - displacement).length() < to_goal.length()
        {
            return false;
        }
        let ahead = (to_object.normalize() * (PUSHING_DISTANCE_M + self.behind_m())).extend(0.0);
        let beyond =
            |hand: DVec3| beyond_m(hand + ahead, self.mapping.reachable_hand(hand + ahead));
        beyond(to) > beyond(now.hand) + REACH_EXCESS_M
    }

    /// Returns whether the hand of the first arm, a pad of its open gripper or what it holds would push the object of
    /// the other arm where it [should not](Self::disturbs) if it moves `to`, frame of the first arm, metres. `across`
    /// is the direction across the closing direction of its gripper.
    fn pushes_from_its_arm(
        &self,
        arms: [usize; 2],
        seen: &[ArmObservation],
        to: DVec3,
        across: DVec3,
    ) -> bool {
        let now = &seen[arms[0]];
        let half_m = self.config.trained_half_m;
        if (now.object - now.hand).length() < HELD_DISTANCE_M {
            let lowest = DVec3::NEG_Z * half_m;
            let path = [now.hand, to].map(|hand| hand + lowest);
            return self.disturbs(arms, seen, path, 2.0 * half_m);
        }
        let pad = DVec3::new(-across.y, across.x, 0.0) * (now.opening_m + PAD_HALF_THICKNESS_M);
        let pads = if self.config.layout.task.grasps() { vec![pad, -pad] } else { Vec::new() };
        std::iter::once(DVec3::ZERO)
            .chain(pads)
            .any(|part| self.disturbs(arms, seen, [now.hand + part, to + part], PUSHING_DISTANCE_M))
    }

    /// Returns whether something of the first arm that moves between two positions, arm frame, metres, with objects
    /// `ahead_m` metres ahead of it, would push the object of the other arm to where that arm's hand cannot follow. A
    /// gripper that grasps should not push it [at all](MAX_PUSH_M) either.
    fn disturbs(
        &self,
        [arm, other]: [usize; 2],
        seen: &[ArmObservation],
        [from, to]: [DVec3; 2],
        ahead_m: f64,
    ) -> bool {
        let others = seen[other].object;
        let object = self.mapping.object_in_world(ArmIndex(other), others);
        let object = self.mapping.object_in_arm(ArmIndex(arm), object);
        let lowest_m = from.z.min(to.z);
        let half_m = self.config.trained_half_m;
        let to_object = (object - from).truncate();
        let displacement = (to - from).truncate();
        let aside_m = displacement.normalize_or_zero().perp_dot(to_object).abs();
        let gap_m = to_object.length() - ahead_m;
        if lowest_m >= object.z + half_m
            || displacement.dot(to_object) <= 0.0
            || aside_m > ahead_m
            || gap_m > displacement.length()
        {
            return false;
        }
        let moved = (displacement - displacement.normalize_or_zero() * gap_m.max(0.0)).extend(0.0);
        if self.config.layout.task.grasps() && moved.length() > MAX_PUSH_M {
            return true;
        }
        let then = self.mapping.object_in_world(ArmIndex(arm), object + moved);
        let then = self.mapping.object_in_arm(ArmIndex(other), then);
        let behind = (then - others).normalize_or_zero() * self.behind_m();
        let beyond = |position: DVec3| {
            beyond_m(position + behind, self.mapping.reachable_hand(position + behind))
        };
        beyond(then) > beyond(others) + REACH_EXCESS_M
    }

    /// Distance behind an object at which a hand has to be to bring the object back, metres: a policy that pushes gets
    /// behind it, one that grasps goes to it.
    fn behind_m(&self) -> f64 {
        if self.config.layout.task.grasps() { 0.0 } else { PUSHING_DISTANCE_M }
    }
}

/// Returns by how far `position` is beyond what hands reach according to `reachable`, horizontally, metres.
fn beyond_m(position: DVec3, reachable: DVec3) -> f64 {
    (position - reachable).truncate().length()
}

#[cfg(test)]
pub(super) mod tests {
    use glam::DQuat;
    use tandem_core::Task;

    use super::*;
    use crate::trial::{TrialMode, test_config};

    pub(crate) fn seen(hand: DVec3, object: DVec3) -> ArmObservation {
        ArmObservation {
            hand,
            hand_velocity: DVec3::ZERO,
            opening_m: 0.05,
            object,
            orientation: DQuat::IDENTITY,
        }
    }

    pub(crate) fn runner(task: Task) -> TrialRunner {
        TrialRunner::new(test_config(task, TrialMode::ClosedLoop, 1)).unwrap()
    }

    /// What becomes of a step that closes the gripper from 5 to 3 cm on each side, with goals near the bases.
    pub(crate) fn spared(task: Task, now: ArmObservation, to: DVec3) -> (DVec3, f64) {
        spared_toward(DVec3::ZERO, task, now, to)
    }

    fn spared_toward(goal: DVec3, task: Task, now: ArmObservation, to: DVec3) -> (DVec3, f64) {
        let mut runner = runner(task);
        let start = runner.start(0).unwrap();
        let joint_angles = runner.mapping.cell().ready(0.2).unwrap();
        let mut state = LoopState::new(&start, &joint_angles);
        state.openings_m = vec![0.05; 2];
        let mut wanted = WantedStep { hands: vec![to; 2], openings_m: vec![0.03; 2], blocks: &[] };
        runner.spare_objects(&mut state, &[now, now], &[goal; 2], &mut wanted);
        assert_eq!(wanted.hands[0], wanted.hands[1]);
        (wanted.hands[0], wanted.openings_m[0])
    }

    #[test]
    fn a_hand_rises_instead_of_pushing_the_other_arms_object_with_a_pad() {
        let pushed = |task, above_m: f64| {
            let mut runner = runner(task);
            let start = runner.start(0).unwrap();
            let joint_angles = runner.mapping.cell().ready(0.2).unwrap();
            let mut state = LoopState::new(&start, &joint_angles);
            let across = runner.across(0, &state);
            let pad = DVec3::new(-across.y, across.x, 0.0) * 0.055;
            let hand = DVec3::new(0.1, 0.0, 0.03 + above_m);
            // In front of one of the pads.
            let object = (hand + across * 0.06 + pad).with_z(0.03);
            let others = runner.mapping.object_in_world(ArmIndex(0), object);
            let others = runner.mapping.object_in_arm(ArmIndex(1), others);
            let now =
                [seen(hand, hand - DVec3::X * 0.3), seen(DVec3::new(0.0, -0.15, 0.2), others)];
            let to = hand + across * 0.04;
            let mut wanted =
                WantedStep { hands: vec![to, now[1].hand], openings_m: vec![0.05; 2], blocks: &[] };
            runner.spare_objects(&mut state, &now, &[DVec3::ZERO; 2], &mut wanted);
            wanted.hands[0].z > hand.z + 0.05
        };
        assert!(pushed(Task::SharedPickAndPlace, 0.0));
        assert!(!pushed(Task::SharedPickAndPlace, 0.1), "above the object");
        assert!(!pushed(Task::SharedPush, 0.0), "a policy that pushes has a closed gripper");
    }

    #[test]
    fn a_hand_rises_instead_of_pushing_an_object_out_of_its_arms_reach() {
        let mut runner = runner(Task::SharedPickAndPlace);
        let start = runner.start(0).unwrap();
        let joint_angles = runner.mapping.cell().ready(0.2).unwrap();
        let mut state = LoopState::new(&start, &joint_angles);
        // As far from the second arm as its hand reaches, seen from the first arm, toward whose base the hand moves.
        let farthest = runner.mapping.reachable_hand(DVec3::new(1.0, 0.0, 0.03));
        let in_world = runner.mapping.object_in_world(ArmIndex(1), farthest);
        let seen_by_first = runner.mapping.object_in_arm(ArmIndex(0), in_world);
        let hand = seen_by_first + DVec3::X * 0.05;
        let away = DVec3::new(0.1, 0.15, 0.03);
        let mut moved = |to: DVec3| {
            let now = [seen(hand, away), seen(DVec3::new(0.0, -0.15, 0.2), farthest)];
            let mut wanted =
                WantedStep { hands: vec![to, now[1].hand], openings_m: vec![0.05; 2], blocks: &[] };
            runner.spare_objects(&mut state, &now, &[DVec3::ZERO; 2], &mut wanted);
            wanted.hands[0]
        };
        let pushing = hand - DVec3::X * 0.04;
        assert!(moved(pushing).z > hand.z + 0.05, "toward the first arm");
        let beside = hand + DVec3::Y * 0.04;
        assert_eq!(moved(beside), beside);
        let back = hand + DVec3::X * 0.04;
        assert_eq!(moved(back), back);
    }

    #[test]
    fn a_hand_rises_instead_of_pushing_its_object_out_of_reach() {
        let farthest_m =
            runner(Task::SharedPickAndPlace).mapping.reachable_hand(DVec3::new(1.0, 0.0, 0.03)).x;
        let hand = DVec3::new(farthest_m - 0.07, 0.0, 0.03);
        let object = hand + DVec3::X * 0.03;
        let outward = hand + DVec3::X * 0.04;
        let step = |now, to| spared(Task::SharedPickAndPlace, now, to).0;
        let risen = step(seen(hand, object), outward);
        assert!(risen.z > hand.z + 0.05 && (risen.x - hand.x).abs() < 0.01, "{risen}");
        let inward = hand - DVec3::X * 0.04;
        assert_eq!(step(seen(hand, object), inward), inward);
        let above = DVec3::Z * 0.1;
        assert_eq!(step(seen(hand + above, object), outward + above), outward + above);
        let shift = DVec3::X * 0.15;
        let central = outward - shift;
        assert_eq!(step(seen(hand - shift, object - shift), central).z, central.z);
        // A policy that pushes has to get behind the object, and may push it to its goal.
        let push =
            |goal, now| spared_toward(goal, Task::SharedPush, now, now.hand + DVec3::X * 0.04).0;
        let nearer = |by_m: f64| seen(hand - DVec3::X * by_m, object - DVec3::X * by_m);
        assert!(push(DVec3::ZERO, nearer(0.02)).z > hand.z + 0.05);
        assert_eq!(push(DVec3::ZERO, nearer(0.15)).z, hand.z);
        assert_eq!(push(DVec3::X * 0.3, nearer(0.02)).z, hand.z);
    }
}
