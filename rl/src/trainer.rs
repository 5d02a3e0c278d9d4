//! The learning state and the steps of a round: orders, new episodes, updates, published parameters.
//!
//! Pure: the result depends only on the configuration and on the episodes in their order.

use std::borrow::Cow;
use std::collections::BTreeMap;

use sha2::{Digest as _, Sha256};
use tandem_core::rng::{Stream, episode_rng};
use tandem_core::task::Part;
use tandem_core::text::{counted, hex};
use tandem_core::work::PublishedActor;
use tandem_core::{ArmIndex, Episode, TaskSpec};
use tandem_policy::normalizer::STD_FLOOR;
use tandem_policy::{Normalizer, NormalizerSnapshot, Policy};

use crate::config::{Behaviour, ConfigError, PolyakEvery, RunConfig};
use crate::ddpg::{Batch, Ddpg, DdpgError, Rewards};
use crate::ensemble::CriticEnsemble;
use crate::her::{Sampler, Statistics, arm_sources, relabelled_goal};
use crate::jump_start::JumpStart;
use crate::replay::ReplayBuffer;

mod orders;

/// Number of rows that a teacher's normaliser counts for in a run that starts from it: about 2,000 episodes.
const TEACHER_NORMALIZER_ROWS: u64 = 100_000;

/// Counters of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counters {
    /// Rounds learned.
    pub round: u64,
    /// Environment steps of training.
    pub env_steps: u64,
    /// Episodes of training.
    pub episodes: u64,
    /// Updates of the networks.
    pub updates: u64,
    /// Units of the advice budget charged for training episodes: [`Trainer::correct_advice_spent`] sets them.
    pub advice_spent: u64,
    /// Training steps on which the teacher was asked. The digest does not cover them.
    pub advice_queries: u64,
}

/// Statistics of a round.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RoundStats {
    /// The critic's loss, mean over the round's updates.
    pub critic_loss: f64,
    /// The actor's loss, mean over the round's updates.
    pub actor_loss: f64,
    /// Value of the policy's own actions, mean over the round's batches and the critic's heads.
    pub mean_q: f64,
    /// Fraction of the round's episodes that succeeded.
    pub training_success: f64,
    /// Fraction of the round's episodes in which an object was displaced.
    pub training_moved: f64,
}

/// The learning state of a run. Fields are public so that a checkpoint can save and restore them.
#[derive(Debug)]
pub struct Trainer {
    /// The run's settings, checked.
    pub config: RunConfig,
    /// The task, from the settings.
    pub task: TaskSpec,
    /// The run's counters.
    pub counters: Counters,
    /// The replay buffer.
    pub replay: ReplayBuffer,
    /// Networks, target networks and optimisers.
    pub ddpg: Ddpg,
    /// Running mean and standard deviation of observations.
    pub observation_normalizer: Normalizer,
    /// Running mean and standard deviation of goals, desired and hindsight.
    pub goal_normalizer: Normalizer,
    /// The horizon of strategy `jsrl:H`; `None` with other strategies.
    pub jump_start: Option<JumpStart>,
    /// The critics of strategy `ts2c:T`; `None` with other strategies.
    pub ensemble: Option<CriticEnsemble>,
    sampler: Sampler,
    batch: Batch,
    /// Statistics of the latest round.
    pub stats: RoundStats,
}

impl Trainer {
    /// Creates the state before the first round.
    ///
    /// # Errors
    /// When a setting is out of its range.
    pub fn new(config: RunConfig) -> Result<Self, ConfigError> {
        let config = config.checked()?;
        let task = config.task_spec()?;
        let n_heads = config.replay.reward.n_heads(&task);
        let mut sampler = Sampler::new(&config.replay, &task);
        sampler.set_intervention_cost(config.advice.intervention_cost());
        let lowest = config.replay.lowest_reward() - config.advice.intervention_cost();
        let rewards = Rewards { n_heads, lowest };
        let ensemble = config
            .advice
            .disagreement_threshold()
            .map(|_threshold| CriticEnsemble::new(&config.ddpg, &task, n_heads, config.seed));
        Ok(Self {
            counters: Counters::default(),
            replay: ReplayBuffer::new(&task, config.replay.capacity_transitions),
            ddpg: Ddpg::new(config.ddpg.clone(), &task, rewards, config.seed),
            observation_normalizer: Normalizer::new(task.n_observation()),
            goal_normalizer: Normalizer::new(task.n_goal()),
            jump_start: config.advice.horizon().map(JumpStart::new),
            ensemble,
            sampler,
            batch: Batch::new(&task, n_heads, config.ddpg.transitions_per_update()),
            stats: RoundStats::default(),
            task,
            config,
        })
    }

