//! A policy for several arms in which each arm acts without seeing the others.

use tandem_core::TaskSpec;
use tandem_core::task::Part;

use crate::error::Error;
use crate::inference::Actor;
use crate::normalizer::NormalizerSnapshot;
use crate::policy::Policy;

/// An actor whose arms do not see each other: the measure of how much a policy uses what it sees of the other arms.
///
/// Each arm's action is the policy's for an observation and a goal in which the parts of all other arms are at their
/// means, so that their normalised inputs are 0. Numbers that belong to no arm remain visible, and components of the
/// action that belong to no arm are chosen with full sight.
#[derive(Debug, Clone)]
pub struct BlindActor {
    actor: Actor,
    task: TaskSpec,
    mean_observation: Vec<f32>,
    mean_goal: Vec<f32>,
    /// The views of one observation: one row per arm, and the full view.
    observations: Vec<f32>,
    goals: Vec<f32>,
    actions: Vec<f32>,
}

impl BlindActor {
    /// Creates the blind actor of `policy`.
    ///
    /// # Errors
    /// Returns an error if a vector of the policy has the wrong length or contains an invalid number.
    pub fn new(policy: &Policy) -> Result<Self, Error> {
        let task = policy.task.clone();
        let n_views = task.n_arms() + 1;
        let NormalizerSnapshot { mean: mean_observation, .. } = &policy.observation_normalizer;
        Ok(Self {
            actor: policy.actor()?,
            mean_observation: mean_observation.clone(),
            mean_goal: policy.goal_normalizer.mean.clone(),
            observations: vec![0.0; n_views * task.n_observation()],
            goals: vec![0.0; n_views * task.n_goal()],
            actions: vec![0.0; n_views * task.n_action()],
            task,
        })
    }

    /// Writes the actions, in [−1, 1], shape `[n, n_action]`, for `observations`, shape `[n, n_observation]`, and
    /// `goals`, shape `[n, n_goal]`. As for [`Actor`], the bits of a row do not depend on the batch.
    ///
    /// # Panics
    /// If the lengths do not match the task or each other.
    pub fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
        let (n_observation, n_goal, n_action) =
            (self.task.n_observation(), self.task.n_goal(), self.task.n_action());
        let n_rows = observations.len() / n_observation;
        let lengths = (observations.len(), goals.len(), actions.len());
        let expected = (n_rows * n_observation, n_rows * n_goal, n_rows * n_action);
        assert_eq!(lengths, expected, "observations, goals or actions of another task");
        let observations = observations.chunks_exact(n_observation);
        let rows = observations.zip(goals.chunks_exact(n_goal));
        for ((observation, goal), action) in rows.zip(actions.chunks_exact_mut(n_action)) {
            self.act_on(observation, goal, action);
        }
    }

    fn act_on(&mut self, observation: &[f32], goal: &[f32], action: &mut [f32]) {
        let task = &self.task;
        let views = self.observations.chunks_exact_mut(task.n_observation());
        for (arm_idx, view) in views.enumerate() {
            let part = |arm| task.observation_of(arm);
            write_view(task, arm_idx, part, observation, &self.mean_observation, view);
        }
        for (arm_idx, view) in self.goals.chunks_exact_mut(task.n_goal()).enumerate() {
            write_view(task, arm_idx, |arm| task.goal_of(arm), goal, &self.mean_goal, view);
        }
        self.actor.act(&self.observations, &self.goals, &mut self.actions);
        let mut chosen = self.actions.chunks_exact(task.n_action());
        // The last row is the full view, which decides on components that belong to no arm.
        action.copy_from_slice(chosen.next_back().expect("one row per arm, and one more"));
        for (arm, of_arm) in task.arms().zip(chosen) {
            let part = task.action_of(arm);
            part.write(action, &part.of(of_arm));
        }
    }
}

/// Writes what arm `arm_idx` sees of `vector`: the parts of all other arms are those of `mean`. An index that no arm
/// has sees everything.
fn write_view<'a>(
    task: &TaskSpec,
    arm_idx: usize,
    part_of: impl Fn(tandem_core::ArmIndex) -> &'a Part,
    vector: &[f32],
    mean: &[f32],
    view: &mut [f32],
) {
    view.copy_from_slice(vector);
    let is_arm = arm_idx < task.n_arms();
    for other in task.arms().filter(|arm| is_arm && arm.0 != arm_idx) {
        let part = part_of(other);
        part.write(view, &part.of(mean));
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::rng::uniform;
    use tandem_core::{ArmIndex, Layout, Stream, Task, episode_rng};

    use super::*;

    const LAYOUT: Layout = Layout::new(Task::PickAndPlace, 2);

    fn draw(n: usize, stream: Stream) -> Vec<f32> {
        let mut rng = episode_rng(8, 0, stream);
        (0..n).map(|_| uniform(&mut rng, -1.0, 1.0)).collect()
    }

    /// Observation, goal and the actions of the policy with and without sight, for `n` rows.
    fn actions(policy: &Policy, n: usize) -> [Vec<f32>; 4] {
        let (observations, goals) = (
            draw(n * LAYOUT.n_observation(), Stream::Reset),
            draw(n * LAYOUT.n_goal(), Stream::Reset),
        );
        let (mut sighted, mut blind) =
            (vec![0.0; n * LAYOUT.n_action()], vec![0.0; n * LAYOUT.n_action()]);
        policy.actor().unwrap().act(&observations, &goals, &mut sighted);
        BlindActor::new(policy).unwrap().act(&observations, &goals, &mut blind);
        [observations, goals, sighted, blind]
    }

    #[test]
    fn a_policy_whose_weights_ignore_the_other_arm_acts_alike_blind_bit_for_bit() {
        let one = Policy::sample(LAYOUT.single_arm(), 1);
        let [_, _, sighted, blind] = actions(&one.replicated(&LAYOUT.into()), 9);
        let bits = |actions: &[f32]| actions.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&sighted), bits(&blind));
    }

    #[test]
    fn an_arm_sees_itself_and_the_mean_of_the_other() {
        let policy = Policy::sample(LAYOUT, 2);
        let [observation, goal, sighted, blind] = actions(&policy, 1);
        assert_ne!(sighted, blind, "the random policy depends on both arms");
        for arm in LAYOUT.arms() {
            let other = ArmIndex(1 - arm.0);
            let (mut observation, mut goal) = (observation.clone(), goal.clone());
            let (of_observation, of_goal) = (LAYOUT.observation_of(other), LAYOUT.goal_of(other));
            observation[of_observation.clone()]
                .copy_from_slice(&policy.observation_normalizer.mean[of_observation]);
            goal[of_goal.clone()].copy_from_slice(&policy.goal_normalizer.mean[of_goal]);
            let mut expected = vec![0.0; LAYOUT.n_action()];
            policy.actor().unwrap().act(&observation, &goal, &mut expected);
            let of_action = LAYOUT.action_of(arm);
            assert_eq!(blind[of_action.clone()], expected[of_action], "{arm:?}");
        }
    }

    #[test]
    fn a_row_has_the_same_bits_in_any_batch() {
        let policy = Policy::sample(LAYOUT, 2);
        let [_, _, _, several] = actions(&policy, 5);
        let [_, _, _, one] = actions(&policy, 1);
        assert_eq!(several[..LAYOUT.n_action()], one);
    }
}
