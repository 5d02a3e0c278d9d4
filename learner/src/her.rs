//! Hindsight experience replay (section 2.3 of the paper; Andrychowicz et al. 2017, strategy "future").
//!
//! A sampled transition keeps its goal or gets one that its episode achieved later; the reward is computed anew.
//! With a reward per arm every arm draws its own hindsight goal, with the joint reward all share one moment.

use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use tandem_core::layout::{ArmIndex, EPISODE_STEPS, Layout};
use tandem_core::reward::sparse_reward;
use tandem_core::rng::{coin, index};
use tandem_policy::NormalizerSnapshot;

use crate::ddpg::Batch;
use crate::replay::ReplayBuffer;

/// Which reward the critic learns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum RewardKind {
    /// One reward: 0 when the norm over all arms' goals is within the tolerance.
    Joint,
    /// A reward for each arm, and a critic head for each.
    PerArm,
}

impl RewardKind {
    /// Heads of the critic.
    #[must_use]
    pub const fn n_heads(self, layout: Layout) -> usize {
        match self {
            Self::Joint => 1,
            Self::PerArm => layout.n_arms,
        }
    }
}

/// `[replay]` in the run file: what is kept and how batches are drawn from it.
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ReplayConfig {
    /// Transitions kept, at least one episode's 50 (baselines HER: 1,000,000).
    pub capacity_transitions: usize,
    /// Share of transitions that get a hindsight goal, in [0, 1] (0.8 is the reference's k = 4).
    pub her_future_share: f32,
    /// Share of transitions drawn from episodes in which an object was displaced, in [0, 1].
    pub moved_share: f32,
    /// Share of two-arm transitions in which the arms change places, in [0, 1]: the world's exact symmetry.
    pub swap_share: f32,
    /// Which reward the critic learns.
    pub reward: RewardKind,
}

/// The frozen statistics with which a batch is normalised.
#[derive(Debug, Clone, Copy)]
pub struct Statistics<'a> {
    /// Of observations, shape `[n_observation]`.
    pub observation: &'a NormalizerSnapshot,
    /// Of goals, shape `[n_goal]`.
    pub goal: &'a NormalizerSnapshot,
}