    /// Initialises networks and normalisers with a copy of `teacher` for each arm. Intended for a run that has not
    /// started.
    ///
    /// # Errors
    /// Describes the mismatch: the teacher's task, arms or sizes, or a critic with one head for several arms.
    pub fn start_from(&mut self, teacher: &Policy) -> Result<(), String> {
        let (task, n_arms) = (self.task.name(), teacher.task.n_arms());
        let Some(one_arm) = self.task.single_arm() else {
            return Err(format!("the arms of {task} are not instances of one task of one arm"));
        };
        if teacher.task.name() != one_arm.name() || n_arms != 1 || teacher.n_heads != 1 {
            return Err(format!(
                "needs a teacher for {} with one arm and one value, got {} for {} with {}",
                one_arm.name(),
                counted(n_arms, "arm"),
                teacher.task.name(),
                counted(teacher.n_heads, "value")
            ));
        }
        if let Some(difference) = one_arm.difference(&teacher.task) {
            return Err(format!("needs a teacher for one arm of {task}, whose {difference}"));
        }
        let copies = teacher.replicated(&self.task);
        let sizes = |policy: &Policy| (policy.n_hidden, policy.n_hidden_layers, policy.n_heads);
        let ddpg = &self.config.ddpg;
        let n_heads = self.config.replay.reward.n_heads(&self.task);
        if sizes(&copies) != (ddpg.n_hidden, ddpg.n_hidden_layers, n_heads) {
            return Err(format!(
                "needs ddpg.n_hidden = {}, ddpg.n_hidden_layers = {} and replay.reward = \"per-arm\" to hold this teacher's \
                 copies",
                copies.n_hidden, copies.n_hidden_layers
            ));
        }
        self.ddpg.start_from(&copies);
        self.observation_normalizer =
            Normalizer::from_snapshot(&copies.observation_normalizer, TEACHER_NORMALIZER_ROWS);
        self.goal_normalizer =
            Normalizer::from_snapshot(&copies.goal_normalizer, TEACHER_NORMALIZER_ROWS);
        Ok(())
    }

    /// Returns the configuration of the run.
    #[must_use]
    pub const fn config(&self) -> &RunConfig {
        &self.config
    }

    /// Returns the counters of the run.
    #[must_use]
    pub const fn counters(&self) -> Counters {
        self.counters
    }

    /// Returns the statistics of the latest round.
    #[must_use]
    pub const fn stats(&self) -> RoundStats {
        self.stats
    }

    /// Sets the threads of the update, 1 or more; the results are the same.
    pub fn set_threads(&mut self, n_threads: usize) {
        self.ddpg.set_threads(n_threads);
    }

    /// Adds a round's episodes, in episode order, to the replay buffer, the normalisers and the counters.
    ///
    /// # Panics
    /// When an episode belongs to another task.
    pub fn ingest(&mut self, episodes: &[Episode]) {
        for episode in episodes {
            self.replay.push(episode);
            self.update_normalizers(episode);
            self.counters.advice_spent += u64::from(episode.advice_charged);
            self.counters.advice_queries += u64::from(episode.queried_steps.unwrap_or(0));
        }
        self.counters.episodes += episodes.len() as u64;
        self.counters.env_steps += (episodes.len() * self.task.episode_steps()) as u64;
        let share = |hits: usize| hits as f64 / episodes.len().max(1) as f64;
        self.stats.training_success =
            share(episodes.iter().filter(|episode| episode.succeeded()).count());
        self.stats.training_moved =
            share(episodes.iter().filter(|episode| episode.moved()).count());
        self.shorten_jump_start(episodes);
    }

    /// Adds the success of a round's episodes without advice to the horizon; of all episodes if all are advised.
    fn shorten_jump_start(&mut self, episodes: &[Episode]) {
        let Some(jump_start) = &mut self.jump_start else { return };
        let share = self.config.advice.share;
        let counts =
            |episode: &&Episode| share >= 1.0 || !orders::is_advised(episode.number, share);
        let counted = || episodes.iter().filter(counts);
        let count = |n| u32::try_from(n).expect("a round has at most 65,536 episodes");
        let n_succeeded = counted().filter(|episode| episode.succeeded()).count();
        jump_start.finish_round(count(counted().count()), count(n_succeeded));
    }

