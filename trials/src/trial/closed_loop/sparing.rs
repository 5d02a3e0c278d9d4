//! Changes to the steps of a policy that grasps, which keep objects where a hand can grasp them.
//!
//! The training world's hand closes its gripper while it moves, an arm does so after each step. Pads that close too early
//! end on the edge of their object, and a hand that misses its object pushes it ahead.

use glam::DVec3;

use super::{LoopState, WantedStep};
use crate::trial::mapping::ArmObservation;
use crate::trial::runner::TrialRunner;

/// The point between the pads is at most this far above an object's centre when the pads are beside the object, metres.
const BESIDE_M: f64 = 0.015;
/// Horizontal distance from a hand to an object that it may be about to grasp, metres.
const NEAR_M: f64 = 0.08;
/// An object within this horizontal distance of a hand is between its pads, metres.
const BETWEEN_M: f64 = 0.012;
/// Distance from a hand to the centre of the object that it pushes ahead, metres.
const AHEAD_M: f64 = 0.045;
/// Distance by which a step has to bring an object farther out of reach to count, metres.
const BEYOND_M: f64 = 0.001;
/// Height by which a hand rises instead of pushing its object out of reach, metres.
const RISE_M: f64 = 0.06;

impl TrialRunner {
    /// Replaces what the policy wants: a gripper that descends to its object closes no further until its pads are beside
    /// the object, and a hand that would push its object out of reach rises.
    pub(super) fn spare_objects(
        &self,
        state: &mut LoopState,
        now: &[ArmObservation],
        wanted: &mut WantedStep<'_>,
    ) {
        if !self.config.layout.task.grasps() || self.task.shares_object() {
            return;
        }
        for (arm, now) in now.iter().enumerate() {
            let (to, opening_m) = (&mut wanted.hands[arm], &mut wanted.openings_m[arm]);
            if descends_to_object(now, *to) {
                *opening_m = opening_m.max(state.openings_m[arm]);
            }
            if self.pushes_out_of_reach(now, *to) {
                *to = self.mapping.reachable_hand(now.hand + DVec3::Z * RISE_M);
                state.velocities[arm] = DVec3::ZERO;
            }
        }
    }

    /// Returns whether a hand that moves `to` (own frame, metres) would push its object to where no hand can follow.
    fn pushes_out_of_reach(&self, now: &ArmObservation, to: DVec3) -> bool {
        let top_m = now.object.z + self.config.trained_half_m;
        let to_object = (now.object - now.hand).truncate();
        let way = (to - now.hand).truncate();
        if now.hand.z.min(to.z) >= top_m
            || to_object.length() < BETWEEN_M
            || way.dot(to_object) <= 0.0
        {
            return false;
        }
        let ahead = (to_object.normalize() * AHEAD_M).extend(0.0);
        let beyond_m = |hand: DVec3| {
            let pushed = hand + ahead;
            (pushed - self.mapping.reachable_hand(pushed)).truncate().length()
        };
        beyond_m(to) > beyond_m(now.hand) + BEYOND_M
    }
}

/// Returns whether a hand that moves `to` (own frame, metres) descends to its object and ends with its pads higher than
/// [`BESIDE_M`] above the object's centre.
fn descends_to_object(now: &ArmObservation, to: DVec3) -> bool {
    to.z < now.hand.z
        && to.z > now.object.z + BESIDE_M
        && (now.object - to).truncate().length() < NEAR_M
}

#[cfg(test)]
mod tests {
    use glam::DQuat;
    use tandem_core::Task;

    use super::*;
    use crate::trial::{TrialMode, test_config};

    fn seen(hand: DVec3, object: DVec3) -> ArmObservation {
        ArmObservation {
            hand,
            hand_velocity: DVec3::ZERO,
            opening_m: 0.05,
            object,
            turn: DQuat::IDENTITY,
        }
    }

    fn runner(task: Task) -> TrialRunner {
        TrialRunner::new(test_config(task, TrialMode::ClosedLoop, 1)).unwrap()
    }

    /// What becomes of a step that closes the gripper from 5 to 3 cm on each side.
    fn spared(task: Task, now: ArmObservation, to: DVec3) -> (DVec3, f64) {
        let mut runner = runner(task);
        let start = runner.start(0).unwrap();
        let at = runner.mapping.cell().ready(0.2).unwrap();
        let mut state = LoopState::new(&start, &at);
        state.openings_m = vec![0.05; 2];
        let mut wanted = WantedStep { hands: vec![to; 2], openings_m: vec![0.03; 2], blocks: &[] };
        runner.spare_objects(&mut state, &[now, now], &mut wanted);
        assert_eq!(wanted.hands[0], wanted.hands[1]);
        (wanted.hands[0], wanted.openings_m[0])
    }

    #[test]
    fn a_gripper_closes_once_its_pads_are_beside_the_object() {
        let object = DVec3::new(0.1, 0.0, 0.028);
        let step = |from_m: f64, to_m: f64| {
            let hand = object.with_z(from_m);
            spared(Task::SharedPickAndPlace, seen(hand, object), hand.with_z(to_m)).1
        };
        assert_eq!(step(0.12, 0.07), 0.05, "still above the object");
        assert_eq!(step(0.07, 0.035), 0.03, "beside the object");
        assert_eq!(step(0.07, 0.09), 0.03, "on the way up");
        let away = seen(DVec3::new(-0.05, 0.0, 0.12), object);
        let to = DVec3::new(-0.05, 0.0, 0.08);
        assert_eq!(spared(Task::SharedPickAndPlace, away, to).1, 0.03, "far from the object");
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
        assert_eq!(step(seen(hand - shift, object - shift), central), central);
        let (pushed, _) = spared(Task::SharedPush, seen(hand, object), outward);
        assert_eq!(pushed, outward, "a policy that pushes has to push");
    }
}
