//! Hindsight experience replay (section 2.3 of the paper; Andrychowicz et al. 2017, strategy "future").
//!
//! A sampled transition keeps its goal, or gets one that its episode achieved later; its reward is recomputed. With a
//! reward per arm, each arm samples its own hindsight goal; with the joint reward, all arms share one later step.

use rand_chacha::ChaCha8Rng;
use tandem_core::layout::{
    ArmIndex, EPISODE_STEPS, HAND_POSITION, Layout, OBJECT_POSITION, WORKSPACE_DISTANCE_M,
};
use tandem_core::reward::{distance, sparse_reward_within};
use tandem_core::rng::{bernoulli, index};
use tandem_policy::NormalizerSnapshot;

use crate::ddpg::Batch;
use crate::replay::ReplayBuffer;

mod config;
#[cfg(test)]
mod tests;

pub use config::{ReplayConfig, RewardKind};

/// Smallest gap along x, metres, between the hands and objects of two arms whose transitions come from different steps:
/// they cannot touch.
const CODA_GAP_M: f32 = 0.10;

/// The statistics with which a batch is normalised.
#[derive(Debug, Clone, Copy)]
pub struct Statistics<'a> {
    /// Statistics of observations, shape `[n_observation]`.
    pub observation: &'a NormalizerSnapshot,
    /// Statistics of goals, shape `[n_goal]`.
    pub goal: &'a NormalizerSnapshot,
}

/// A step of a stored episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct StepIndex {
    episode_idx: usize,
    step_idx: usize,
}

/// A sampled transition with its goal.
#[derive(Debug, Clone, PartialEq)]
struct Relabelled {
    /// The step of each arm's part.
    steps: Vec<StepIndex>,
    goal: Vec<f32>,
    rewards: Vec<f32>,
    swapped: bool,
}

/// Samples batches from a replay buffer.
#[derive(Debug)]
pub struct Sampler {
    config: ReplayConfig,
    layout: Layout,
    sample: Relabelled,
    raw_observation: Vec<f32>,
    raw_goal: Vec<f32>,
}

impl Sampler {
    /// Creates a sampler for episodes of `layout`.
    #[must_use]
    pub fn new(config: &ReplayConfig, layout: Layout) -> Self {
        let sample = Relabelled {
            steps: vec![StepIndex { episode_idx: 0, step_idx: 0 }; layout.n_arms],
            goal: vec![0.0; layout.n_goal()],
            rewards: vec![0.0; config.reward.n_heads(layout)],
            swapped: false,
        };
        let (raw_observation, raw_goal) =
            (vec![0.0; layout.n_observation()], vec![0.0; layout.n_goal()]);
        Self { config: config.clone(), layout, sample, raw_observation, raw_goal }
    }

    /// Fills every row of `batch` with a transition sampled from `buffer`.
    ///
    /// # Panics
    /// When the buffer is empty or the batch has another layout.
    pub fn fill(
        &mut self,
        buffer: &ReplayBuffer,
        statistics: Statistics<'_>,
        rng: &mut ChaCha8Rng,
        batch: &mut Batch,
    ) {
        let n_input = self.layout.n_observation() + self.layout.n_goal();
        let (n_action, n_heads) = (self.layout.n_action(), self.sample.rewards.len());
        for row in 0..batch.rewards.len() / n_heads {
            self.sample_transition(buffer, rng);
            let row_of = |n: usize| row * n..(row + 1) * n;
            self.write_input(buffer, 0, statistics, &mut batch.inputs[row_of(n_input)]);
            self.write_input(buffer, 1, statistics, &mut batch.next_inputs[row_of(n_input)]);
            self.write_action(
                buffer,
                &mut batch.actions[row_of(n_action)],
                &mut batch.bc_mask[row_of(n_action)],
            );
            batch.rewards[row_of(n_heads)].copy_from_slice(&self.sample.rewards);
            if has_contact_within(buffer, self.sample.steps[0], 1) {
                for reward in &mut batch.rewards[row_of(n_heads)] {
                    *reward -= self.config.contact_cost;
                }
            }
            if self.sample.swapped && n_heads == 2 {
                batch.rewards[row_of(n_heads)].reverse();
            }
        }
    }

    fn sample_transition(&mut self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) {
        let first = self.sample_step(buffer, rng);
        self.sample.steps.fill(first);
        let per_arm = self.config.reward == RewardKind::PerArm && self.layout.n_arms == 2;
        if bernoulli(rng, self.config.coda_fraction) && per_arm {
            let second = self.sample_step(buffer, rng);
            if is_apart(buffer, [first, second]) {
                self.sample.steps[1] = second;
            }
        }
        self.sample.swapped = bernoulli(rng, self.config.arm_swap_prob) && self.layout.n_arms == 2;
        match self.config.reward {
            RewardKind::Joint => self.relabel_jointly(buffer, rng),
            RewardKind::PerArm => self.relabel_arms(buffer, rng),
        }
    }

    fn sample_step(&self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) -> StepIndex {
        // The draws of a run keep their place in the random stream: this one belonged to a removed setting.
        let _: bool = bernoulli(rng, 0.0);
        let displaced = buffer.displaced_episodes();
        let from_displaced =
            bernoulli(rng, self.config.displaced_fraction) && !displaced.is_empty();
        let episode_idx = if from_displaced {
            displaced[index(rng, displaced.len())]
        } else {
            index(rng, buffer.n_episodes())
        };
        StepIndex { episode_idx, step_idx: index(rng, EPISODE_STEPS) }
    }

