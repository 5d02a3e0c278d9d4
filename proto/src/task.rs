//! Conversions for `task.proto`.

use tandem_core::Layout;
use tandem_core::layout::{EPISODE_STEPS, GOAL_TOLERANCE_M};

use crate::pb;

/// Encodes the description of a built-in task.
///
/// # Panics
/// If an index exceeds `u32`.
#[must_use]
pub fn encode_task(layout: Layout) -> pb::TaskDescription {
    let number = |n: usize| u32::try_from(n).expect("a task has short vectors");
    let numbers = |range: std::ops::Range<usize>| range.map(number).collect::<Vec<u32>>();
    let arm = |arm| pb::TaskArm {
        observation: numbers(layout.observation_of(arm)),
        goal: numbers(layout.goal_of(arm)),
        action: numbers(layout.action_of(arm)),
        position: vec![
            number(layout.observation_of(arm).start),
            number(layout.achieved_goal_of(arm).start),
        ],
    };
    pb::TaskDescription {
        name: layout.task.name().to_owned(),
        n_observation: number(layout.n_observation()),
        n_goal: number(layout.n_goal()),
        n_action: number(layout.n_action()),
        arms: layout.arms().map(arm).collect(),
        achieved_goal: layout
            .arms()
            .flat_map(|arm| numbers(layout.achieved_goal_of(arm)))
            .collect(),
        episode_steps: number(EPISODE_STEPS),
        tolerance: GOAL_TOLERANCE_M,
        norm: pb::Norm::Euclidean.into(),
        interchangeable_arms: true,
        reports_contacts: true,
        observation_bound: (0..layout.n_observation())
            .map(|idx| layout.observation_bound(idx))
            .collect(),
        goal_bound: vec![layout.goal_bound(); layout.n_goal()],
    }
}
