//! Changes to the steps of a policy that grasps, so that a gripper opens and closes where it should.
//!
//! The training world's hand opens and closes its gripper while it moves, an arm does so after each step. Pads that
//! close too early end on the edge of their object, pads that grasp it off its middle or close too late lose it, pads
//! that open too late push it ahead, and so does a hand that misses it.

use glam::{DVec3, EulerRot};

use super::sparing::{BETWEEN_PADS_DISTANCE_M, HELD_DISTANCE_M};
use super::{LoopState, WantedStep};
use crate::trial::mapping::ArmObservation;
use crate::trial::runner::TrialRunner;

/// The point between the pads is at most this far above an object's centre when the pads are beside the object, metres.
const BESIDE_HEIGHT_M: f64 = 0.015;
/// Horizontal distance from a hand to an object that it may be about to grasp, metres.
const APPROACH_DISTANCE_M: f64 = 0.08;
/// A hand that has been held up for this many steps is open no wider than its object needs.
const N_WIDE_STEPS: usize = 2;
/// A gripper that is further open than commanded by this much holds something, metres on each side.
const HOLDING_EXCESS_M: f64 = 0.003;
/// A gripper that is open wider than an object by this much does not hold it, metres on each side.
const EMPTY_EXCESS_M: f64 = 0.002;
/// What a narrow gripper keeps between its pads and an object, metres on each side.
const CLEARANCE_M: f64 = 0.005;
/// A hand is about to grasp its object if it ends less than this above the object's centre, metres.
const GRASP_HEIGHT_M: f64 = 0.07;
/// The object is then less than this away, horizontally, metres.
const GRASP_DISTANCE_M: f64 = 0.035;

impl TrialRunner {
    /// Replaces what the policy wants of the hand of `arm`. A gripper that descends to its object closes no further
    /// until its pads are beside the object, and one that another object has held up opens no wider than its own needs.
    /// A hand that is about to grasp goes to the middle of its object, and stays there until its gripper holds the
    /// object. One beside its object stays where it is until the object fits between its pads.
    pub(super) fn prepare_grasp(
        &self,
        arm: usize,
        state: &mut LoopState,
        now: &ArmObservation,
        wanted: &mut WantedStep<'_>,
    ) {
        let (to, opening_m) = (&mut wanted.hands[arm], &mut wanted.openings_m[arm]);
        if descends_to_object(now, *to) {
            *opening_m = opening_m.max(state.openings_m[arm]);
        }
        if self.stays_narrow(arm, state, now) {
            *opening_m = opening_m.min(self.narrow_opening_m(now));
        }
        if self.opens_beside(now, *to, *opening_m) {
            *to = now.hand;
            state.velocities[arm] = DVec3::ZERO;
        } else if self.closes_around(state.openings_m[arm], now, *opening_m) {
            *to = now.object.with_z(to.z.min(now.hand.z));
            state.velocities[arm] = DVec3::ZERO;
        } else if self.grasps(state.openings_m[arm], now, *to, *opening_m) {
            (to.x, to.y) = (now.object.x, now.object.y);
        }
    }

    /// Decides whether the gripper of `arm` is open no wider than its object needs: once another object holds it up,
    /// until it is far from its own.
    fn stays_narrow(&self, arm: usize, state: &mut LoopState, now: &ArmObservation) -> bool {
        let apart_m = (now.object - now.hand).truncate().length();
        if state.progress.n_held_up(arm) >= N_WIDE_STEPS && apart_m < GRASP_DISTANCE_M {
            state.narrow[arm] = true;
        } else if apart_m > 2.0 * GRASP_DISTANCE_M {
            state.narrow[arm] = false;
        }
        state.narrow[arm]
    }

    /// The opening between which the object fits as it is rotated, metres on each side.
    fn narrow_opening_m(&self, now: &ArmObservation) -> f64 {
        let (sin, cos) = libm::sincos(now.orientation.to_euler(EulerRot::ZYX).0);
        (sin.abs() + cos.abs()) * self.config.trained_half_m + CLEARANCE_M
    }

    /// Returns whether a hand whose gripper is open, commanded to `commanded_m`, is about to grasp its object if it
    /// moves `to` (arm frame, metres) with an opening of `opening_m`.
    fn grasps(&self, commanded_m: f64, now: &ArmObservation, to: DVec3, opening_m: f64) -> bool {
        self.is_empty(commanded_m, now)
            && (to.z < now.hand.z || opening_m < commanded_m)
            && to.z < now.object.z + GRASP_HEIGHT_M
            && ((now.object - to).truncate().length() < GRASP_DISTANCE_M
                || (now.object - now.hand).truncate().length() < BETWEEN_PADS_DISTANCE_M)
    }

