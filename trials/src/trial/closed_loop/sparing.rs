//! Changes to the steps of a policy that keep objects where hands can grasp them or push them back.
//!
//! The training world's hand opens and closes its gripper while it moves, an arm does so after each step. Pads that close too
//! early end on the edge of their object, pads that grasp it off its middle or close too late lose it, pads that open too
//! late push it ahead, and so does a hand that misses it.

use glam::{DVec3, EulerRot};
use tandem_core::ArmIndex;

use super::{LoopState, WantedStep};
use crate::trial::mapping::ArmObservation;
use crate::trial::runner::TrialRunner;

/// The point between the pads is at most this far above an object's centre when the pads are beside the object, metres.
const BESIDE_M: f64 = 0.015;
/// Horizontal distance from a hand to an object that it may be about to grasp, metres.
const NEAR_M: f64 = 0.08;
/// An object within this horizontal distance of a hand is between its pads, metres.
const BETWEEN_M: f64 = 0.012;
/// A hand that has been held up for this many steps is open no wider than its object needs.
const N_WIDE: usize = 2;
/// A gripper that is further open than commanded by this much holds something, metres on each side.
const HOLDS_M: f64 = 0.003;
/// The centre of a held object is within this horizontal distance of the hand, metres.
const HELD_M: f64 = 0.02;
/// A gripper that is open wider than an object by this much does not hold it, metres on each side.
const OPEN_M: f64 = 0.002;
/// What a narrow gripper keeps between its pads and an object, metres on each side.
const CLEARANCE_M: f64 = 0.005;
/// A hand is about to grasp its object if it ends less than this above the object's centre, metres.
const GRASP_M: f64 = 0.07;
/// The object is then less than this away, horizontally, metres.
const OFF_CENTRE_M: f64 = 0.035;
/// Distance from a hand to the centre of the object that it pushes ahead, metres.
pub(super) const AHEAD_M: f64 = 0.045;
/// Distance from the inner side of a pad to its middle, metres.
const PAD_M: f64 = 0.005;
/// Distance by which a step has to bring an object farther out of reach to count, metres.
const BEYOND_M: f64 = 0.001;
/// A hand that grasps does not push the object of another arm farther than this in one step, metres. The two objects may end
/// up side by side at the edge of the table's area.
const MOVED_M: f64 = 0.02;
/// Height by which a hand rises instead of pushing its object out of reach, metres.
const RISE_M: f64 = 0.06;

impl TrialRunner {
    /// Replaces what the policy wants of hands that would push an object out of the reach of that object's arm, or that grasp and
    /// would push the other arm's object: they rise. Grippers that grasp also [open and close when and where they
    /// should](Self::prepare_grasp).
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