    /// Sets the units of advice spent, which the teacher's account determines.
    pub const fn correct_advice_spent(&mut self, units: u64) {
        self.counters.advice_spent = units;
    }

    /// Returns a description of the first statistic of the normalisers that is not finite or exceeds every value that a
    /// world can produce. Inputs normalised with it are indistinguishable, so the policy cannot learn.
    #[must_use]
    pub fn implausible_statistic(&self) -> Option<String> {
        let task = &self.task;
        let goal_bound = |idx: usize| {
            let achieved = task.description().achieved_goal[idx];
            task.goal_bound(idx).max(task.observation_bound(achieved))
        };
        let observation = self.observation_normalizer.snapshot();
        first_implausible("observations", observation, |idx| task.observation_bound(idx))
            .or_else(|| first_implausible("goals", self.goal_normalizer.snapshot(), goal_bound))
    }

    /// Makes a round's updates. Calls `on_update` with their number after each.
    ///
    /// # Errors
    /// When a loss or a parameter is no longer finite. The state is unusable then.
    ///
    /// # Panics
    /// When no episode was [ingested](Self::ingest) yet.
    pub fn learn(&mut self, mut on_update: impl FnMut(u64)) -> Result<RoundStats, DdpgError> {
        let mut rng = episode_rng(self.config.seed, self.counters.round, Stream::Replay);
        let statistics = Statistics {
            observation: self.observation_normalizer.snapshot(),
            goal: self.goal_normalizer.snapshot(),
        };
        let settings = self.config.at_round(self.counters.round);
        self.sampler.set_contact_cost(settings.contact_cost);
        let n_updates = self.config.updates_per_round();
        let mut sums = RoundStats::default();
        for update in 1..=n_updates {
            self.sampler.fill(&self.replay, statistics, &mut rng, &mut self.batch);
            let losses = self.ddpg.update(settings.update, &self.batch)?;
            if let Some(ensemble) = &mut self.ensemble
                && !ensemble.update(self.ddpg.critic_batch())
            {
                let what = "a parameter of the ensemble of critics";
                return Err(DdpgError::NotFinite { what, update: self.ddpg.n_updates() });
            }
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
        self.stats.critic_loss = sums.critic_loss / n_updates as f64;
        self.stats.actor_loss = sums.actor_loss / n_updates as f64;
        self.stats.mean_q = sums.mean_q / n_updates as f64;
        Ok(self.stats)
    }

    /// Returns the actor for the workers; its version is the number of rounds learned.
    #[must_use]
    pub fn publish(&self) -> PublishedActor {
        let actor = match self.config.behaviour {
            Behaviour::Target => self.ddpg.target_actor(),
            Behaviour::Online => self.ddpg.actor().to_vec(),
        };
        let NormalizerSnapshot { mean: observation_mean, std: observation_std } =
            self.observation_normalizer.snapshot().clone();
        let NormalizerSnapshot { mean: goal_mean, std: goal_std } =
            self.goal_normalizer.snapshot().clone();
        PublishedActor {
            version: self.counters.round,
            n_hidden: self.config.ddpg.n_hidden,
            n_hidden_layers: self.config.ddpg.n_hidden_layers,
            actor,
            observation_mean,
            observation_std,
            goal_mean,
            goal_std,
            gate: self.config.advice.disagreement_threshold().and_then(|threshold| {
                self.ensemble.as_ref().map(|ensemble| ensemble.publish(threshold))
            }),
        }
    }

    /// Returns the policy that acts now, with its critic and normalisers.
    #[must_use]
    pub fn policy(&self, metadata: BTreeMap<String, String>) -> Policy {
        let (actor, critic) = match self.config.behaviour {
            Behaviour::Target => (self.ddpg.target_actor(), self.ddpg.target_critic()),
            Behaviour::Online => (self.ddpg.actor().to_vec(), self.ddpg.critic().to_vec()),
        };
        Policy {
            task: self.task.clone(),
            n_hidden: self.config.ddpg.n_hidden,
            n_hidden_layers: self.config.ddpg.n_hidden_layers,
            n_heads: self.config.replay.reward.n_heads(&self.task),
            actor,
            critic,
            observation_normalizer: self.observation_normalizer.snapshot().clone(),
            goal_normalizer: self.goal_normalizer.snapshot().clone(),
            metadata,
        }
    }

    /// Returns SHA-256 over parameters, optimisers, normalisers, replay buffer and counters, hexadecimal.
    #[must_use]
    pub fn digest(&self) -> String {
        let mut hash = Sha256::new();
        for (name, values) in self.tensors() {
            hash.update(name.as_bytes());
            hash.update(bytemuck::cast_slice::<f32, u8>(&values));
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
        for number in self.jump_start.iter().flat_map(JumpStart::state) {
            hash.update(number.to_le_bytes());
        }
        let Counters { round, env_steps, episodes, updates, advice_spent, advice_queries: _ } =
            self.counters;
        for count in
            [next as u64, self.ddpg.n_updates(), round, env_steps, episodes, updates, advice_spent]
        {
            hash.update(count.to_le_bytes());
        }
        hex(&hash.finalize())
    }

    /// Returns the large float vectors of the state by name, in a fixed order.
    #[must_use]
    pub fn tensors(&self) -> Vec<(String, Cow<'_, [f32]>)> {
        let (parts, _) = self.replay.parts();
        let replay = [
            ("replay.observations", parts.observations.as_slice()),
            ("replay.goals", parts.goals.as_slice()),
            ("replay.actions", parts.actions.as_slice()),
        ];
        let ddpg =
            self.ddpg.state().into_iter().map(|(name, values)| (format!("ddpg.{name}"), values));
        let ensemble = self.ensemble.iter().flat_map(CriticEnsemble::state);
        let ensemble =
            ensemble.map(|(name, values)| (format!("ensemble.{name}"), Cow::from(values)));
        let replay = replay.map(|(name, values)| (name.to_owned(), Cow::from(values)));
        ddpg.chain(replay).chain(ensemble).collect()
    }

    /// Updates the normalisers with an episode's observations, and with goals relabelled as in a batch.
    fn update_normalizers(&mut self, episode: &Episode) {
        let mut rng = episode_rng(self.config.seed, episode.number, Stream::Normaliser);
        let replay = &self.config.replay;
        let both_orders = replay.arm_swap_prob > 0.0 && self.task.has_interchangeable_arms();
        let (mut observations, mut goals) = (Vec::new(), Vec::new());
        for step_idx in 0..episode.n_steps() {
            let goal = relabelled_goal(replay, &self.task, episode, step_idx, &mut rng);
            let observation = episode.observation(step_idx);
            observations.extend_from_slice(observation);
            goals.extend_from_slice(&goal);
            if both_orders {
                observations.extend(self.swapped(observation, TaskSpec::observation_of));
                goals.extend(self.swapped(&goal, TaskSpec::goal_of));
            }
        }
        self.observation_normalizer.update(&observations);
        self.goal_normalizer.update(&goals);
    }

    /// Returns a vector in which the parts of the arms have the reverse order.
    fn swapped(&self, vector: &[f32], part_of: fn(&TaskSpec, ArmIndex) -> &Part) -> Vec<f32> {
        let (task, mut swapped) = (&self.task, vector.to_vec());
        for (to, from) in arm_sources(task.n_arms(), true) {
            part_of(task, to).copy_from(&mut swapped, part_of(task, from), vector);
        }
        swapped
    }
}

fn first_implausible(
    what: &str,
    snapshot: &NormalizerSnapshot,
    largest: impl Fn(usize) -> f32,
) -> Option<String> {
    // A mean or a standard deviation of bounded numbers exceeds their bound only by rounding. The latter has a floor.
    let is_sane = |(idx, (mean, std)): &(usize, (&f32, &f32))| {
        let largest = 1.001 * largest(*idx);
        mean.abs() <= largest && std.abs() <= largest.max(STD_FLOOR)
    };
    let mut numbers = snapshot.mean.iter().zip(&snapshot.std).enumerate();
    let (idx, (mean, std)) = numbers.find(|number| !is_sane(number))?;
    Some(format!(
        "number {idx} of the {what} has mean {mean:e} and standard deviation {std:e} over the run, which no world produces: \
         the policy cannot learn from it"
    ))
}

#[cfg(test)]
mod tests;
