//! The sparse reward: 0 if the goal is achieved, −1 otherwise.
//!
//! A [`TaskSpec`](crate::TaskSpec) has the reward of any task. The functions that take a [`Layout`] or no task at all
//! are those of the built-in tasks, for programs that step the simulator themselves.

use crate::layout::{GOAL_TOLERANCE_M, Layout};

/// The reward of a step after which the goal is not achieved.
pub const REWARD_PENDING: f32 = -1.0;
/// The reward of a step after which the goal is achieved.
pub const REWARD_ACHIEVED: f32 = 0.0;

/// Returns the Euclidean distance between two points of any dimension, in the points' unit.
///
/// # Panics
/// If the points differ in dimension.
#[must_use]
pub fn distance(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len(), "points of different dimension");
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f32>().sqrt()
}

/// Returns the sparse reward `−(‖achieved − desired‖ > ε)` of the built-in tasks (sections 2.3 and 4.1 of the paper).
///
/// `ε` is [`GOAL_TOLERANCE_M`]. Given the goals of all arms, shape `[n_goal]`, the result is the joint reward; given
/// those of one arm, it is the arm's own reward.
///
/// # Panics
/// If the two goals differ in length.
#[must_use]
pub fn sparse_reward(achieved: &[f32], desired: &[f32]) -> f32 {
    sparse_reward_within(GOAL_TOLERANCE_M, distance(achieved, desired))
}

/// Returns the sparse reward at this distance from a goal, for any tolerance in the same unit. At NaN the goal is not
/// achieved.
#[must_use]
pub fn sparse_reward_within(tolerance: f32, distance: f32) -> f32 {
    if distance <= tolerance { REWARD_ACHIEVED } else { REWARD_PENDING }
}

/// Returns `true` if every object is within [`GOAL_TOLERANCE_M`] of its goal.
///
/// `observation` has shape `[n_observation]`, `goal` shape `[n_goal]`. An episode is a success if this holds after its
/// last step. With several arms the criterion is weaker than a joint reward of 0. Tasks whose arms share an object ask
/// for more: see [`TaskSpec::is_success`](crate::TaskSpec::is_success).
///
/// # Panics
/// If a slice is too short for `layout`.
#[must_use]
pub fn is_success(layout: Layout, observation: &[f32], goal: &[f32]) -> bool {
    layout.arms().all(|arm| {
        let object = &observation[layout.achieved_goal_of(arm)];
        distance(object, &goal[layout.goal_of(arm)]) <= GOAL_TOLERANCE_M
    })
}

/// Returns the goal that `observation` achieves: the positions of all objects, in arm order, arm frames, metres, shape
/// `[n_goal]`. This is `f_g` of the paper (section 2.3).
///
/// # Panics
/// The iterator panics if `observation` is too short for `layout`.
pub fn achieved_goal(layout: Layout, observation: &[f32]) -> impl Iterator<Item = f32> {
    layout.arms().flat_map(move |arm| observation[layout.achieved_goal_of(arm)].iter().copied())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layout::Task;
    use crate::task::TaskSpec;

    #[test]
    fn the_reward_changes_at_the_tolerance() {
        assert_eq!(sparse_reward(&[0.0, 0.0, 0.049], &[0.0; 3]), REWARD_ACHIEVED);
        assert_eq!(sparse_reward(&[0.0, 0.0, 0.051], &[0.0; 3]), REWARD_PENDING);
        assert_eq!(sparse_reward_within(0.04, 0.041), REWARD_PENDING);
        assert_eq!(sparse_reward_within(0.04, 0.039), REWARD_ACHIEVED);
        assert_eq!(sparse_reward_within(0.04, f32::NAN), REWARD_PENDING);
    }

    #[test]
    fn the_joint_reward_is_stricter_than_the_reward_of_each_arm() {
        let (achieved, goal) = ([0.04, 0.0, 0.0, 0.0, 0.04, 0.0], [0.0; 6]);
        assert_eq!(sparse_reward(&achieved[..3], &goal[..3]), REWARD_ACHIEVED);
        assert_eq!(sparse_reward(&achieved[3..], &goal[3..]), REWARD_ACHIEVED);
        assert_eq!(sparse_reward(&achieved, &goal), REWARD_PENDING);
    }

    #[test]
    fn a_built_in_task_has_the_same_reward_as_data() {
        let layout = Layout::new(Task::PickAndPlace, 2);
        let task = TaskSpec::from(layout);
        let mut observation = vec![0.1; layout.n_observation()];
        let mut goal = vec![0.1; layout.n_goal()];
        for offset in [0.0, 0.03, 0.04, 0.06] {
            (observation[3], goal[4]) = (0.1 + offset, 0.1 - offset);
            let achieved: Vec<f32> = achieved_goal(layout, &observation).collect();
            assert!(task.achieved_goal(&observation).eq(achieved.iter().copied()));
            assert_eq!(task.sparse_reward(&achieved, &goal), sparse_reward(&achieved, &goal));
            let succeeds = task.is_success(&observation, &goal);
            assert_eq!(succeeds, is_success(layout, &observation, &goal));
        }
    }

    #[test]
    fn achieved_goals_are_the_positions_of_the_objects() {
        let observation: Vec<f32> = (0_u8..56).map(f32::from).collect();
        let achieved: Vec<f32> = achieved_goal(Layout::new(Task::Push, 2), &observation).collect();
        assert_eq!(achieved, [3.0, 4.0, 5.0, 31.0, 32.0, 33.0]);
    }
}
