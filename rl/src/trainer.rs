//! The learning state and what happens to it in a round: orders, new episodes, updates, parameters.
//!
//! Pure: the result depends on the configuration and the episodes, in their order, and on nothing else.

use std::collections::BTreeMap;

use rand_chacha::ChaCha8Rng;
use sha2::{Digest as _, Sha256};
use tandem_core::Episode;
use tandem_core::episode::EpisodeKind;
use tandem_core::layout::{EPISODE_STEPS, Layout, OBJECT_POSITION};
use tandem_core::rng::{Stream, bernoulli, episode_rng, index};
use tandem_core::text::hex;
use tandem_core::work::{EpisodeOrder, PublishedActor, SlotOrder};
use tandem_policy::{Normalizer, NormalizerSnapshot, Policy};

use crate::config::{Behaviour, ConfigError, PolyakEvery, RunConfig};
use crate::ddpg::{Batch, Ddpg, DdpgError, Rewards};
use crate::her::{Sampler, Statistics};
use crate::replay::ReplayBuffer;

/// Episodes of an evaluation slot.
const EVALUATION_SLOT_EPISODES: usize = 8;

/// As how many rows a teacher's normalisation counts in a run that starts from it: some 2,000 episodes.
const TEACHERS_ROWS: u64 = 100_000;

/// How far a run has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counters {
    /// Rounds learned.
    pub round: u64,
    /// Training steps taken in environments.
    pub env_steps: u64,
    /// Training episodes.
    pub episodes: u64,
    /// Updates.
    pub updates: u64,
    /// Units of the advice budget that training episodes were charged.
    pub advice_spent: u64,
}

/// What a round showed.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RoundFigures {
    /// Mean over the round's updates.
    pub critic_loss: f64,
    /// Mean over the round's updates.
    pub actor_loss: f64,
    /// Mean value of the policy's own actions over the round's batches, mean over heads.
    pub mean_q: f64,
    /// Share of the round's episodes that succeeded.
    pub training_success: f64,
    /// Share of the round's episodes in which an object was displaced.
    pub training_moved: f64,
}

/// Everything that learning changes. Fields are public so that a checkpoint can save and restore them.
#[derive(Debug)]
pub struct Trainer {
    /// The run's settings, checked.
    pub config: RunConfig,
    /// Arms and task, from the settings.
    pub layout: Layout,
    /// Rounds, environment steps, episodes, updates and units of advice so far.
    pub counters: Counters,
    /// The replay buffer.
    pub replay: ReplayBuffer,
    /// Networks, target networks and optimizer states.
    pub ddpg: Ddpg,
    /// Running mean and deviation of observations.
    pub observation_normalizer: Normalizer,
    /// Running mean and deviation of goals.
    pub goal_normalizer: Normalizer,
    sampler: Sampler,
    batch: Batch,
    /// Statistics of the last round.
    pub figures: RoundFigures,
}

impl Trainer {
    /// The state before the first round.
    ///
    /// # Errors
    /// When the configuration cannot be used.
    pub fn new(config: RunConfig) -> Result<Self, ConfigError> {
        let config = config.checked()?;
        let layout = config.layout()?;
        let n_heads = config.replay.reward.n_heads(layout);
        let rewards = Rewards { n_heads, lowest: config.replay.lowest_reward() };
        Ok(Self {
            layout,
            counters: Counters::default(),
            replay: ReplayBuffer::new(layout, config.replay.capacity_transitions),
            ddpg: Ddpg::new(config.ddpg.clone(), layout, rewards, config.seed),
            observation_normalizer: Normalizer::new(layout.n_observation()),
            goal_normalizer: Normalizer::new(layout.n_goal()),
            sampler: Sampler::new(&config.replay, layout),
            batch: Batch::new(layout, n_heads, config.ddpg.batch_size),
            figures: RoundFigures::default(),
            config,
        })
    }

