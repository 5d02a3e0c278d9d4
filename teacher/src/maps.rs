//! The maps between a student's vectors and those of a teacher for one arm (equations 7 to 9 of the paper), as data.
//!
//! A request contains the parts of a student's arms, concatenated in arm order. The student's own vectors may have
//! another order.

use std::ops::Range;

use tandem_core::TaskSpec;

/// The index ranges of one arm in a student's vectors.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ArmMap {
    /// The range in an observation.
    pub observation: Range<usize>,
    /// The range in a goal.
    pub goal: Range<usize>,
    /// The range in an action.
    pub action: Range<usize>,
}

/// The maps between a student's vectors and the teacher's, arm by arm.
///
/// A student with fewer arms uses the first ones. The length of its vectors determines the number of its arms.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Maps {
    arms: Vec<ArmMap>,
}

impl Maps {
    /// Creates the maps of students with up to `n_arms` arms, each of which performs the task `one` of one arm.
    #[must_use]
    pub fn new(one: &TaskSpec, n_arms: usize) -> Self {
        let range_of = |arm: usize, n: usize| arm * n..(arm + 1) * n;
        let map_of = |arm| ArmMap {
            observation: range_of(arm, one.n_observation()),
            goal: range_of(arm, one.n_goal()),
            action: range_of(arm, one.n_action()),
        };
        Self { arms: (0..n_arms).map(map_of).collect() }
    }

    /// Returns the maps of all arms, in arm order.
    #[must_use]
    pub fn arms(&self) -> &[ArmMap] {
        &self.arms
    }

    /// Returns the maps of the arms of a student whose actions have `n_action` numbers, in arm order: as many as fit.
    pub fn of_student(&self, n_action: usize) -> impl ExactSizeIterator<Item = &ArmMap> {
        let n_arms = self.arms.partition_point(|arm| arm.action.end <= n_action);
        self.arms[..n_arms].iter()
    }

    /// Composes a student's action, shape `[n_action]`, from the actions of its arms, each of shape `[action_per_arm]`:
    /// `f^a` (equation 8). Arms without an action get zeros.
    ///
    /// # Panics
    /// When the length of an arm's action differs from that of its range.
    #[must_use]
    pub fn joint_action<'a>(
        &self,
        n_action: usize,
        arm_actions: impl Iterator<Item = &'a [f32]>,
    ) -> Vec<f32> {
        let mut joint = vec![0.0; n_action];
        for (arm, action) in self.of_student(n_action).zip(arm_actions) {
            joint[arm.action.clone()].copy_from_slice(action);
        }
        joint
    }
}

impl ArmMap {
    /// Returns the arm's parts of `observation`, shape `[n_observation]`, and `goal`, shape `[n_goal]`: `f_i^sg`
    /// (equation 7).
    ///
    /// # Panics
    /// When a vector is too short for the arm's range.
    #[must_use]
    pub fn teacher_state<'a>(
        &self,
        observation: &'a [f32],
        goal: &'a [f32],
    ) -> (&'a [f32], &'a [f32]) {
        (&observation[self.observation.clone()], &goal[self.goal.clone()])
    }

    /// Returns the arm's part of `action`, shape `[n_action]`: `h_i^a` (equation 9).
    ///
    /// # Panics
    /// When the action is too short for the arm's range.
    #[must_use]
    pub fn arm_action<'a>(&self, action: &'a [f32]) -> &'a [f32] {
        &action[self.action.clone()]
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::Task;

    use super::*;

    fn ramp(n: u8) -> Vec<f32> {
        (0..n).map(f32::from).collect()
    }

    #[test]
    fn the_second_arm_has_the_second_part_of_every_vector() {
        let maps = Maps::new(&TaskSpec::built_in(Task::PickAndPlace, 1), 3);
        let (observation, goal, action) = (ramp(84), ramp(9), ramp(12));
        let (teacher_observation, teacher_goal) = maps.arms()[1].teacher_state(&observation, &goal);
        assert_eq!((teacher_observation.len(), teacher_observation[0]), (28, 28.0));
        assert_eq!(teacher_goal, [3.0, 4.0, 5.0]);
        assert_eq!(maps.arms()[1].arm_action(&action), [4.0, 5.0, 6.0, 7.0]);
    }

    #[test]
    fn composing_the_parts_of_an_action_restores_it() {
        let maps = Maps::new(&TaskSpec::built_in(Task::Push, 1), 8);
        for n_arms in 1..=8 {
            let action = ramp(3 * n_arms);
            let parts = maps.of_student(action.len()).map(|arm| arm.arm_action(&action));
            assert_eq!(parts.len(), usize::from(n_arms));
            assert_eq!(maps.joint_action(action.len(), parts), action);
        }
    }
}