    fn relabel_arms(&mut self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) {
        for arm in self.layout.arms() {
            let StepIndex { episode_idx, step_idx } = self.sample.steps[arm.0];
            let later_step = self.hindsight_step(step_idx, rng);
            self.take_goal(buffer, arm, later_step);
            let sample = &mut self.sample;
            let achieved = buffer.achieved(episode_idx, step_idx + 1, arm);
            let distance_m = distance(achieved, &sample.goal[self.layout.goal_of(arm)]);
            sample.rewards[arm.0] = sparse_reward_within(self.config.goal_tolerance_m, distance_m);
        }
    }

    fn relabel_jointly(&mut self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) {
        let StepIndex { episode_idx, step_idx } = self.sample.steps[0];
        let later_step = self.hindsight_step(step_idx, rng);
        let mut squared_distance = 0.0;
        for arm in self.layout.arms() {
            self.take_goal(buffer, arm, later_step);
            let achieved = buffer.achieved(episode_idx, step_idx + 1, arm);
            let goal = &self.sample.goal[self.layout.goal_of(arm)];
            squared_distance +=
                achieved.iter().zip(goal).map(|(a, g)| (a - g) * (a - g)).sum::<f32>();
        }
        self.sample.rewards[0] =
            sparse_reward_within(self.config.goal_tolerance_m, squared_distance.sqrt());
    }

    /// Samples the later step whose achieved goal replaces the desired one (strategy "future"); `None` keeps the
    /// desired goal.
    fn hindsight_step(&self, step_idx: usize, rng: &mut ChaCha8Rng) -> Option<usize> {
        let hindsight = bernoulli(rng, self.config.her_ratio);
        let later_step = step_idx + 1 + index(rng, EPISODE_STEPS - step_idx);
        hindsight.then_some(later_step)
    }

    fn take_goal(&mut self, buffer: &ReplayBuffer, arm: ArmIndex, later_step: Option<usize>) {
        let part = self.layout.goal_of(arm);
        let episode_idx = self.sample.steps[arm.0].episode_idx;
        let goal = match later_step {
            Some(later_step) => buffer.achieved(episode_idx, later_step, arm),
            None => &buffer.goal(episode_idx)[part.clone()],
        };
        self.sample.goal[part].copy_from_slice(goal);
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
            input.split_at_mut(self.layout.n_observation());
        for (to, from) in self.layout.arms().zip(self.sources()) {
            let StepIndex { episode_idx, step_idx } = self.sample.steps[from.0];
            let observation = buffer.observation(episode_idx, step_idx + later);
            self.raw_observation[self.layout.observation_of(to)]
                .copy_from_slice(&observation[self.layout.observation_of(from)]);
            self.raw_goal[self.layout.goal_of(to)]
                .copy_from_slice(&self.sample.goal[self.layout.goal_of(from)]);
        }
        statistics.observation.normalize(&self.raw_observation, normalized_observation);
        statistics.goal.normalize(&self.raw_goal, normalized_goal);
    }

    fn write_action(&self, buffer: &ReplayBuffer, actions: &mut [f32], bc_mask: &mut [f32]) {
        for (to, from) in self.layout.arms().zip(self.sources()) {
            let step @ StepIndex { episode_idx, step_idx } = self.sample.steps[from.0];
            let action = buffer.action(episode_idx, step_idx);
            actions[self.layout.action_of(to)]
                .copy_from_slice(&action[self.layout.action_of(from)]);
            let is_advised = buffer.advised_arms(episode_idx, step_idx) >> from.0 & 1 == 1;
            let foresight = self.config.contact_foresight_steps;
            let is_cloned = is_advised && !has_contact_within(buffer, step, foresight);
            bc_mask[self.layout.action_of(to)].fill(if is_cloned { 1.0 } else { 0.0 });
        }
    }

    /// Returns the arm whose data fills each place: the arms in order, or in reverse if they are swapped.
    fn sources(&self) -> impl Iterator<Item = ArmIndex> + use<> {
        let (n_arms, swapped) = (self.layout.n_arms, self.sample.swapped);
        (0..n_arms).map(move |arm| ArmIndex(if swapped { n_arms - 1 - arm } else { arm }))
    }
}

/// Returns true if an arm touches the other or the table on one of `n_steps` steps from `first` on.
fn has_contact_within(buffer: &ReplayBuffer, first: StepIndex, n_steps: usize) -> bool {
    let end = (first.step_idx + n_steps).min(EPISODE_STEPS);
    buffer.has_contact(first.step_idx..end, first.episode_idx)
}

/// Returns true if two arms cannot meet when they take these steps at the same time: neither step has a contact, and
/// the hands and objects of the arms stay apart before and after.
fn is_apart(buffer: &ReplayBuffer, steps: [StepIndex; 2]) -> bool {
    if steps.iter().any(|step| has_contact_within(buffer, *step, 1)) {
        return false;
    }
    let layout = buffer.layout();
    let reach_m = |arm: ArmIndex, later: usize| {
        let StepIndex { episode_idx, step_idx } = steps[arm.0];
        let observation = buffer.observation(episode_idx, step_idx + later);
        let of_arm = &observation[layout.observation_of(arm)];
        of_arm[HAND_POSITION.start].max(of_arm[OBJECT_POSITION.start])
    };
    [0, 1].into_iter().all(|later| {
        let reached_m = reach_m(ArmIndex(0), later) + reach_m(ArmIndex(1), later);
        WORKSPACE_DISTANCE_M - reached_m >= CODA_GAP_M
    })
}
