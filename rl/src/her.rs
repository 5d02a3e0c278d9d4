//! Hindsight experience replay (section 2.3 of the paper; Andrychowicz et al. 2017, strategy "future").
//!
//! A sampled transition keeps its goal or gets one that its episode achieved later; the reward is computed anew.
//! With a reward per arm every arm draws its own hindsight goal, with the joint reward all share one moment.

use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use tandem_core::layout::{
    ArmIndex, EPISODE_STEPS, HAND_POSITION, Layout, OBJECT_POSITION, WORKSPACE_DISTANCE_M,
};
use tandem_core::reward::{distance, sparse_reward_within};
use tandem_core::rng::{bernoulli, index};
use tandem_policy::NormalizerSnapshot;

use crate::ddpg::Batch;
use crate::replay::ReplayBuffer;

/// How far apart along x the hands and objects of two arms are at least, metres, when the arms' transitions come from
/// different episodes: nothing can touch then.
const RECOMBINED_APART_M: f32 = 0.10;

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
    /// Share of transitions drawn from the steps on which an arm executed the teacher's action, in [0, 1] (paper: 0).
    pub advised_share: f32,
    /// Share of two-arm transitions whose second arm is tried from another step than the first: counterfactual data
    /// augmentation (Pitis et al. 2020). It is kept where nothing of the two arms is near. In [0, 1]; only with
    /// [`RewardKind::PerArm`].
    pub recombined_share: f32,
    /// Share of two-arm transitions in which the arms change places, in [0, 1]: the world's exact symmetry.
    pub swap_share: f32,
    /// Which reward the critic learns.
    pub reward: RewardKind,
    /// Distance of an object from its goal, metres, within which training rewards it, 0.0001 to 1 (paper: 0.05, which
    /// success is always judged by). A smaller one leaves room for what an object does after it was let go.
    pub goal_tolerance_m: f32,
    /// What every arm pays for a step on which an arm touches the other or the table, 0 or more; a pending goal
    /// costs 1 (paper: 0).
    pub contact_cost: f32,
    /// Advice is not cloned on a step that has a contact within this many steps, itself the first (paper: 0).
    pub contact_foresight_steps: usize,
}

