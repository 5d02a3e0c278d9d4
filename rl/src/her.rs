//! Hindsight experience replay (section 2.3 of the paper; Andrychowicz et al. 2017, strategy "future").
//!
//! A sampled transition keeps its goal or gets one that its episode achieved later; the reward is computed anew.
//! With a reward per arm every arm draws its own hindsight goal, with the joint reward all share one moment.

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

/// How far apart along x the hands and objects of two arms are at least, metres, when the arms' transitions come from
/// different episodes: nothing can touch then.
const RECOMBINED_APART_M: f32 = 0.10;

/// The frozen statistics with which a batch is normalised.
#[derive(Debug, Clone, Copy)]
pub struct Statistics<'a> {
    /// Of observations, shape `[n_observation]`.
    pub observation: &'a NormalizerSnapshot,
    /// Of goals, shape `[n_goal]`.
    pub goal: &'a NormalizerSnapshot,
}

/// A step of a stored episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Step {
    episode_idx: usize,
    step_idx: usize,
}

/// A transition with the goal it is judged by.
#[derive(Debug, Clone, PartialEq)]
struct Relabelled {
    /// Where each arm's part comes from.
    steps: Vec<Step>,
    goal: Vec<f32>,
    rewards: Vec<f32>,
    swapped: bool,
}

/// Draws batches.
#[derive(Debug)]
pub struct Sampler {
    config: ReplayConfig,
    layout: Layout,
    drawn: Relabelled,
    raw_observation: Vec<f32>,
    raw_goal: Vec<f32>,
}

impl Sampler {
    /// A sampler for episodes of `layout`.
    #[must_use]
    pub fn new(config: &ReplayConfig, layout: Layout) -> Self {
        let drawn = Relabelled {
            steps: vec![Step { episode_idx: 0, step_idx: 0 }; layout.n_arms],
            goal: vec![0.0; layout.n_goal()],
            rewards: vec![0.0; config.reward.n_heads(layout)],
            swapped: false,
        };
        let (raw_observation, raw_goal) =
            (vec![0.0; layout.n_observation()], vec![0.0; layout.n_goal()]);
        Self { config: config.clone(), layout, drawn, raw_observation, raw_goal }
    }

    /// Fills every row of `batch` from `buffer`.
    ///
    /// # Panics
    /// When the buffer is empty or the batch is of another layout.
    pub fn fill(
        &mut self,
        buffer: &ReplayBuffer,
        statistics: Statistics<'_>,
        rng: &mut ChaCha8Rng,
        batch: &mut Batch,
    ) {
        let n_input = self.layout.n_observation() + self.layout.n_goal();
        let (n_action, n_heads) = (self.layout.n_action(), self.drawn.rewards.len());
        for row in 0..batch.rewards.len() / n_heads {
            self.draw(buffer, rng);
            let row_of = |n: usize| row * n..(row + 1) * n;
            self.write_input(buffer, 0, statistics, &mut batch.inputs[row_of(n_input)]);
            self.write_input(buffer, 1, statistics, &mut batch.next_inputs[row_of(n_input)]);
            self.write_action(
                buffer,
                &mut batch.actions[row_of(n_action)],
                &mut batch.bc_mask[row_of(n_action)],
            );
            batch.rewards[row_of(n_heads)].copy_from_slice(&self.drawn.rewards);
            if has_contact_within(buffer, self.drawn.steps[0], 1) {
                for reward in &mut batch.rewards[row_of(n_heads)] {
                    *reward -= self.config.contact_cost;
                }
            }
            if self.drawn.swapped && n_heads == 2 {
                batch.rewards[row_of(n_heads)].reverse();
            }
        }
    }

    fn draw(&mut self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) {
        let first = self.draw_step(buffer, rng);
        self.drawn.steps.fill(first);
        let per_arm = self.config.reward == RewardKind::PerArm && self.layout.n_arms == 2;
        if bernoulli(rng, self.config.coda_fraction) && per_arm {
            let second = self.draw_step(buffer, rng);
            if is_apart(buffer, [first, second]) {
                self.drawn.steps[1] = second;
            }
        }
        self.drawn.swapped = bernoulli(rng, self.config.arm_swap_prob) && self.layout.n_arms == 2;
        match self.config.reward {
            RewardKind::Joint => self.relabel_jointly(buffer, rng),
            RewardKind::PerArm => self.relabel_arms(buffer, rng),
        }
    }

    fn draw_step(&self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) -> Step {
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
        Step { episode_idx, step_idx: index(rng, EPISODE_STEPS) }
    }

    fn relabel_arms(&mut self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) {
        for arm in self.layout.arms() {
            let Step { episode_idx, step_idx } = self.drawn.steps[arm.0];
            let moment = self.hindsight_moment(step_idx, rng);
            self.take_goal(buffer, arm, moment);
            let drawn = &mut self.drawn;
            let achieved = buffer.achieved(episode_idx, step_idx + 1, arm);
            let distance_m = distance(achieved, &drawn.goal[self.layout.goal_of(arm)]);
            drawn.rewards[arm.0] = sparse_reward_within(self.config.goal_tolerance_m, distance_m);
        }
    }

