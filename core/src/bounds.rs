//! Bounds on the numbers of observations and goals.
//!
//! A number beyond its bound cannot come from a correct simulation. It would distort the running statistics that
//! normalise every later input, so the learner refuses episodes that contain one. The bounds leave room for everything
//! that can happen in an episode, such as an object that falls off the table in the 2 s of the classic world. In the
//! shared world objects fall to a floor.

use std::ops::Range;

use crate::layout::observation::{
    FINGER_OPENINGS, FINGER_RATES, HAND_POSITION, HAND_TO_OBJECT, HAND_VELOCITY,
    OBJECT_ANGULAR_VELOCITY, OBJECT_ORIENTATION, OBJECT_POSITION, OBJECT_VELOCITY,
    PER_CONTROL_STEP,
};
use crate::layout::{Layout, OBSERVATION_PER_ARM, World};

/// Bound on the magnitude of any number in any observation or goal. It applies to students of unknown origin.
pub const MAX_MAGNITUDE: f32 = 1000.0;

/// Positions of end effectors, and goals, metres. An arm reaches 0.7 m.
const REACH_M: f32 = 2.0;
/// Desired goals of the built-in tasks, metres.
pub(crate) const GOAL_BOUND_M: f32 = REACH_M;
/// Positions of objects, metres. A free fall during a whole episode of the classic world covers 20 m.
const FALL_M: f32 = 25.0;
/// Finger openings and their rates, metres and metres per control step.
const OPENING_M: f32 = 1.0;
/// Components of a unit quaternion.
const UNIT: f32 = 1.01;
/// Velocities, metres per control step of the classic world, 0.04 s: 50 m/s. Bounds of the shared world's steps are
/// larger by the ratio of the durations. Those of carry-bar, whose steps also last 0.25 s, are not: 8 m/s.
const SPEED: f32 = 2.0;
/// Angular velocities, radians per control step: 120 revolutions per second, in carry-bar 19.
const SPIN: f32 = 30.0;

/// The bounds of one arm's observation, in its order, for the tasks with an object on a table.
const TABLE_TOP: [f32; OBSERVATION_PER_ARM] = {
    let quantities: [(Range<usize>, f32); 9] = [
        (HAND_POSITION, REACH_M),
        (OBJECT_POSITION, FALL_M),
        (HAND_TO_OBJECT, FALL_M),
        (FINGER_OPENINGS, OPENING_M),
        (OBJECT_ORIENTATION, UNIT),
        (OBJECT_VELOCITY, SPEED),
        (OBJECT_ANGULAR_VELOCITY, SPIN),
        (HAND_VELOCITY, SPEED),
        (FINGER_RATES, OPENING_M),
    ];
    let mut bounds = [0.0; OBSERVATION_PER_ARM];
    let mut quantity_idx = 0;
    while quantity_idx < quantities.len() {
        let (range, bound) = &quantities[quantity_idx];
        let mut idx = range.start;
        while idx < range.end {
            bounds[idx] = *bound;
            idx += 1;
        }
        quantity_idx += 1;
    }
    bounds
};

impl Layout {
    /// Returns the largest magnitude that number `idx` of an observation can have, in the number's own unit (see
    /// `tandem_sim::Env::observe`).
    #[must_use]
    pub const fn observation_bound(self, idx: usize) -> f32 {
        let part_idx = idx % OBSERVATION_PER_ARM;
        let is_per_step = PER_CONTROL_STEP.start <= part_idx && part_idx < PER_CONTROL_STEP.end;
        // An arm's numbers have the bounds of its own task, which a teacher for that task expects.
        let world = self.task.of_one_arm().world();
        let steps = world.control_step_s() / World::Classic.control_step_s();
        if is_per_step { steps * TABLE_TOP[part_idx] } else { TABLE_TOP[part_idx] }
    }

    /// Returns the largest magnitude that a number of a desired goal can have, metres.
    #[must_use]
    pub const fn goal_bound(self) -> f32 {
        REACH_M
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layout::Task;

    #[test]
    fn every_number_of_every_arm_has_the_bound_of_its_quantity() {
        for task in Task::ALL {
            let layout = Layout::new(task, 3);
            for idx in 0..layout.n_observation() {
                let bound = layout.observation_bound(idx);
                assert!(bound > 0.0 && bound < MAX_MAGNITUDE, "number {idx}: {bound}");
                assert_eq!(bound, layout.observation_bound(idx % OBSERVATION_PER_ARM));
            }
            assert_eq!(layout.observation_bound(HAND_POSITION.start), REACH_M);
            assert_eq!(layout.observation_bound(OBJECT_POSITION.end - 1), FALL_M);
        }
    }
}