    /// Replaces what the policy wants of the hand of `arm`. A gripper that descends to its object closes no further until
    /// its pads are beside the object, and one that another object has held up opens no wider than its own needs. A hand
    /// that is about to grasp goes to the middle of its object, and stays there until its gripper holds the object. One
    /// beside its object stays where it is until the object fits between its pads.
    fn prepare_grasp(
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

    /// Decides whether the gripper of `arm` is open no wider than its object needs: once another object holds it up, until
    /// it is far from its own.
    fn stays_narrow(&self, arm: usize, state: &mut LoopState, now: &ArmObservation) -> bool {
        let apart_m = (now.object - now.hand).truncate().length();
        if state.progress.n_held_up(arm) >= N_WIDE && apart_m < OFF_CENTRE_M {
            state.narrow[arm] = true;
        } else if apart_m > 2.0 * OFF_CENTRE_M {
            state.narrow[arm] = false;
        }
        state.narrow[arm]
    }

    /// The opening between which the object fits as it is rotated, metres on each side.
    fn narrow_opening_m(&self, now: &ArmObservation) -> f64 {
        let (sin, cos) = libm::sincos(now.turn.to_euler(EulerRot::ZYX).0);
        (sin.abs() + cos.abs()) * self.config.trained_half_m + CLEARANCE_M
    }

    /// Returns whether a hand whose gripper is open, commanded to `commanded_m`, is about to grasp its object if it moves
    /// `to` (own frame, metres) with an opening of `opening_m`.
    fn grasps(&self, commanded_m: f64, now: &ArmObservation, to: DVec3, opening_m: f64) -> bool {
        now.opening_m > self.config.trained_half_m + OPEN_M
            && !holds(commanded_m, now)
            && (to.z < now.hand.z || opening_m < commanded_m)
            && to.z < now.object.z + GRASP_M
            && ((now.object - to).truncate().length() < OFF_CENTRE_M
                || (now.object - now.hand).truncate().length() < BETWEEN_M)
    }

    /// Returns whether the object is between the pads of a gripper that is commanded to `commanded_m` and closes to
    /// `opening_m`, metres, but does not hold it yet.
    fn closes_around(&self, commanded_m: f64, now: &ArmObservation, opening_m: f64) -> bool {
        let to_object = now.object - now.hand;
        opening_m < commanded_m
            && now.opening_m > self.config.trained_half_m + OPEN_M
            && !holds(commanded_m, now)
            && to_object.truncate().length() < BETWEEN_M
            && to_object.z.abs() < BESIDE_M
    }

    /// Returns whether a gripper beside its object opens, to `opening_m` metres, and is not open wide enough yet for a hand that
    /// moves `to` (own frame, metres) the object.
    fn opens_beside(&self, now: &ArmObservation, to: DVec3, opening_m: f64) -> bool {
        let to_object = now.object - now.hand;
        opening_m > now.opening_m
            && now.opening_m < self.narrow_opening_m(now)
            && to_object.z.abs() < self.config.trained_half_m
            && (BETWEEN_M..NEAR_M).contains(&to_object.truncate().length())
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
                let is_near = (seen.object - seen.hand).truncate().length() < HELD_M;
                if is_near && holds(*commanded_m, seen) {
                    seen.opening_m = seen.opening_m.min(self.config.trained_half_m);
                }
            }
        }
        seen
    }

    /// Returns whether a hand that moves `to` (own frame, metres) would push its object to where no hand can follow. A
    /// policy that pushes may do so toward the object's `goal`, own frame, metres.
    fn pushes_out_of_reach(&self, now: &ArmObservation, to: DVec3, goal: DVec3) -> bool {
        let top_m = now.object.z + self.config.trained_half_m;
        let to_object = (now.object - now.hand).truncate();
        let way = (to - now.hand).truncate();
        if now.hand.z.min(to.z) >= top_m
            || to_object.length() < BETWEEN_M
            || way.dot(to_object) <= 0.0
        {
            return false;
        }
        let to_goal = (goal - now.object).truncate();
        if !self.config.layout.task.grasps() && (to_goal - way).length() < to_goal.length() {
            return false;
        }
        let ahead = (to_object.normalize() * (AHEAD_M + self.behind_m())).extend(0.0);
        let beyond =
            |hand: DVec3| beyond_m(hand + ahead, self.mapping.reachable_hand(hand + ahead));
        beyond(to) > beyond(now.hand) + BEYOND_M
    }

    /// Returns whether the hand of the first arm, a pad of its open gripper or what it holds would push the object of the
    /// other arm where it [should not](Self::disturbs) if it moves `to`, own frame of the first arm, metres. `across` is the
    /// direction across the closing direction of its gripper.
    fn pushes_from_its_arm(
        &self,
        arms: [usize; 2],
        seen: &[ArmObservation],
        to: DVec3,
        across: DVec3,
    ) -> bool {
        let now = &seen[arms[0]];
        let half_m = self.config.trained_half_m;
        if (now.object - now.hand).length() < HELD_M {
            let lowest = DVec3::NEG_Z * half_m;
            let way = [now.hand, to].map(|hand| hand + lowest);
            return self.disturbs(arms, seen, way, 2.0 * half_m);
        }
        let pad = DVec3::new(-across.y, across.x, 0.0) * (now.opening_m + PAD_M);
        let pads = if self.config.layout.task.grasps() { vec![pad, -pad] } else { Vec::new() };
        std::iter::once(DVec3::ZERO)
            .chain(pads)
            .any(|part| self.disturbs(arms, seen, [now.hand + part, to + part], AHEAD_M))
    }

    /// Returns whether something of the first arm that moves between two positions, own frame, metres, with objects
    /// `ahead_m` metres ahead of it, would push the object of the other arm to where that arm's hand cannot follow. A
    /// gripper that grasps should not push it [at all](MOVED_M) either.
    fn disturbs(
        &self,
        [arm, other]: [usize; 2],
        seen: &[ArmObservation],
        [from, to]: [DVec3; 2],
        ahead_m: f64,
    ) -> bool {
        let others = seen[other].object;
        let object = self.mapping.object_in_world(ArmIndex(other), others);
        let object = self.mapping.object_in_own(ArmIndex(arm), object);
        let lowest_m = from.z.min(to.z);
        let half_m = self.config.trained_half_m;
        let to_object = (object - from).truncate();
        let way = (to - from).truncate();
        let aside_m = way.normalize_or_zero().perp_dot(to_object).abs();
        let gap_m = to_object.length() - ahead_m;
        if lowest_m >= object.z + half_m
            || way.dot(to_object) <= 0.0
            || aside_m > ahead_m
            || gap_m > way.length()
        {
            return false;
        }
        let moved = (way - way.normalize_or_zero() * gap_m.max(0.0)).extend(0.0);
        if self.config.layout.task.grasps() && moved.length() > MOVED_M {
            return true;
        }
        let then = self.mapping.object_in_world(ArmIndex(arm), object + moved);
        let then = self.mapping.object_in_own(ArmIndex(other), then);
        let behind = (then - others).normalize_or_zero() * self.behind_m();
        let beyond = |at: DVec3| beyond_m(at + behind, self.mapping.reachable_hand(at + behind));
        beyond(then) > beyond(others) + BEYOND_M
    }

    /// Distance behind an object at which a hand has to be to bring the object back, metres: a policy that pushes gets
    /// behind it, one that grasps goes to it.
    fn behind_m(&self) -> f64 {
        if self.config.layout.task.grasps() { 0.0 } else { AHEAD_M }
    }
}