    /// Returns whether the object is between the pads of a gripper that is commanded to `commanded_m` and closes to
    /// `opening_m`, metres, but does not hold it yet.
    fn closes_around(&self, commanded_m: f64, now: &ArmObservation, opening_m: f64) -> bool {
        let to_object = now.object - now.hand;
        opening_m < commanded_m
            && self.is_empty(commanded_m, now)
            && to_object.truncate().length() < BETWEEN_PADS_DISTANCE_M
            && to_object.z.abs() < BESIDE_HEIGHT_M
    }

    /// Returns whether a gripper commanded to `commanded_m` (metres on each side) is wider open than its object and
    /// holds nothing.
    fn is_empty(&self, commanded_m: f64, now: &ArmObservation) -> bool {
        now.opening_m > self.config.trained_half_m + EMPTY_EXCESS_M && !holds(commanded_m, now)
    }

    /// Returns whether a gripper beside its object opens, to `opening_m` metres, and is not open wide enough yet for a
    /// hand that moves `to` (arm frame, metres) the object.
    fn opens_beside(&self, now: &ArmObservation, to: DVec3, opening_m: f64) -> bool {
        let to_object = now.object - now.hand;
        opening_m > now.opening_m
            && now.opening_m < self.narrow_opening_m(now)
            && to_object.z.abs() < self.config.trained_half_m
            && (BETWEEN_PADS_DISTANCE_M..APPROACH_DISTANCE_M)
                .contains(&to_object.truncate().length())
            && (to - now.hand).truncate().dot(to_object.truncate()) > 0.0
    }

    /// Returns what the arms observe, with the opening that a gripper has in the training world if it holds an object.
    pub(super) fn held_as_in_training(
        &self,
        now: &[ArmObservation],
        state: &LoopState,
    ) -> Vec<ArmObservation> {
        let mut seen = now.to_vec();
        if self.config.layout.task.grasps() && !self.task.shares_object() {
            for (seen, commanded_m) in seen.iter_mut().zip(&state.openings_m) {
                let is_near = (seen.object - seen.hand).truncate().length() < HELD_DISTANCE_M;
                if is_near && holds(*commanded_m, seen) {
                    seen.opening_m = seen.opening_m.min(self.config.trained_half_m);
                }
            }
        }
        seen
    }
}

/// Returns whether a gripper commanded to `commanded_m` (metres on each side) holds something.
fn holds(commanded_m: f64, now: &ArmObservation) -> bool {
    commanded_m < now.opening_m - HOLDING_EXCESS_M
}

/// Returns whether a hand that moves `to` (arm frame, metres) descends to its object and ends with its pads higher than
/// [`BESIDE_HEIGHT_M`] above the object's centre.
fn descends_to_object(now: &ArmObservation, to: DVec3) -> bool {
    to.z < now.hand.z
        && to.z > now.object.z + BESIDE_HEIGHT_M
        && (now.object - to).truncate().length() < APPROACH_DISTANCE_M
}

#[cfg(test)]
mod tests {
    use glam::DQuat;
    use tandem_core::Task;

    use super::super::sparing::tests::{runner, seen, spared};
    use super::*;

    #[test]
    fn a_hand_that_descends_off_centre_to_its_object_ends_above_its_centre() {
        let object = DVec3::new(0.1, 0.0, 0.028);
        let off = DVec3::new(0.02, -0.02, 0.0);
        let high = object.with_z(0.1) + off;
        let step = |task, now, to| spared(task, now, to).0;
        let pick = Task::SharedPickAndPlace;
        assert_eq!(step(pick, seen(high, object), high.with_z(0.06)), object.with_z(0.06));
        assert_eq!(step(Task::SharedPush, seen(high, object), high.with_z(0.06)).x, high.x);
        let far = DVec3::X * 0.05;
        let elsewhere = (high + far).with_z(0.06);
        assert_eq!(step(pick, seen(high + far, object), elsewhere), elsewhere);
        let holding = ArmObservation { opening_m: 0.054, ..seen(object + off, object) };
        let dragged = object + 0.5 * off;
        assert_eq!(step(pick, holding, dragged), dragged, "it holds the object");
    }