impl ReplayConfig {
    /// The lowest reward that a step can have.
    #[must_use]
    pub const fn lowest_reward(&self) -> f32 {
        -1.0 - self.contact_cost
    }
}

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
                &mut batch.cloned[row_of(n_action)],
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
        if bernoulli(rng, self.config.recombined_share) && per_arm {
            let second = self.draw_step(buffer, rng);
            if is_apart(buffer, [first, second]) {
                self.drawn.steps[1] = second;
            }
        }
        self.drawn.swapped = bernoulli(rng, self.config.swap_share) && self.layout.n_arms == 2;
        match self.config.reward {
            RewardKind::Joint => self.relabel_jointly(buffer, rng),
            RewardKind::PerArm => self.relabel_arms(buffer, rng),
        }
    }

    fn draw_step(&self, buffer: &ReplayBuffer, rng: &mut ChaCha8Rng) -> Step {
        let (moved, advised) = (buffer.moved_episodes(), buffer.advised_episodes());
        if bernoulli(rng, self.config.advised_share) && !advised.is_empty() {
            let episode_idx = advised[index(rng, advised.len())];
            let is_advised = |step_idx: &usize| buffer.advised_arms(episode_idx, *step_idx) != 0;
            let n_advised = (0..EPISODE_STEPS).filter(is_advised).count();
            let which = index(rng, n_advised);
            let step_idx = (0..EPISODE_STEPS).filter(is_advised).nth(which);
            let step_idx = step_idx.expect("an advised episode has an advised step");
            return Step { episode_idx, step_idx };
        }
        let from_moved = bernoulli(rng, self.config.moved_share) && !moved.is_empty();
        let episode_idx = if from_moved {
            moved[index(rng, moved.len())]
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
        let hindsight = bernoulli(rng, self.config.her_future_share);
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

    fn write_action(&self, buffer: &ReplayBuffer, actions: &mut [f32], cloned: &mut [f32]) {
        for (to, from) in self.layout.arms().zip(self.sources()) {
            let step @ Step { episode_idx, step_idx } = self.drawn.steps[from.0];
            let action = buffer.action(episode_idx, step_idx);
            actions[self.layout.action_of(to)]
                .copy_from_slice(&action[self.layout.action_of(from)]);
            let is_advised = buffer.advised_arms(episode_idx, step_idx) >> from.0 & 1 == 1;
            let foresight = self.config.contact_foresight_steps;
            let is_cloned = is_advised && !has_contact_within(buffer, step, foresight);
            cloned[self.layout.action_of(to)].fill(if is_cloned { 1.0 } else { 0.0 });
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

#[cfg(test)]
mod tests {
    use tandem_core::reward::sparse_reward;
    use tandem_core::rng::{Stream, episode_rng};
    use tandem_core::{Contacts, Episode, Task};

    use super::*;
    use crate::replay::drifting_episode;

    const LAYOUT: Layout = Layout::new(Task::Push, 2);
    const N_DRAWS: usize = 4000;

    fn config(reward: RewardKind) -> ReplayConfig {
        ReplayConfig {
            capacity_transitions: 1000,
            her_future_share: 0.8,
            moved_share: 0.5,
            advised_share: 0.0,
            recombined_share: 0.0,
            swap_share: 0.5,
            reward,
            goal_tolerance_m: 0.05,
            contact_cost: 0.0,
            contact_foresight_steps: 0,
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
            if drawn.steps[0].episode_idx == 0 && x < 9.0 {
                assert!(
                    x > buffer.achieved(0, drawn.steps[0].step_idx, ArmIndex(0))[0] + 0.005,
                    "not later: {drawn:?}"
                );
            }
        });
    }

    #[test]
    fn rewards_follow_from_the_goal_that_was_drawn() {
        sampled(RewardKind::PerArm, |sampler, buffer| {
            for arm in LAYOUT.arms() {
                let achieved = buffer.achieved(
                    sampler.drawn.steps[0].episode_idx,
                    sampler.drawn.steps[0].step_idx + 1,
                    arm,
                );
                let goal = &sampler.drawn.goal[LAYOUT.goal_of(arm)];
                assert_eq!(sampler.drawn.rewards[arm.0], sparse_reward(achieved, goal));
            }
        });
        sampled(RewardKind::Joint, |sampler, buffer| {
            let observation = buffer.observation(
                sampler.drawn.steps[0].episode_idx,
                sampler.drawn.steps[0].step_idx + 1,
            );
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
        near(count(RewardKind::PerArm, |drawn| drawn.steps[0].episode_idx == 0), 0.75);
        near(
            count(RewardKind::PerArm, |drawn| {
                drawn.steps[0].episode_idx == 0 && drawn.goal[0] < 9.0
            }),
            0.6,
        );
        let one_arm_only = |drawn: &Relabelled| {
            drawn.steps[0].episode_idx == 0 && (drawn.goal[0] < 9.0) != (drawn.goal[3] < 9.0)
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

    /// A batch of 256 rows from `buffer`, its numbers as they are.
    fn filled(change: impl FnOnce(&mut ReplayConfig), buffer: &ReplayBuffer) -> Batch {
        let mut config = config(RewardKind::PerArm);
        change(&mut config);
        let mut sampler = Sampler::new(&config, LAYOUT);
        let identity = |n: usize| NormalizerSnapshot { mean: vec![0.0; n], std: vec![1.0; n] };
        let (observation, goal) = (identity(LAYOUT.n_observation()), identity(LAYOUT.n_goal()));
        let mut batch = Batch::new(LAYOUT, 2, 256);
        let statistics = Statistics { observation: &observation, goal: &goal };
        sampler.fill(buffer, statistics, &mut episode_rng(3, 0, Stream::Replay), &mut batch);
        batch
    }

    #[test]
    fn a_contact_costs_both_arms_and_ends_cloning_before_it() {
        let mut episode = episode();
        episode.contacts[20] = Contacts::ARM_ARM;
        let mut buffer = ReplayBuffer::new(LAYOUT, 1000);
        buffer.push(&episode);
        let change = |config: &mut ReplayConfig| {
            config.swap_share = 0.0;
            config.her_future_share = 0.0;
            (config.contact_cost, config.contact_foresight_steps) = (0.75, 3);
        };
        let batch = filled(change, &buffer);
        let mut seen = [false; EPISODE_STEPS];
        for (row, rewards) in batch.rewards.chunks_exact(2).enumerate() {
            let of_step = |step: &usize| batch.actions[row * 6] == (*step * 6) as f32;
            let step = (0..EPISODE_STEPS).find(of_step).expect("the action of a step");
            seen[step] = true;
            assert_eq!(rewards, if step == 20 { [-1.75; 2] } else { [-1.0; 2] }, "step {step}");
            let cloned = if (18..=20).contains(&step) { 0.0 } else { 1.0 };
            assert_eq!(batch.cloned[row * 6], cloned, "step {step}");
        }
        assert!(seen[17..=21].iter().all(|seen| *seen), "too few draws");
    }

    #[test]
    fn advised_steps_are_drawn_on_purpose() {
        let mut episode = episode();
        episode.advised_arms.fill(0);
        episode.advised_arms[7] = 0b10;
        let mut buffer = ReplayBuffer::new(LAYOUT, 1000);
        buffer.push(&drifting_episode(LAYOUT, 0, 0.0));
        buffer.push(&episode);
        let share_of_step_7 = |advised_share| {
            let batch = filled(|config| config.advised_share = advised_share, &buffer);
            batch.cloned.iter().sum::<f32>() / 3.0 / 256.0
        };
        assert_eq!(share_of_step_7(1.0), 1.0);
        assert!((share_of_step_7(0.25) - 0.26).abs() < 0.08);
        assert!(share_of_step_7(0.0) < 0.05);
    }

    #[test]
    fn arms_of_different_steps_are_put_together_where_they_cannot_meet() {
        let mut touching = drifting_episode(LAYOUT, 1, 0.0);
        touching.contacts.fill(Contacts::ARM_ARM);
        let mut buffer = ReplayBuffer::new(LAYOUT, 1000);
        buffer.push(&episode());
        buffer.push(&touching);
        let mut config = config(RewardKind::PerArm);
        config.recombined_share = 1.0;
        let mut sampler = Sampler::new(&config, LAYOUT);
        let mut rng = episode_rng(1, 0, Stream::Replay);
        let (mut n_recombined, mut largest_x) = (0, 0.0_f32);
        for _ in 0..N_DRAWS {
            sampler.draw(&buffer, &mut rng);
            let [first, second] = sampler.drawn.steps[..] else { panic!("two arms") };
            if first == second {
                continue;
            }
            n_recombined += 1;
            assert_eq!((first.episode_idx, second.episode_idx), (0, 0), "one of them touches");
            largest_x = largest_x.max(buffer.achieved(0, first.step_idx + 1, ArmIndex(0))[0]);
            let goal = sampler.drawn.goal[LAYOUT.goal_of(ArmIndex(0))][0];
            assert!(goal > buffer.achieved(0, first.step_idx, ArmIndex(0))[0], "another's future");
        }
        assert!(n_recombined > N_DRAWS / 10);
        assert!((largest_x - 0.14).abs() < 0.005, "0.24 m apart, {largest_x} m towards the other");
    }
}
