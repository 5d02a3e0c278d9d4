//! The sparse reward: −1 until the goal is achieved, 0 when it is.

use crate::layout::{GOAL_TOLERANCE_M, Layout};

/// The reward of a step on which the goal is not achieved.
pub const REWARD_PENDING: f32 = -1.0;
/// The reward of a step on which the goal is achieved.
pub const REWARD_ACHIEVED: f32 = 0.0;

/// Euclidean distance of two points of any dimension, in their unit.
///
/// # Panics
/// When the points differ in dimension.
#[must_use]
pub fn distance(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len(), "points of different dimension");
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f32>().sqrt()
}

/// `−(‖achieved − desired‖ > ε)`, section 4.1 of the paper. Given both arms' goals it is the joint reward, given
/// one arm's it is that arm's own.
#[must_use]
pub fn sparse_reward(achieved: &[f32], desired: &[f32]) -> f32 {
    sparse_reward_within(GOAL_TOLERANCE_M, distance(achieved, desired))
}

/// The sparse reward of an object at a distance from its goal, both in metres, for another tolerance.
#[must_use]
pub fn sparse_reward_within(tolerance_m: f32, distance_m: f32) -> f32 {
    if distance_m > tolerance_m { REWARD_PENDING } else { REWARD_ACHIEVED }
}

/// The goals that an observation has achieved: every object's position, arm after arm, shape `[n_goal]`.
pub fn achieved_goal(layout: Layout, observation: &[f32]) -> impl Iterator<Item = f32> {
    layout.arms().flat_map(move |arm| observation[layout.achieved_goal_of(arm)].iter().copied())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layout::Task;

    #[test]
    fn the_reward_changes_at_the_tolerance() {
        assert_eq!(sparse_reward(&[0.0, 0.0, 0.049], &[0.0; 3]), REWARD_ACHIEVED);
        assert_eq!(sparse_reward(&[0.0, 0.0, 0.051], &[0.0; 3]), REWARD_PENDING);
        assert_eq!(sparse_reward_within(0.04, 0.041), REWARD_PENDING);
        assert_eq!(sparse_reward_within(0.04, 0.039), REWARD_ACHIEVED);
    }

    #[test]
    fn the_joint_norm_is_stricter_than_every_arm_alone() {
        let (achieved, goal) = ([0.04, 0.0, 0.0, 0.0, 0.04, 0.0], [0.0; 6]);
        assert_eq!(sparse_reward(&achieved[..3], &goal[..3]), REWARD_ACHIEVED);
        assert_eq!(sparse_reward(&achieved[3..], &goal[3..]), REWARD_ACHIEVED);
        assert_eq!(sparse_reward(&achieved, &goal), REWARD_PENDING);
    }

    #[test]
    fn achieved_goals_are_the_objects_positions() {
        let observation: Vec<f32> = (0_u8..56).map(f32::from).collect();
        let achieved: Vec<f32> = achieved_goal(Layout::new(Task::Push, 2), &observation).collect();
        assert_eq!(achieved, [3.0, 4.0, 5.0, 31.0, 32.0, 33.0]);
    }
}
