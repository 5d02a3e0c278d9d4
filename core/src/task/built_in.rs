//! The descriptions of the built-in tasks, which the simulator implements.

use super::{ArmDescription, Norm, TaskDescription};
use crate::bounds::GOAL_BOUND_M;
use crate::layout::{
    EPISODE_STEPS, GOAL_TOLERANCE_M, HAND_POSITION, Layout, OBJECT_POSITION, WORKSPACE_DISTANCE_M,
    World,
};

/// Smallest gap along x, metres, between the hands and objects of two arms whose transitions come from different steps:
/// they cannot touch. Hands move by at most 5 cm in a step of either world, and reach 3.5 cm ahead of their position.
const RECOMBINATION_GAP_M: f32 = 0.10;
/// The same in the plane, in the shared world: a hand is at most 0.12 m wide and moves up to 0.05 m per step.
const SHARED_RECOMBINATION_GAP_M: f32 = 0.16;
/// Position of each arm's base, arm frame, metres: the simulator's.
const BASE_X_M: f32 = -0.30;

impl Layout {
    /// Returns the description of the built-in task with this number of arms.
    #[must_use]
    pub fn description(self) -> TaskDescription {
        let has_several_arms = self.n_arms > 1;
        let is_shared = self.task.world() == World::Shared;
        let arm = |arm| {
            let observation = self.observation_of(arm);
            let x_of = |position: std::ops::Range<usize>| observation.start + position.start;
            let position = vec![x_of(HAND_POSITION), x_of(OBJECT_POSITION)];
            let lateral = position.iter().map(|x| x + 1).collect();
            ArmDescription {
                observation: observation.clone().collect(),
                goal: self.goal_of(arm).collect(),
                action: self.action_of(arm).collect(),
                position: if has_several_arms { position } else { Vec::new() },
                lateral: if has_several_arms && is_shared { lateral } else { Vec::new() },
            }
        };
        let if_several = |value| if has_several_arms { value } else { 0.0 };
        TaskDescription {
            name: self.task.name().to_owned(),
            n_observation: self.n_observation(),
            n_goal: self.n_goal(),
            n_action: self.n_action(),
            arms: self.arms().map(arm).collect(),
            achieved_goal: self.arms().flat_map(|arm| self.achieved_goal_of(arm)).collect(),
            episode_steps: EPISODE_STEPS,
            tolerance: GOAL_TOLERANCE_M,
            norm: Norm::Euclidean,
            interchangeable_arms: has_several_arms,
            reports_contacts: true,
            origin_distance: if_several(WORKSPACE_DISTANCE_M),
            recombination_gap: if_several(if is_shared {
                SHARED_RECOMBINATION_GAP_M
            } else {
                RECOMBINATION_GAP_M
            }),
            base: if is_shared { if_several(BASE_X_M) } else { 0.0 },
            observation_bound: (0..self.n_observation())
                .map(|idx| self.observation_bound(idx))
                .collect(),
            goal_bound: vec![GOAL_BOUND_M; self.n_goal()],
        }
    }
}