    /// Starts from a copy of `teacher` for each arm: networks and how their inputs are normalised. Meant for a run that
    /// has not begun.
    ///
    /// # Errors
    /// Says what does not fit: the teacher's task, its arms or its sizes, or a critic of one head for several arms.
    pub fn start_from(&mut self, teacher: &Policy) -> Result<(), String> {
        if teacher.layout != self.layout.single_arm() || teacher.n_heads != 1 {
            let (task, n_arms) = (self.layout.task, teacher.layout.n_arms);
            return Err(format!(
                "needs a teacher for {task} with one arm and one value, got {n_arms} arm(s) for {} with {} value(s)",
                teacher.layout.task, teacher.n_heads
            ));
        }
        let copies = teacher.replicated(self.layout.n_arms);
        let sizes = |policy: &Policy| (policy.n_hidden, policy.n_hidden_layers, policy.n_heads);
        let ddpg = &self.config.ddpg;
        let n_heads = self.config.replay.reward.n_heads(self.layout);
        if sizes(&copies) != (ddpg.n_hidden, ddpg.n_hidden_layers, n_heads) {
            return Err(format!(
                "needs ddpg.n_hidden = {}, ddpg.n_hidden_layers = {} and replay.reward = \"per-arm\" to hold this teacher's \
                 copies",
                copies.n_hidden, copies.n_hidden_layers
            ));
        }
        self.ddpg.start_from(&copies);
        self.observation_normalizer =
            Normalizer::from_snapshot(&copies.observation_normalizer, TEACHERS_ROWS);
        self.goal_normalizer = Normalizer::from_snapshot(&copies.goal_normalizer, TEACHERS_ROWS);
        Ok(())
    }

    /// The configuration of the run.
    #[must_use]
    pub const fn config(&self) -> &RunConfig {
        &self.config
    }

    /// How far the run has come.
    #[must_use]
    pub const fn counters(&self) -> Counters {
        self.counters
    }

    /// What the latest round showed.
    #[must_use]
    pub const fn figures(&self) -> RoundFigures {
        self.figures
    }

    /// Lets the update use `n_threads`, 1 or 2; the results are the same.
    pub fn set_threads(&mut self, n_threads: usize) {
        self.ddpg.set_threads(n_threads);
    }

    /// The training slots of round `round`, to be played with `version`.
    #[must_use]
    pub fn training_orders(&self, round: u64, version: u64) -> Vec<SlotOrder> {
        let per_round = self.config.episodes_per_round();
        let warmup_episodes = self.config.rounds.warmup_env_steps.div_ceil(EPISODE_STEPS as u64);
        let orders: Vec<EpisodeOrder> = (round * per_round..(round + 1) * per_round)
            .map(|number| EpisodeOrder {
                number,
                seed: self.config.seed,
                advised: self.config.advice.asks() && is_advised(number, self.config.advice.share),
                uniform: number < warmup_episodes,
                record: false,
            })
            .collect();
        slots(&orders, self.config.rounds.rollouts, EpisodeKind::Training, version)
    }

    /// The slots of an evaluation of `version` on the run's fixed goals.
    #[must_use]
    pub fn evaluation_orders(&self, version: u64) -> Vec<SlotOrder> {
        let evaluation = &self.config.evaluation;
        let order = |number| EpisodeOrder {
            number,
            seed: evaluation.seed,
            advised: false,
            uniform: false,
            record: number < evaluation.recorded_episodes,
        };
        let orders: Vec<EpisodeOrder> = (0..evaluation.episodes).map(order).collect();
        slots(&orders, EVALUATION_SLOT_EPISODES, EpisodeKind::Evaluation, version)
    }

    /// Takes in a round's episodes, which must be in episode order.
    pub fn ingest(&mut self, episodes: &[Episode]) {
        for episode in episodes {
            self.replay.push(episode);
            self.feed_normalizers(episode);
            self.counters.advice_spent += u64::from(episode.advice_charged);
        }
        self.counters.episodes += episodes.len() as u64;
        self.counters.env_steps += (episodes.len() * EPISODE_STEPS) as u64;
        let share = |hits: usize| hits as f64 / episodes.len().max(1) as f64;
        self.figures.training_success =
            share(episodes.iter().filter(|episode| episode.succeeded()).count());
        self.figures.training_moved =
            share(episodes.iter().filter(|episode| episode.moved()).count());
    }

    /// Sets the units of advice spent, where the teacher's account contradicts the episodes' claims.
    pub const fn correct_advice_spent(&mut self, units: u64) {
        self.counters.advice_spent = units;
    }

    /// Names the first statistic of the normalisers that is not finite or beyond everything that a world shows. Inputs
    /// normalised with it are all alike, and the policy learns nothing.
    #[must_use]
    pub fn absurd_statistic(&self) -> Option<String> {
        let largest_of_object = self.layout.observation_bound(OBJECT_POSITION.start);
        let goal_bound = self.layout.goal_bound().max(largest_of_object);
        let observation = self.observation_normalizer.snapshot();
        first_absurd("observations", observation, |idx| self.layout.observation_bound(idx))
            .or_else(|| first_absurd("goals", self.goal_normalizer.snapshot(), |_| goal_bound))
    }

