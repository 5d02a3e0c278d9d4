//! Hindsight experience replay (section 2.3 of the paper; Andrychowicz et al. 2017, strategy "future").
//!
//! A sampled transition keeps its goal, or gets one that its episode achieved later; its reward is recomputed. With a
//! reward per arm, each arm samples its own hindsight goal; with the joint reward, all arms share one later step.

use rand_chacha::ChaCha8Rng;
use tandem_core::reward::{REWARD_ACHIEVED, sparse_reward_within};
use tandem_core::rng::{bernoulli, index};
use tandem_core::task::Part;
use tandem_core::{ArmIndex, TaskSpec};
use tandem_policy::NormalizerSnapshot;

use crate::ddpg::Batch;
use crate::replay::ReplayBuffer;

mod config;
mod hindsight;
mod rows;
mod separation;
#[cfg(test)]
mod tests;

pub use config::{ReplayConfig, RewardKind};
pub(crate) use hindsight::relabelled_goal;

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

/// A sampled transition: steps of stored episodes, with a goal and rewards of its own.
#[derive(Debug, Clone, PartialEq)]
struct SampledTransition {
    /// The step of each arm's part.
    steps: Vec<StepIndex>,
    goal: Vec<f32>,
    rewards: Vec<f32>,
    /// Whether each arm has its desired goal, not one of hindsight.
    keeps_goal: Vec<bool>,
    swapped: bool,
    reflected: bool,
    /// Whether the hands are in contact because the arms' steps, of different episodes, are combined.
    has_contact: bool,
}

/// Samples batches from a replay buffer.
#[derive(Debug)]
pub struct Sampler {
    config: ReplayConfig,
    task: TaskSpec,
    contact_cost: f32,
    intervention_cost: f32,
    /// The transition that is being sampled or written. It trades places with an element of `samples`, so that the
    /// vectors of both are reused.
    sample: SampledTransition,
    /// The sampled transitions of a batch.
    samples: Vec<SampledTransition>,
    raw_observation: Vec<f32>,
    raw_goal: Vec<f32>,
}

impl Sampler {
    /// Creates a sampler for episodes of `task`.
    #[must_use]
    pub fn new(config: &ReplayConfig, task: impl Into<TaskSpec>) -> Self {
        let task = task.into();
        let sample = SampledTransition {
            steps: vec![StepIndex { episode_idx: 0, step_idx: 0 }; task.n_arms()],
            goal: vec![0.0; task.n_goal()],
            rewards: vec![0.0; config.reward.n_heads(&task)],
            keeps_goal: vec![true; task.n_arms()],
            swapped: false,
            reflected: false,
            has_contact: false,
        };
        let (raw_observation, raw_goal) =
            (vec![0.0; task.n_observation()], vec![0.0; task.n_goal()]);
        Self {
            contact_cost: config.contact_cost,
            intervention_cost: 0.0,
            config: config.clone(),
            task,
            sample,
            samples: Vec::new(),
            raw_observation,
            raw_goal,
        }
    }

    /// Sets the cost of a contact, in units of reward, 0 or more, for the batches that follow.
    pub const fn set_contact_cost(&mut self, cost: f32) {
        self.contact_cost = cost;
    }

    /// Sets the cost of an intervention, for strategy `rlif:T` (RL via intervention feedback, Luo et al. 2023): an
    /// arm's own step before the teacher overrides it.
    ///
    /// The steps that the teacher decides keep their reward: the stored action is the executed one, the teacher's,
    /// which a cost would teach the student to avoid. An arm whose goal is replaced in hindsight keeps its recomputed
    /// reward, because the teacher's verdict is about the desired goal.
    pub const fn set_intervention_cost(&mut self, cost: f32) {
        self.intervention_cost = cost;
    }

    /// Fills every row of `batch` with a transition sampled from `buffer`. Observations and goals are normalised with
    /// `statistics`.
    ///
    /// # Panics
    /// When the buffer is empty or the batch belongs to another task.
    pub fn fill(
        &mut self,
        buffer: &ReplayBuffer,
        statistics: Statistics<'_>,
        rng: &mut ChaCha8Rng,
        batch: &mut Batch,
    ) {
        let n_rows = batch.rewards.len() / self.sample.rewards.len();
        self.sample_transitions(n_rows, buffer, rng);
        self.prefetch(buffer);
        for row in 0..n_rows {
            std::mem::swap(&mut self.sample, &mut self.samples[row]);
            self.write_row(row, buffer, statistics, batch);
        }
    }

    /// Samples the transitions of a batch of `n_rows` into `samples`, whose memory is reused.
    fn sample_transitions(&mut self, n_rows: usize, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) {
        self.samples.resize_with(n_rows, || self.sample.clone());
        for row in 0..n_rows {
            self.sample_transition(buffer, rng);
            std::mem::swap(&mut self.sample, &mut self.samples[row]);
        }
    }