    #[test]
    fn a_hand_stays_at_its_object_until_its_gripper_holds_it() {
        let object = DVec3::new(0.1, 0.0, 0.028);
        let away = object + DVec3::new(-0.05, -0.02, 0.04);
        let step = |now, to| spared(Task::SharedPickAndPlace, now, to).0;
        assert_eq!(step(seen(object, object), away), object);
        let held = ArmObservation { opening_m: 0.054, ..seen(object, object) };
        assert_eq!(step(held, away), away);
        let beside = object - DVec3::X * 0.03;
        let back = beside - DVec3::X * 0.03;
        assert_eq!(step(seen(beside, object), back), back, "the object is not between the pads");
        let above = object.with_z(0.1);
        let descending = away.with_z(0.06);
        let centred = object.with_z(descending.z);
        assert_eq!(step(seen(above, object), descending), centred, "above its object");
    }

    #[test]
    fn a_hand_beside_its_object_waits_until_its_gripper_is_open() {
        let object = DVec3::new(0.1, 0.0, 0.028);
        let hand = object - DVec3::X * 0.07;
        let (toward, back) = (hand + DVec3::X * 0.03, hand - DVec3::X * 0.03);
        let step = |opening_m: f64, now, to| {
            let now = ArmObservation { opening_m, ..now };
            spared(Task::SharedPickAndPlace, now, to).0
        };
        // The gripper opens to 3 cm on each side.
        let beside = seen(hand, object);
        assert_eq!(step(0.02, beside, toward), hand);
        assert_eq!(step(0.02, beside, back), back);
        assert_eq!(step(0.05, beside, toward), toward, "it closes");
        let above = seen(hand + DVec3::Z * 0.05, object);
        assert_eq!(step(0.02, above, toward), toward);
    }

    #[test]
    fn a_held_object_looks_as_in_the_training_world() {
        let mut runner = runner(Task::SharedPickAndPlace);
        let start = runner.start(0).unwrap();
        let joint_angles = runner.mapping.cell().ready(0.2).unwrap();
        let mut state = LoopState::new(&start, &joint_angles);
        let half_m = runner.config.trained_half_m;
        let object = DVec3::new(0.1, 0.0, 0.03);
        // Held by two edges, so that the gripper is further open than the object is wide.
        let held = ArmObservation { opening_m: 1.4 * half_m, ..seen(object, object) };
        let mut opening_m = |commanded_m: f64, now: ArmObservation| {
            state.openings_m = vec![commanded_m; 2];
            runner.held_as_in_training(&[now, now], &state)[1].opening_m
        };
        assert_eq!(opening_m(0.0, held), half_m);
        assert_eq!(opening_m(1.4 * half_m, held), 1.4 * half_m, "it does not press");
        let away = ArmObservation { hand: object + DVec3::X * 0.05, ..held };
        assert_eq!(opening_m(0.0, away), 1.4 * half_m, "it presses on something else");
    }

    #[test]
    fn a_gripper_that_another_object_holds_up_becomes_narrow() {
        let mut runner = runner(Task::SharedPickAndPlace);
        let start = runner.start(0).unwrap();
        let joint_angles = runner.mapping.cell().ready(0.2).unwrap();
        let mut state = LoopState::new(&start, &joint_angles);
        let object = DVec3::new(0.1, 0.0, 0.03);
        let above = seen(object.with_z(0.1), object);
        let mut opening_m = |now: ArmObservation| {
            state.openings_m = vec![0.06; 2];
            state.progress.hold_up(vec![true, false]);
            state.progress.see(&[object; 2], &[true; 2]);
            let mut wanted =
                WantedStep { hands: vec![now.hand; 2], openings_m: vec![0.06; 2], blocks: &[] };
            runner.spare_objects(&mut state, &[now, now], &[DVec3::ZERO; 2], &mut wanted);
            wanted.openings_m
        };
        assert_eq!(opening_m(above), [0.06, 0.06], "held up once");
        let narrow_m = runner.config.trained_half_m + CLEARANCE_M;
        assert_eq!(opening_m(above), [narrow_m, 0.06]);
        let yaw = DQuat::from_rotation_z(std::f64::consts::FRAC_PI_4);
        let wider_m = opening_m(ArmObservation { orientation: yaw, ..above })[0];
        assert!((wider_m - CLEARANCE_M - 2.0_f64.sqrt() * (narrow_m - CLEARANCE_M)).abs() < 1e-9);
        let away = ArmObservation { hand: above.hand + DVec3::X * 0.1, ..above };
        assert_eq!(opening_m(away), [0.06, 0.06]);
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
}