    /// Makes a round's updates. `on_update` hears how many are done.
    ///
    /// # Errors
    /// When a loss or a parameter is no longer finite.
    pub fn learn(&mut self, mut on_update: impl FnMut(u64)) -> Result<RoundFigures, DdpgError> {
        let mut rng = episode_rng(self.config.seed, self.counters.round, Stream::Replay);
        let statistics = Statistics {
            observation: self.observation_normalizer.snapshot(),
            goal: self.goal_normalizer.snapshot(),
        };
        self.ddpg.set_cooldown(self.config.is_cooldown(self.counters.round));
        let n_updates = self.config.updates_per_round();
        let mut sums = RoundFigures::default();
        for update in 1..=n_updates {
            self.sampler.fill(&self.replay, statistics, &mut rng, &mut self.batch);
            let losses = self.ddpg.update(&self.batch)?;
            if self.config.rounds.polyak_every == PolyakEvery::Update {
                self.ddpg.polyak();
            }
            sums.critic_loss += losses.critic_loss;
            sums.actor_loss += losses.actor_loss;
            sums.mean_q += losses.mean_q;
            on_update(update);
        }
        if self.config.rounds.polyak_every == PolyakEvery::Round {
            self.ddpg.polyak();
        }
        self.counters.updates += n_updates;
        self.counters.round += 1;
        self.figures.critic_loss = sums.critic_loss / n_updates as f64;
        self.figures.actor_loss = sums.actor_loss / n_updates as f64;
        self.figures.mean_q = sums.mean_q / n_updates as f64;
        Ok(self.figures)
    }

    /// The actor as workers are to use it; its version is the number of rounds learned.
    #[must_use]
    pub fn publish(&self) -> PublishedActor {
        let actor = match self.config.behaviour {
            Behaviour::Target => self.ddpg.target_actor(),
            Behaviour::Online => self.ddpg.actor(),
        };
        let NormalizerSnapshot { mean: observation_mean, std: observation_std } =
            self.observation_normalizer.snapshot().clone();
        let NormalizerSnapshot { mean: goal_mean, std: goal_std } =
            self.goal_normalizer.snapshot().clone();
        PublishedActor {
            version: self.counters.round,
            n_hidden: self.config.ddpg.n_hidden,
            n_hidden_layers: self.config.ddpg.n_hidden_layers,
            actor: actor.to_vec(),
            observation_mean,
            observation_std,
            goal_mean,
            goal_std,
        }
    }

    /// The policy that acts now, with the critic that belongs to it, as it would be shipped.
    #[must_use]
    pub fn policy(&self, metadata: BTreeMap<String, String>) -> Policy {
        let (actor, critic) = match self.config.behaviour {
            Behaviour::Target => (self.ddpg.target_actor(), self.ddpg.target_critic()),
            Behaviour::Online => (self.ddpg.actor(), self.ddpg.critic()),
        };
        Policy {
            layout: self.layout,
            n_hidden: self.config.ddpg.n_hidden,
            n_hidden_layers: self.config.ddpg.n_hidden_layers,
            n_heads: self.config.replay.reward.n_heads(self.layout),
            actor: actor.to_vec(),
            critic: critic.to_vec(),
            observation_normalizer: self.observation_normalizer.snapshot().clone(),
            goal_normalizer: self.goal_normalizer.snapshot().clone(),
            metadata,
        }
    }

    /// SHA-256 over parameters, optimiser, normalisers, replay buffer and counters, in a fixed order, hexadecimal.
    #[must_use]
    pub fn digest(&self) -> String {
        let mut hash = Sha256::new();
        for (name, values) in self.tensors() {
            hash.update(name.as_bytes());
            hash.update(bytemuck::cast_slice::<f32, u8>(values));
        }
        for normalizer in [&self.observation_normalizer, &self.goal_normalizer] {
            let seen = normalizer.state();
            hash.update(seen.count.to_le_bytes());
            seen.sum
                .iter()
                .chain(&seen.sum_of_squares)
                .for_each(|sum| hash.update(sum.to_le_bytes()));
        }
        let (parts, next) = self.replay.parts();
        hash.update(&parts.advised_arms);
        hash.update(&parts.contacts);
        hash.update(&parts.moved);
        let Counters { round, env_steps, episodes, updates, advice_spent } = self.counters;
        for count in
            [next as u64, self.ddpg.n_updates(), round, env_steps, episodes, updates, advice_spent]
        {
            hash.update(count.to_le_bytes());
        }
        hex(&hash.finalize())
    }

    /// Every large float vector of the state, by name, in a fixed order.
    #[must_use]
    pub fn tensors(&self) -> Vec<(String, &[f32])> {
        let (parts, _) = self.replay.parts();
        let replay = [
            ("replay.observations", parts.observations.as_slice()),
            ("replay.goals", parts.goals.as_slice()),
            ("replay.actions", parts.actions.as_slice()),
        ];
        let ddpg =
            self.ddpg.state().into_iter().map(|(name, values)| (format!("ddpg.{name}"), values));
        ddpg.chain(replay.map(|(name, values)| (name.to_owned(), values))).collect()
    }

