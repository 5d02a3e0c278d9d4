//! The rows of a batch: prefetch of the sampled observations, and normalised inputs, actions and rewards.

use tandem_core::{ArmIndex, Contacts};

use super::{Sampler, Statistics, StepIndex, arm_sources};
use crate::ddpg::Batch;
use crate::replay::ReplayBuffer;

impl Sampler {
    /// Reads the observations of all sampled transitions into the caches. A buffer is larger than the caches, and
    /// processors wait for many independent reads at once, but for few at a time while rows are copied one by one.
    pub(super) fn prefetch(&self, buffer: &ReplayBuffer) {
        /// Numbers of a cache line.
        const LINE: usize = 16;
        let mut read = 0.0;
        for StepIndex { episode_idx, step_idx } in self.samples.iter().flat_map(|s| &s.steps) {
            for later in 0..2 {
                let observation = buffer.observation(*episode_idx, step_idx + later);
                read += observation.iter().step_by(LINE).sum::<f32>();
            }
        }
        std::hint::black_box(read);
    }

    /// Writes the transition in `sample` into row `row` of `batch`.
    pub(super) fn write_row(
        &mut self,
        row: usize,
        buffer: &ReplayBuffer,
        statistics: Statistics<'_>,
        batch: &mut Batch,
    ) {
        let row_of = |n: usize| row * n..(row + 1) * n;
        let inputs = row_of(self.task.n_observation() + self.task.n_goal());
        let actions = row_of(self.task.n_action());
        let rewards = row_of(self.sample.rewards.len());
        self.write_input(buffer, 0, statistics, &mut batch.inputs[inputs.clone()]);
        self.write_input(buffer, 1, statistics, &mut batch.next_inputs[inputs]);
        self.write_action(buffer, &mut batch.actions[actions.clone()], &mut batch.bc_mask[actions]);
        self.write_rewards(buffer, &mut batch.rewards[rewards]);
    }

    /// Writes the normalised observation, `later` steps after the sampled ones, and the normalised goal.
    fn write_input(
        &mut self,
        buffer: &ReplayBuffer,
        later: usize,
        statistics: Statistics<'_>,
        input: &mut [f32],
    ) {
        let (normalized_observation, normalized_goal) =
            input.split_at_mut(self.task.n_observation());
        let task = &self.task;
        for (to, from) in arm_sources(task.n_arms(), self.sample.swapped) {
            let StepIndex { episode_idx, step_idx } = self.sample.steps[from.0];
            let observation = buffer.observation(episode_idx, step_idx + later);
            if self.sample.reflected {
                task.reflect_observation(to, from, observation, &mut self.raw_observation);
                task.reflect_goal(to, from, &self.sample.goal, &mut self.raw_goal);
                continue;
            }
            let (part, source) = (task.observation_of(to), task.observation_of(from));
            part.copy_from(&mut self.raw_observation, source, observation);
            let (part, source) = (task.goal_of(to), task.goal_of(from));
            part.copy_from(&mut self.raw_goal, source, &self.sample.goal);
        }
        let StepIndex { episode_idx, step_idx } = self.sample.steps[0];
        let (common, observation) =
            (task.common_observation(), buffer.observation(episode_idx, step_idx + later));
        common.copy_from(&mut self.raw_observation, common, observation);
        let common = task.common_goal();
        common.copy_from(&mut self.raw_goal, common, &self.sample.goal);
        statistics.observation.normalize(&self.raw_observation, normalized_observation);
        statistics.goal.normalize(&self.raw_goal, normalized_goal);
    }

    /// Writes the executed action, and the mask of its components that are cloned.
    fn write_action(&self, buffer: &ReplayBuffer, actions: &mut [f32], bc_mask: &mut [f32]) {
        for (to, from) in arm_sources(self.task.n_arms(), self.sample.swapped) {
            let StepIndex { episode_idx, step_idx } = self.sample.steps[from.0];
            let action = buffer.action(episode_idx, step_idx);
            if self.sample.reflected {
                self.task.reflect_action(to, from, action, actions);
            } else {
                self.task.action_of(to).copy_from(actions, self.task.action_of(from), action);
            }
            let is_advised = buffer.advised_arms(episode_idx, step_idx) >> from.0 & 1 == 1;
            let foresight = self.config.contact_foresight_steps;
            let leads_to_contact =
                self.sample.has_contact || self.has_contact_within(buffer, from, foresight);
            let is_cloned = is_advised && !leads_to_contact;
            self.task.action_of(to).fill(bc_mask, if is_cloned { 1.0 } else { 0.0 });
        }
    }

    /// Returns true if `arm` touches another arm or the table on one of `n_steps` steps from its sampled one on.
    fn has_contact_within(&self, buffer: &ReplayBuffer, arm: ArmIndex, n_steps: usize) -> bool {
        let StepIndex { episode_idx, step_idx } = self.sample.steps[arm.0];
        let end = (step_idx + n_steps).min(self.task.episode_steps());
        buffer.has_contact_of(arm, step_idx..end, episode_idx)
    }

    /// Writes the rewards, one per head, less the costs of contacts.
    fn write_rewards(&self, buffer: &ReplayBuffer, rewards: &mut [f32]) {
        let (n_arms, n_heads) = (self.task.n_arms(), rewards.len());
        rewards.copy_from_slice(&self.sample.rewards);
        for (head, reward) in rewards.iter_mut().enumerate() {
            let arms = if n_heads == 1 { 0..n_arms } else { head..head + 1 };
            let costs = arms.map(|arm| self.contact_cost_of(buffer, ArmIndex(arm)));
            *reward -= costs.fold(0.0, f32::max);
        }
        if self.sample.swapped && n_heads > 1 {
            rewards.reverse();
        }
    }

    /// Returns the cost to `arm` of the contacts of its sampled step.
    fn contact_cost_of(&self, buffer: &ReplayBuffer, arm: ArmIndex) -> f32 {
        let StepIndex { episode_idx, step_idx } = self.sample.steps[arm.0];
        let contacts = buffer.contacts(episode_idx, step_idx);
        let touches_arm = self.sample.has_contact || contacts.contains(Contacts::ARM_ARM);
        if touches_arm || contacts.touches_table(arm) { self.contact_cost } else { 0.0 }
    }
}