    /// Samples a transition: the steps of the arms' parts, its symmetries, then goals and rewards.
    ///
    /// The order of the draws determines a run's results, so it must not change: some numbers are drawn although the
    /// settings or the task rule out their effect.
    fn sample_transition(&mut self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) {
        self.sample_steps(buffer, rng);
        self.sample.swapped =
            bernoulli(rng, self.config.arm_swap_prob) && self.task.has_interchangeable_arms();
        self.sample_reflection(buffer, rng);
        match self.config.reward {
            RewardKind::Joint => self.relabel_jointly(buffer, rng),
            RewardKind::PerArm => self.relabel_arms(buffer, rng),
        }
    }

    /// Samples one step for all arms, or two steps that two arms combine (CoDA).
    fn sample_steps(&mut self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) {
        let first = self.sample_step(buffer, rng);
        self.sample.steps.fill(first);
        self.sample.has_contact = false;
        let can_combine =
            self.config.reward == RewardKind::PerArm && self.task.has_recombinable_arms();
        if bernoulli(rng, self.config.coda_fraction) && can_combine {
            let second = self.sample_step(buffer, rng);
            if is_apart(buffer, [first, second]) {
                self.sample.steps[1] = second;
            } else if self.config.coda_contact_prob > 0.0
                && would_touch(buffer, [first, second])
                && bernoulli(rng, self.config.coda_contact_prob)
            {
                self.sample.steps[1] = second;
                self.sample.has_contact = true;
            }
        }
    }

    /// Samples whether the parts of all arms are reflected: always possible if the task's whole scene has a mirror image,
    /// otherwise only while the arms are apart.
    fn sample_reflection(&mut self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) {
        if self.config.reflection_prob == 0.0 || !self.task.has_reflection() {
            return;
        }
        let are_independent = || match self.sample.steps[..] {
            [_] => true,
            _ if self.task.has_reflected_scene() => true,
            [first, second] => {
                self.task.has_recombinable_arms() && is_apart(buffer, [first, second])
            }
            _ => false,
        };
        self.sample.reflected = bernoulli(rng, self.config.reflection_prob) && are_independent();
    }

    /// Samples a step, of an episode in which an object was displaced or of any episode.
    fn sample_step(&self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) -> StepIndex {
        // This draw belonged to a removed setting. Without it, all later draws of a run would change.
        let _: bool = bernoulli(rng, 0.0);
        let displaced = buffer.displaced_episodes();
        let from_displaced =
            bernoulli(rng, self.config.displaced_fraction) && !displaced.is_empty();
        let episode_idx = if from_displaced {
            displaced[index(rng, displaced.len())]
        } else {
            index(rng, buffer.n_episodes())
        };
        StepIndex { episode_idx, step_idx: index(rng, self.task.episode_steps()) }
    }

    /// Samples each arm's goal, or one later step for all arms if they share an object, and rewards each arm.
    fn relabel_arms(&mut self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) {
        let shared = self
            .task
            .shares_object()
            .then(|| self.sample_later_step(self.sample.steps[0], buffer, rng));
        for arm in self.task.arms() {
            let later_step = shared
                .unwrap_or_else(|| self.sample_later_step(self.sample.steps[arm.0], buffer, rng));
            self.sample.keeps_goal[arm.0] = later_step.is_none();
            self.relabel_goal(buffer, arm, later_step);
            if arm.0 == 0 {
                self.relabel_common_goal(buffer, later_step);
            }
        }
        let norm = self.task.norm();
        let common = sparse_reward_within(
            self.config.goal_tolerance_m,
            norm.of_accumulated(self.common_distance(buffer)),
        );
        for arm in self.task.arms() {
            let distance = norm.of_accumulated(self.arm_distance(buffer, arm));
            let own = sparse_reward_within(self.config.goal_tolerance_m, distance);
            let reward = if common == REWARD_ACHIEVED { own } else { common };
            self.sample.rewards[arm.0] = reward - self.intervention_cost_of(buffer, arm);
        }
    }

    /// Samples one later step for the goals of all arms, and rewards them jointly.
    fn relabel_jointly(&mut self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) {
        let later_step = self.sample_later_step(self.sample.steps[0], buffer, rng);
        self.sample.keeps_goal.fill(later_step.is_none());
        self.relabel_common_goal(buffer, later_step);
        let norm = self.task.norm();
        let mut accumulated = 0.0;
        for arm in self.task.arms() {
            self.relabel_goal(buffer, arm, later_step);
            accumulated = norm.combined(accumulated, self.arm_distance(buffer, arm));
        }
        accumulated = norm.combined(accumulated, self.common_distance(buffer));
        let distance = norm.of_accumulated(accumulated);
        let costs = self.task.arms().map(|arm| self.intervention_cost_of(buffer, arm));
        let cost = costs.fold(0.0, f32::max);
        self.sample.rewards[0] =
            sparse_reward_within(self.config.goal_tolerance_m, distance) - cost;
    }