    /// Feeds the normalisers with an episode's observations and with goals relabelled as in a batch.
    fn feed_normalizers(&mut self, episode: &Episode) {
        let mut rng = episode_rng(self.config.seed, episode.number, Stream::Normaliser);
        let both_orders = self.config.replay.arm_swap_prob > 0.0 && self.layout.n_arms == 2;
        let (mut observations, mut goals) = (Vec::new(), Vec::new());
        for step_idx in 0..EPISODE_STEPS {
            let goal = self.relabelled_goal(episode, step_idx, &mut rng);
            let observation = episode.observation(step_idx);
            observations.extend_from_slice(observation);
            goals.extend_from_slice(&goal);
            if both_orders {
                observations.extend(swapped(observation));
                goals.extend(swapped(&goal));
            }
        }
        self.observation_normalizer.update(&observations);
        self.goal_normalizer.update(&goals);
    }

    fn relabelled_goal(
        &self,
        episode: &Episode,
        step_idx: usize,
        rng: &mut ChaCha8Rng,
    ) -> Vec<f32> {
        let mut goal = episode.goal.clone();
        for arm in self.layout.arms() {
            let hindsight = bernoulli(rng, self.config.replay.her_ratio);
            let moment = step_idx + 1 + index(rng, EPISODE_STEPS - step_idx);
            if hindsight {
                goal[self.layout.goal_of(arm)].copy_from_slice(episode.achieved(moment, arm));
            }
        }
        goal
    }
}

fn first_absurd(
    what: &str,
    snapshot: &NormalizerSnapshot,
    largest: impl Fn(usize) -> f32,
) -> Option<String> {
    // A mean or a standard deviation of bounded numbers exceeds their bound by rounding only.
    let is_sane = |value: f32, idx| value.abs() <= 1.001 * largest(idx);
    let numbers = snapshot.mean.iter().zip(&snapshot.std).enumerate();
    let (idx, (mean, std)) = numbers
        .into_iter()
        .find(|(idx, (mean, std))| !(is_sane(**mean, *idx) && is_sane(**std, *idx)))?;
    Some(format!(
        "number {idx} of the {what} has mean {mean:e} and standard deviation {std:e} over the run, which no world shows: \
         the policy cannot learn from it"
    ))
}

/// Whether episode `number` is one of the advised ones: a share of any run of episodes, evenly spread.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "episode numbers stay far below 2^52"
)]
fn is_advised(number: u64, share: f64) -> bool {
    let advised_before = |number: u64| (number as f64 * share).floor() as u64;
    advised_before(number + 1) > advised_before(number)
}

/// Cuts orders into slots of `n_episodes`; the board numbers them.
fn slots(
    orders: &[EpisodeOrder],
    n_episodes: usize,
    kind: EpisodeKind,
    version: u64,
) -> Vec<SlotOrder> {
    let slot = |episodes: &[EpisodeOrder]| SlotOrder {
        slot: 0,
        parameter_version: version,
        kind,
        episodes: episodes.to_vec(),
    };
    orders.chunks(n_episodes).map(slot).collect()
}

/// The two halves of a two-arm vector in the other order.
fn swapped(vector: &[f32]) -> Vec<f32> {
    let (first, second) = vector.split_at(vector.len() / 2);
    [second, first].concat()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Recipe;

    #[test]
    fn a_statistic_that_one_absurd_number_has_ruined_is_named() {
        let mut config = RunConfig::defaults(Recipe::Tandem, tandem_core::Task::Push, 2);
        config.ddpg.n_hidden = 4;
        let mut trainer = Trainer::new(config).expect("valid");
        assert_eq!(trainer.absurd_statistic(), None);
        let mut row = vec![0.0; trainer.layout.n_observation()];
        trainer.observation_normalizer.update(&row);
        row[31] = 25.0;
        trainer.observation_normalizer.update(&row);
        assert_eq!(trainer.absurd_statistic(), None, "an object may fall");
        row[31] = 1e29;
        trainer.observation_normalizer.update(&row);
        let named = trainer.absurd_statistic().expect("ruined");
        assert!(named.starts_with("number 31 of the observations has mean 3.3"), "{named}");
        trainer.observation_normalizer = Normalizer::new(row.len());
        trainer.goal_normalizer.update(&[f32::NAN; 6]);
        let named = trainer.absurd_statistic().expect("not finite");
        assert!(named.starts_with("number 0 of the goals has mean NaN"), "{named}");
    }
}