/// A transition with the goal it is judged by.
#[derive(Debug, Clone, PartialEq)]
struct Relabelled {
    episode_idx: usize,
    step_idx: usize,
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
            episode_idx: 0,
            step_idx: 0,
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
            let (before, after) = (self.drawn.step_idx, self.drawn.step_idx + 1);
            self.write_input(buffer, before, statistics, &mut batch.inputs[row_of(n_input)]);
            self.write_input(buffer, after, statistics, &mut batch.next_inputs[row_of(n_input)]);
            self.write_action(
                buffer,
                &mut batch.actions[row_of(n_action)],
                &mut batch.cloned[row_of(n_action)],
            );
            batch.rewards[row_of(n_heads)].copy_from_slice(&self.drawn.rewards);
            if self.drawn.swapped && n_heads == 2 {
                batch.rewards[row_of(n_heads)].reverse();
            }
        }
    }

    fn draw(&mut self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) {
        let moved = buffer.moved_episodes();
        let from_moved = coin(rng, self.config.moved_share) && !moved.is_empty();
        self.drawn.episode_idx = if from_moved {
            moved[index(rng, moved.len())]
        } else {
            index(rng, buffer.n_episodes())
        };
        self.drawn.step_idx = index(rng, EPISODE_STEPS);
        self.drawn.swapped = coin(rng, self.config.swap_share) && self.layout.n_arms == 2;
        match self.config.reward {
            RewardKind::Joint => self.relabel_jointly(buffer, rng),
            RewardKind::PerArm => self.relabel_arms(buffer, rng),
        }
    }

    fn relabel_arms(&mut self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) {
        for arm in self.layout.arms() {
            let moment = self.hindsight_moment(rng);
            self.take_goal(buffer, arm, moment);
            let drawn = &mut self.drawn;
            let achieved = buffer.achieved(drawn.episode_idx, drawn.step_idx + 1, arm);
            drawn.rewards[arm.0] = sparse_reward(achieved, &drawn.goal[self.layout.goal_of(arm)]);
        }
    }

    fn relabel_jointly(&mut self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) {
        let moment = self.hindsight_moment(rng);
        let mut squared_distance = 0.0;
        for arm in self.layout.arms() {
            self.take_goal(buffer, arm, moment);
            let achieved = buffer.achieved(self.drawn.episode_idx, self.drawn.step_idx + 1, arm);
            let goal = &self.drawn.goal[self.layout.goal_of(arm)];
            squared_distance +=
                achieved.iter().zip(goal).map(|(a, g)| (a - g) * (a - g)).sum::<f32>();
        }
        self.drawn.rewards[0] = sparse_reward(&[squared_distance.sqrt()], &[0.0]);
    }

    /// The later moment whose achieved goal is taken, strictly after the step; `None` keeps the desired goal.
    fn hindsight_moment(&self, rng: &mut ChaCha8Rng) -> Option<usize> {
        let hindsight = coin(rng, self.config.her_future_share);
        let moment = self.drawn.step_idx + 1 + index(rng, EPISODE_STEPS - self.drawn.step_idx);
        hindsight.then_some(moment)
    }

    fn take_goal(&mut self, buffer: &ReplayBuffer, arm: ArmIndex, moment: Option<usize>) {
        let part = self.layout.goal_of(arm);
        let goal = match moment {
            Some(moment) => buffer.achieved(self.drawn.episode_idx, moment, arm),
            None => &buffer.goal(self.drawn.episode_idx)[part.clone()],
        };
        self.drawn.goal[part].copy_from_slice(goal);
    }

    /// Writes the normalised observation before step `step_idx` and the normalised goal.
    fn write_input(
        &mut self,
        buffer: &ReplayBuffer,
        step_idx: usize,
        statistics: Statistics<'_>,
        input: &mut [f32],
    ) {
        let (normalized_observation, normalized_goal) =
            input.split_at_mut(self.layout.n_observation());
        let observation = buffer.observation(self.drawn.episode_idx, step_idx);
        for (to, from) in self.layout.arms().zip(self.sources()) {
            self.raw_observation[self.layout.observation_of(to)]
                .copy_from_slice(&observation[self.layout.observation_of(from)]);
            self.raw_goal[self.layout.goal_of(to)]
                .copy_from_slice(&self.drawn.goal[self.layout.goal_of(from)]);
        }
        statistics.observation.normalize(&self.raw_observation, normalized_observation);
        statistics.goal.normalize(&self.raw_goal, normalized_goal);
    }

    fn write_action(&self, buffer: &ReplayBuffer, actions: &mut [f32], cloned: &mut [f32]) {
        let action = buffer.action(self.drawn.episode_idx, self.drawn.step_idx);
        let advised = buffer.advised_arms(self.drawn.episode_idx, self.drawn.step_idx);
        for (to, from) in self.layout.arms().zip(self.sources()) {
            actions[self.layout.action_of(to)]
                .copy_from_slice(&action[self.layout.action_of(from)]);
            let was_advised = advised >> from.0 & 1 == 1;
            cloned[self.layout.action_of(to)].fill(if was_advised { 1.0 } else { 0.0 });
        }
    }

    /// The arm whose numbers come first, second, ...: the arms in order, or in reverse when they change places.
    fn sources(&self) -> impl Iterator<Item = ArmIndex> + use<> {
        let (n_arms, swapped) = (self.layout.n_arms, self.drawn.swapped);
        (0..n_arms).map(move |arm| ArmIndex(if swapped { n_arms - 1 - arm } else { arm }))
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::rng::{Stream, episode_rng};
    use tandem_core::{Episode, Task};

    use super::*;
    use crate::replay::drifting_episode;

    const LAYOUT: Layout = Layout::new(Task::Push, 2);
    const N_DRAWS: usize = 4000;

    fn config(reward: RewardKind) -> ReplayConfig {
        ReplayConfig {
            capacity_transitions: 1000,
            her_future_share: 0.8,
            moved_share: 0.5,
            swap_share: 0.5,
            reward,
        }
    }

    /// Arm 0's object drifts; goals are far away; every action component is its own index plus the step.
    fn episode() -> Episode {
        let mut episode = drifting_episode(LAYOUT, 0, 0.01);
        episode.goal.fill(9.0);
        for (component, value) in episode.actions.iter_mut().enumerate() {
            *value = component as f32;
        }
        episode.advised_arms.fill(0b01);
        episode
    }

    fn sampled(reward: RewardKind, check: impl Fn(&Sampler, &ReplayBuffer)) {
        let mut buffer = ReplayBuffer::new(LAYOUT, 1000);
        buffer.push(&episode());
        buffer.push(&drifting_episode(LAYOUT, 1, 0.0));
        let mut sampler = Sampler::new(&config(reward), LAYOUT);
        let mut rng = episode_rng(1, 0, Stream::Replay);
        for _ in 0..N_DRAWS {
            sampler.draw(&buffer, &mut rng);
            check(&sampler, &buffer);
        }
    }

    #[test]
    fn a_hindsight_goal_was_achieved_strictly_later() {
        sampled(RewardKind::PerArm, |sampler, buffer| {
            let drawn = &sampler.drawn;
            let x = drawn.goal[0];
            if drawn.episode_idx == 0 && x < 9.0 {
                assert!(
                    x > buffer.achieved(0, drawn.step_idx, ArmIndex(0))[0] + 0.005,
                    "not later: {drawn:?}"
                );
            }
        });
    }

    #[test]
    fn rewards_follow_from_the_goal_that_was_drawn() {
        sampled(RewardKind::PerArm, |sampler, buffer| {
            for arm in LAYOUT.arms() {
                let achieved =
                    buffer.achieved(sampler.drawn.episode_idx, sampler.drawn.step_idx + 1, arm);
                let goal = &sampler.drawn.goal[LAYOUT.goal_of(arm)];
                assert_eq!(sampler.drawn.rewards[arm.0], sparse_reward(achieved, goal));
            }
        });
        sampled(RewardKind::Joint, |sampler, buffer| {
            let observation =
                buffer.observation(sampler.drawn.episode_idx, sampler.drawn.step_idx + 1);
            let achieved: Vec<f32> =
                tandem_core::reward::achieved_goal(LAYOUT, observation).collect();
            assert_eq!(sampler.drawn.rewards[0], sparse_reward(&achieved, &sampler.drawn.goal));
        });
    }

    #[test]
    fn shares_are_as_configured() {
        let count = |reward, holds: fn(&Relabelled) -> bool| {
            let hits = std::cell::Cell::new(0_usize);
            sampled(reward, |sampler, _| hits.set(hits.get() + usize::from(holds(&sampler.drawn))));
            hits.get() as f64 / N_DRAWS as f64
        };
        let near = |share: f64, expected: f64| {
            assert!((share - expected).abs() < 0.03, "{share} is not {expected}");
        };
        near(count(RewardKind::PerArm, |drawn| drawn.swapped), 0.5);
        near(count(RewardKind::PerArm, |drawn| drawn.episode_idx == 0), 0.75);
        near(count(RewardKind::PerArm, |drawn| drawn.episode_idx == 0 && drawn.goal[0] < 9.0), 0.6);
        let one_arm_only = |drawn: &Relabelled| {
            drawn.episode_idx == 0 && (drawn.goal[0] < 9.0) != (drawn.goal[3] < 9.0)
        };
        near(count(RewardKind::PerArm, one_arm_only), 0.75 * 2.0 * 0.8 * 0.2);
        near(count(RewardKind::Joint, one_arm_only), 0.0);
    }

    #[test]
    fn swapped_rows_exchange_everything_the_arms_own() {
        let mut buffer = ReplayBuffer::new(LAYOUT, 1000);
        buffer.push(&episode());
        let mut sampler = Sampler::new(&config(RewardKind::PerArm), LAYOUT);
        let identity = |n: usize| NormalizerSnapshot { mean: vec![0.0; n], std: vec![10.0; n] };
        let (observation, goal) = (identity(LAYOUT.n_observation()), identity(LAYOUT.n_goal()));
        let mut batch = Batch::new(LAYOUT, 2, 64);
        let statistics = Statistics { observation: &observation, goal: &goal };
        sampler.fill(&buffer, statistics, &mut episode_rng(3, 0, Stream::Replay), &mut batch);
        let mut n_swapped = 0;
        for row in 0..64 {
            let (actions, cloned) =
                (&batch.actions[row * 6..row * 6 + 6], &batch.cloned[row * 6..row * 6 + 6]);
            let swapped = actions[0] > actions[3];
            n_swapped += usize::from(swapped);
            let advised_half = if swapped {
                [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]
            } else {
                [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
            };
            assert_eq!(cloned, advised_half);
            let input = &batch.inputs[row * 62..row * 62 + 62];
            let drifting_x = if swapped { input[31] } else { input[3] };
            let still_x = if swapped { input[3] } else { input[31] };
            assert!(still_x == 0.0 && drifting_x >= 0.0);
            let steps = actions[if swapped { 3 } else { 0 }] / 6.0;
            assert!(
                (drifting_x * 10.0 - steps * 0.01).abs() < 1e-5,
                "observation and action of different steps"
            );
        }
        assert!((10..54).contains(&n_swapped));
    }
}