/// Returns by how far `at` is beyond what hands reach according to `reachable`, horizontally, metres.
fn beyond_m(at: DVec3, reachable: DVec3) -> f64 {
    (at - reachable).truncate().length()
}

/// Returns whether a gripper commanded to `commanded_m` (metres on each side) holds something.
fn holds(commanded_m: f64, now: &ArmObservation) -> bool {
    commanded_m < now.opening_m - HOLDS_M
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

    /// What becomes of a step that closes the gripper from 5 to 3 cm on each side, with goals near the bases.
    fn spared(task: Task, now: ArmObservation, to: DVec3) -> (DVec3, f64) {
        spared_toward(DVec3::ZERO, task, now, to)
    }

    fn spared_toward(goal: DVec3, task: Task, now: ArmObservation, to: DVec3) -> (DVec3, f64) {
        let mut runner = runner(task);
        let start = runner.start(0).unwrap();
        let at = runner.mapping.cell().ready(0.2).unwrap();
        let mut state = LoopState::new(&start, &at);
        state.openings_m = vec![0.05; 2];
        let mut wanted = WantedStep { hands: vec![to; 2], openings_m: vec![0.03; 2], blocks: &[] };
        runner.spare_objects(&mut state, &[now, now], &[goal; 2], &mut wanted);
        assert_eq!(wanted.hands[0], wanted.hands[1]);
        (wanted.hands[0], wanted.openings_m[0])
    }

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
    fn a_hand_rises_instead_of_pushing_the_other_arms_object_with_a_pad() {
        let pushed = |task, above_m: f64| {
            let mut runner = runner(task);
            let start = runner.start(0).unwrap();
            let at = runner.mapping.cell().ready(0.2).unwrap();
            let mut state = LoopState::new(&start, &at);
            let across = runner.across(0, &state);
            let pad = DVec3::new(-across.y, across.x, 0.0) * 0.055;
            let hand = DVec3::new(0.1, 0.0, 0.03 + above_m);
            // In front of one of the pads.
            let object = (hand + across * 0.06 + pad).with_z(0.03);
            let others = runner.mapping.object_in_world(ArmIndex(0), object);
            let others = runner.mapping.object_in_own(ArmIndex(1), others);
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
        let at = runner.mapping.cell().ready(0.2).unwrap();
        let mut state = LoopState::new(&start, &at);
        // As far from the second arm as its hand reaches, seen from the first arm, toward whose base the hand moves.
        let farthest = runner.mapping.reachable_hand(DVec3::new(1.0, 0.0, 0.03));
        let in_world = runner.mapping.object_in_world(ArmIndex(1), farthest);
        let seen_by_first = runner.mapping.object_in_own(ArmIndex(0), in_world);
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
    fn a_held_object_looks_as_in_the_training_world() {
        let mut runner = runner(Task::SharedPickAndPlace);
        let start = runner.start(0).unwrap();
        let at = runner.mapping.cell().ready(0.2).unwrap();
        let mut state = LoopState::new(&start, &at);
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
        let at = runner.mapping.cell().ready(0.2).unwrap();
        let mut state = LoopState::new(&start, &at);
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
        let wider_m = opening_m(ArmObservation { turn: yaw, ..above })[0];
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
