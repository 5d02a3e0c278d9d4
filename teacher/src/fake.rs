//! A teacher for tests whose answers can be computed by hand.

use tandem_core::{ArmIndex, Layout, StepQuery, Task, TaskSpec};

use crate::policy::TeacherPolicy;

/// A policy whose action is the first three numbers of the observation plus the goal. The value of an action is minus
/// its squared distance from that.
pub(crate) struct FakePolicy;

const LAYOUT: Layout = Layout::new(Task::Push, 1);

impl TeacherPolicy for FakePolicy {
    fn task(&self) -> TaskSpec {
        LAYOUT.into()
    }

    fn digest(&self) -> &str {
        "fa4e"
    }

    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
        let states = observations
            .chunks_exact(LAYOUT.n_observation())
            .zip(goals.chunks_exact(LAYOUT.n_goal()));
        for ((observation, goal), action) in states.zip(actions.chunks_exact_mut(LAYOUT.n_action()))
        {
            for (axis, component) in action.iter_mut().enumerate() {
                *component = observation[axis] + goal[axis];
            }
        }
    }

    fn q(&mut self, observations: &[f32], goals: &[f32], actions: &[f32], q: &mut [f32]) {
        let mut best = vec![0.0; actions.len()];
        self.act(observations, goals, &mut best);
        for (row, q) in q.iter_mut().enumerate() {
            let part = LAYOUT.action_of(ArmIndex(row));
            let squares =
                actions[part.clone()].iter().zip(&best[part]).map(|(a, b)| (a - b) * (a - b));
            *q = -squares.sum::<f32>();
        }
    }
}

/// Returns a query of two arms with the proposed action 0. The teacher's actions are `(x, 0, 0)` and `(0, y, 0)`.
pub(crate) fn query(episode: u64, step: u32, x: f32, y: f32) -> StepQuery {
    let mut observation = vec![0.0; 56];
    observation[0] = x;
    let goal = vec![0.0, 0.0, 0.0, 0.0, y, 0.0];
    let proposed_action = vec![0.0; 6];
    StepQuery {
        episode,
        step,
        observation,
        goal,
        proposed_action,
        judged_action: None,
        payer: None,
    }
}