    fn relabel_jointly(&mut self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) {
        let Step { episode_idx, step_idx } = self.drawn.steps[0];
        let moment = self.hindsight_moment(step_idx, rng);
        let mut squared_distance = 0.0;
        for arm in self.layout.arms() {
            self.take_goal(buffer, arm, moment);
            let achieved = buffer.achieved(episode_idx, step_idx + 1, arm);
            let goal = &self.drawn.goal[self.layout.goal_of(arm)];
            squared_distance +=
                achieved.iter().zip(goal).map(|(a, g)| (a - g) * (a - g)).sum::<f32>();
        }
        self.drawn.rewards[0] =
            sparse_reward_within(self.config.goal_tolerance_m, squared_distance.sqrt());
    }

    /// The later moment whose achieved goal is taken, strictly after the step; `None` keeps the desired goal.
    fn hindsight_moment(&self, step_idx: usize, rng: &mut ChaCha8Rng) -> Option<usize> {
        let hindsight = bernoulli(rng, self.config.her_ratio);
        let moment = step_idx + 1 + index(rng, EPISODE_STEPS - step_idx);
        hindsight.then_some(moment)
    }

    fn take_goal(&mut self, buffer: &ReplayBuffer, arm: ArmIndex, moment: Option<usize>) {
        let part = self.layout.goal_of(arm);
        let episode_idx = self.drawn.steps[arm.0].episode_idx;
        let goal = match moment {
            Some(moment) => buffer.achieved(episode_idx, moment, arm),
            None => &buffer.goal(episode_idx)[part.clone()],
        };
        self.drawn.goal[part].copy_from_slice(goal);
    }

    /// Writes the normalised observation, `later` steps after the drawn ones, and the normalised goal.
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
            let Step { episode_idx, step_idx } = self.drawn.steps[from.0];
            let observation = buffer.observation(episode_idx, step_idx + later);
            self.raw_observation[self.layout.observation_of(to)]
                .copy_from_slice(&observation[self.layout.observation_of(from)]);
            self.raw_goal[self.layout.goal_of(to)]
                .copy_from_slice(&self.drawn.goal[self.layout.goal_of(from)]);
        }
        statistics.observation.normalize(&self.raw_observation, normalized_observation);
        statistics.goal.normalize(&self.raw_goal, normalized_goal);
    }

    fn write_action(&self, buffer: &ReplayBuffer, actions: &mut [f32], bc_mask: &mut [f32]) {
        for (to, from) in self.layout.arms().zip(self.sources()) {
            let step @ Step { episode_idx, step_idx } = self.drawn.steps[from.0];
            let action = buffer.action(episode_idx, step_idx);
            actions[self.layout.action_of(to)]
                .copy_from_slice(&action[self.layout.action_of(from)]);
            let is_advised = buffer.advised_arms(episode_idx, step_idx) >> from.0 & 1 == 1;
            let foresight = self.config.contact_foresight_steps;
            let is_cloned = is_advised && !has_contact_within(buffer, step, foresight);
            bc_mask[self.layout.action_of(to)].fill(if is_cloned { 1.0 } else { 0.0 });
        }
    }

    /// The arm whose numbers come first, second, ...: the arms in order, or in reverse when they change places.
    fn sources(&self) -> impl Iterator<Item = ArmIndex> + use<> {
        let (n_arms, swapped) = (self.layout.n_arms, self.drawn.swapped);
        (0..n_arms).map(move |arm| ArmIndex(if swapped { n_arms - 1 - arm } else { arm }))
    }
}

/// Whether an arm touches the other or the table on one of `n_steps` steps, the first among them.
fn has_contact_within(buffer: &ReplayBuffer, first: Step, n_steps: usize) -> bool {
    let end = (first.step_idx + n_steps).min(EPISODE_STEPS);
    buffer.has_contact(first.step_idx..end, first.episode_idx)
}

/// Whether two arms that make these steps at the same time would not meet: nothing is touched on either step, and the
/// hands and objects of one stay clear of the other's before and after.
fn is_apart(buffer: &ReplayBuffer, steps: [Step; 2]) -> bool {
    if steps.iter().any(|step| has_contact_within(buffer, *step, 1)) {
        return false;
    }
    let layout = buffer.layout();
    let reach_m = |arm: ArmIndex, later: usize| {
        let Step { episode_idx, step_idx } = steps[arm.0];
        let observation = buffer.observation(episode_idx, step_idx + later);
        let of_arm = &observation[layout.observation_of(arm)];
        of_arm[HAND_POSITION.start].max(of_arm[OBJECT_POSITION.start])
    };
    [0, 1].into_iter().all(|later| {
        let reached_m = reach_m(ArmIndex(0), later) + reach_m(ArmIndex(1), later);
        WORKSPACE_DISTANCE_M - reached_m >= RECOMBINED_APART_M
    })
}