    /// Returns the cost to `arm` of its sampled step: that of an intervention, if the teacher overrides the arm on the
    /// next step and did not on this one, and the arm has its desired goal.
    fn intervention_cost_of(&self, buffer: &ReplayBuffer, arm: ArmIndex) -> f32 {
        let StepIndex { episode_idx, step_idx } = self.sample.steps[arm.0];
        let is_last = step_idx + 1 == self.task.episode_steps();
        if self.intervention_cost == 0.0 || !self.sample.keeps_goal[arm.0] || is_last {
            return 0.0;
        }
        let is_advised = |step_idx| buffer.advised_arms(episode_idx, step_idx) >> arm.0 & 1 == 1;
        let leads_to_intervention = !is_advised(step_idx) && is_advised(step_idx + 1);
        if leads_to_intervention { self.intervention_cost } else { 0.0 }
    }

    /// Returns the share of `arm` in the distance between the goal and what is achieved after the sampled step.
    fn arm_distance(&self, buffer: &ReplayBuffer, arm: ArmIndex) -> f32 {
        let task = &self.task;
        let parts = (task.achieved_goal_of(arm), task.goal_of(arm));
        self.distance_of(buffer, self.sample.steps[arm.0], parts)
    }

    /// As [`Self::arm_distance`], for the part of the goal that is common to all arms.
    fn common_distance(&self, buffer: &ReplayBuffer) -> f32 {
        let parts = (self.task.common_achieved_goal(), self.task.common_goal());
        self.distance_of(buffer, self.sample.steps[0], parts)
    }

    fn distance_of(
        &self,
        buffer: &ReplayBuffer,
        StepIndex { episode_idx, step_idx }: StepIndex,
        (achieved, goal): (&Part, &Part),
    ) -> f32 {
        let achieved = achieved.of(buffer.observation(episode_idx, step_idx + 1));
        self.task.norm().accumulate(&achieved, &goal.of(&self.sample.goal))
    }

    /// Samples the later step whose achieved goal replaces the desired one; `None` keeps the desired goal.
    fn sample_later_step(
        &self,
        StepIndex { episode_idx, step_idx }: StepIndex,
        buffer: &ReplayBuffer,
        rng: &mut ChaCha8Rng,
    ) -> Option<usize> {
        let observation = |step_idx| buffer.observation(episode_idx, step_idx);
        hindsight::sample_later_step(&self.config, &self.task, observation, step_idx, rng)
    }

    /// Sets `arm`'s part of the goal: to what the arm achieved before `later_step`, or to the desired goal.
    fn relabel_goal(&mut self, buffer: &ReplayBuffer, arm: ArmIndex, later_step: Option<usize>) {
        let (achieved, part) = (self.task.achieved_goal_of(arm), self.task.goal_of(arm));
        let episode_idx = self.sample.steps[arm.0].episode_idx;
        write_goal(buffer, episode_idx, later_step, (achieved, part), &mut self.sample.goal);
    }

    /// As [`Self::relabel_goal`], for the part that is common to all arms.
    fn relabel_common_goal(&mut self, buffer: &ReplayBuffer, later_step: Option<usize>) {
        let (achieved, part) = (self.task.common_achieved_goal(), self.task.common_goal());
        let episode_idx = self.sample.steps[0].episode_idx;
        write_goal(buffer, episode_idx, later_step, (achieved, part), &mut self.sample.goal);
    }
}

/// Returns each arm's place and the arm whose data fills it: the arms in order, or in reverse order if they are
/// swapped.
pub(crate) fn arm_sources(
    n_arms: usize,
    swapped: bool,
) -> impl Iterator<Item = (ArmIndex, ArmIndex)> {
    (0..n_arms).map(move |place| {
        let source = if swapped { n_arms - 1 - place } else { place };
        (ArmIndex(place), ArmIndex(source))
    })
}

/// Writes the part of a stored episode's goal, or what it achieved of it before `later_step`, into `goal`.
fn write_goal(
    buffer: &ReplayBuffer,
    episode_idx: usize,
    later_step: Option<usize>,
    (achieved, part): (&Part, &Part),
    goal: &mut [f32],
) {
    match later_step {
        Some(later_step) => {
            part.copy_from(goal, achieved, buffer.observation(episode_idx, later_step));
        }
        None => part.copy_from(goal, part, buffer.goal(episode_idx)),
    }
}

/// Returns true if the hands of two arms touch after they take these steps at the same time.
fn would_touch(buffer: &ReplayBuffer, steps: [StepIndex; 2]) -> bool {
    let after = steps
        .map(|StepIndex { episode_idx, step_idx }| buffer.observation(episode_idx, step_idx + 1));
    separation::would_touch(buffer.task(), after)
}

/// Returns true if two arms cannot meet when they take these steps at the same time: neither step has a contact, and
/// the arms stay apart before and after.
fn is_apart(buffer: &ReplayBuffer, steps: [StepIndex; 2]) -> bool {
    let has_contact = |StepIndex { episode_idx, step_idx }: &StepIndex| {
        buffer.has_contact(*step_idx..step_idx + 1, *episode_idx)
    };
    if steps.iter().any(has_contact) {
        return false;
    }
    [0, 1].into_iter().all(|later| {
        let observations = steps.map(|StepIndex { episode_idx, step_idx }| {
            buffer.observation(episode_idx, step_idx + later)
        });
        separation::are_apart(buffer.task(), observations)
    })
}
