//! The run file: every setting that determines what a run learns.
//!
//! A recipe gives each setting a value; a run file and `--set` override values. Unknown keys are refused.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tandem_core::layout::UnknownTask;
use tandem_core::settings::OutOfRange;
use tandem_core::task::{InvalidTask, MAX_ARMS};
use tandem_core::{
    AdviceTerms, AdviceUnit, Exploration, JudgedAction, Strategy, Task, TaskDescription, TaskSpec,
    WorldSettings,
};

use crate::ddpg::DdpgConfig;
use crate::her::ReplayConfig;

mod checks;
pub mod former_keys;
mod recipe;
mod schedule;
#[cfg(test)]
mod tests;

pub use checks::is_name;
pub use recipe::{Recipe, UnknownRecipe};
pub use schedule::RoundSettings;

/// The most episodes of an evaluation's slot.
pub(crate) const EVALUATION_SLOT_EPISODES: usize = 8;

/// The resolved settings of a run.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Name of the run, and of its account at the teacher: 1 to 100 letters, digits, `-`, `_` or `.`. A new run of
    /// `tandem train` is named after its directory.
    pub name: String,
    /// A built-in task, by its full name: `push` and `pick-and-place` are those of the classic world. Or the name of
    /// `description`.
    pub task: String,
    /// Arms of the learning policy: 1 or 2, or those of `description`.
    pub arms: usize,
    /// Seed of every random number of the run. It differs from `evaluation.seed` and from 777, the seed of the test
    /// goals.
    pub seed: u64,
    /// The recipe that the defaults come from.
    pub recipe: Recipe,
    /// The network that acts: `target` (the paper) or `online`.
    pub behaviour: Behaviour,
    /// The teacher's strategy and budget.
    pub advice: AdviceConfig,
    /// The composition of a round: episodes, updates and their order.
    pub rounds: RoundsConfig,
    /// Exploration in training episodes.
    pub exploration: Exploration,
    /// Starts of training episodes, and the resolution of the simulation.
    pub world: WorldSettings,
    /// The replay buffer, and how batches are sampled from it.
    pub replay: ReplayConfig,
    /// The update.
    pub ddpg: DdpgConfig,
    /// Times and goals of the policy's evaluations.
    pub evaluation: EvaluationConfig,
    /// Limits of the run.
    pub stop: StopConfig,
    /// Times at which the learning state is saved.
    pub checkpoint: CheckpointConfig,
    /// The task, unless it is built-in: a section of the run file, or the path of a TOML file with its fields, relative
    /// to the run file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(skip)]
    pub description: Option<TaskDescription>,
}

/// The network whose parameters the workers act with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, JsonSchema, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Behaviour {
    /// The Polyak-averaged network (the paper, section 4.2).
    Target,
    /// The network that is being updated.
    Online,
}

/// The strategy without advice whose student starts as a copy of the teacher for each arm.
pub const INIT_TEACHER: &str = "init:teacher";

/// Section `[advice]`.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema, Serialize)]
#[serde(deny_unknown_fields)]
pub struct AdviceConfig {
    /// Advising strategy and its threshold (the paper, section 3.2), or `init:teacher`: no advice, the student starts
    /// as a copy of the teacher for each arm.
    pub strategy: String,
    /// Units of advice, at most 10^12 for the whole run (paper, section 4.1: 500,000).
    pub budget: u64,
    /// Whether the budget is that of the run (`run`) or of each of its slots (`slot`). The budgets of the slots are
    /// added up to one: slots differ in their seeds only and spend alike.
    #[serde(default)]
    pub budget_scope: BudgetScope,
    /// The steps that a unit pays for: one step of one episode (`env-step`), or the simultaneous steps of all advised
    /// episodes of a slot (`slot-step`).
    #[serde(default)]
    pub unit: AdviceUnit,
    /// The action that the teacher judges: the one to be executed, exploration included (`executed`), or the policy's
    /// without exploration (`policy`; π_st(s) of equation 10).
    #[serde(default)]
    pub judged_action: JudgedAction,
    /// Fraction of the training episodes that are advised, in [0, 1] (paper: 1).
    pub share: f64,
}

/// The part of a run that a budget of advice is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize, JsonSchema, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum BudgetScope {
    /// All slots of the run.
    #[default]
    Run,
    /// Each slot of a round.
    Slot,
}

impl AdviceConfig {
    /// Returns how workers ask for advice.
    #[must_use]
    pub const fn terms(&self) -> AdviceTerms {
        AdviceTerms { judged_action: self.judged_action, unit: self.unit }
    }

    /// Returns true if workers ask a teacher for advice.
    #[must_use]
    pub fn asks(&self) -> bool {
        self.strategy != "none" && !self.starts_from_teacher() && self.share > 0.0
    }

    /// Returns the strategy; `None` if its name is unknown or [`INIT_TEACHER`].
    #[must_use]
    pub fn parsed_strategy(&self) -> Option<Strategy> {
        self.strategy.parse().ok()
    }

    /// Returns the largest number of control steps at the start of an episode on which the student asks; `None` means
    /// all.
    #[must_use]
    pub fn horizon(&self) -> Option<u32> {
        match self.parsed_strategy() {
            Some(Strategy::JumpStart { horizon }) => Some(horizon),
            _ => None,
        }
    }

    /// Returns the standard deviation of the critics' values above which the student asks; `None` means that it asks on
    /// every step.
    #[must_use]
    pub fn disagreement_threshold(&self) -> Option<f32> {
        match self.parsed_strategy() {
            Some(Strategy::CriticDisagreement { threshold }) => Some(threshold),
            _ => None,
        }
    }

    /// Returns the cost to an arm of its own step before the teacher overrides it: 1 with strategy `rlif:T`, else 0.
    #[must_use]
    pub fn intervention_cost(&self) -> f32 {
        match self.parsed_strategy() {
            Some(Strategy::InterventionFeedback { .. }) => 1.0,
            _ => 0.0,
        }
    }

    /// Returns true if the student starts as copies of the teacher instead of asking it.
    #[must_use]
    pub fn starts_from_teacher(&self) -> bool {
        self.strategy == INIT_TEACHER
    }

    /// Returns true if the run uses a teacher's policy in either way.
    #[must_use]
    pub fn needs_teacher(&self) -> bool {
        self.asks() || self.starts_from_teacher()
    }
}

/// Section `[rounds]`.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RoundsConfig {
    /// Slots per round, 1 to 4096, and at most 65,536 / `rollouts` (paper, section 4.2: 16, one per worker).
    pub slots: usize,
    /// Episodes per slot, stepped in lock step, 1 to 64 (paper, section 4.2: 2).
    pub rollouts: usize,
    /// 0: a round is played with the parameters of the previous round (paper). 1: a round is played while the previous
    /// one is being learned.
    pub lag: u32,
    /// Updates per environment step of a round, 1e-9 to 100; a round has at least one update.
    pub updates_per_env_step: f64,
    /// Polyak averaging after every update (`update`) or once a round (`round`, paper).
    pub polyak_every: PolyakEvery,
    /// Number of environment steps with random actions at the start of training.
    pub warmup_env_steps: u64,
    /// Fraction of the episodes without advice that are played without exploration from three quarters of the run's
    /// environment steps on, in [0, 1]. From one quarter, it rises linearly from 0 until then. A run without a limit in
    /// environment steps has none.
    #[serde(default)]
    pub final_greedy_share: f64,
    /// Rounds that metrics count as one epoch of the paper, 1 to 1,000,000 (cycles per epoch of the HER reference
    /// implementation: 50). It affects no other result.
    #[serde(default = "cycles_per_epoch")]
    pub per_epoch: u64,
}

const fn cycles_per_epoch() -> u64 {
    50
}

/// Frequency of Polyak averaging.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, JsonSchema, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum PolyakEvery {
    /// After every update.
    Update,
    /// Once, after the last update of a round.
    Round,
}

/// Section `[evaluation]`.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema, Serialize)]
#[serde(deny_unknown_fields)]
pub struct EvaluationConfig {
    /// Environment steps between two evaluations, rounded down to whole rounds but at least one; without a value a
    /// fifth of `stop.max_env_steps`, at most the recipe's.
    pub every_env_steps: u64,
    /// Further evaluations before the first regular one, 0 to 100: of the initial policy, then evenly spaced. A run
    /// file that sets `evaluation.every_env_steps` has none unless it sets them, and a run that is so short that it is
    /// evaluated more often than the recipe says has one.
    #[serde(default)]
    pub early_points: u64,
    /// Fixed goals per evaluation, 1 to 100,000 (paper: not given; most success rates of its Table 2 are multiples of
    /// 1/240).
    pub episodes: u64,
    /// Seed of the goals with which a run selects its best policy. Reports use another one.
    pub seed: u64,
    /// Number of episodes of an evaluation that are logged.
    pub recorded_episodes: u64,
    /// Test goals on which the best policy is measured once the run has ended, 1 to 100,000.
    pub test_episodes: u64,
    /// Whether policies are symmetrised before they are evaluated and saved, if the arms are interchangeable: actor,
    /// before tanh, and critic become the means of what they compute for a scene and for the scene with its arms in
    /// reverse order, in networks twice as wide. Training episodes and updates use the networks as they are.
    #[serde(default)]
    pub symmetrized: bool,
}

/// Section `[stop]`: a run ends at the first of these limits; 0 means no limit.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema, Serialize)]
#[serde(deny_unknown_fields)]
pub struct StopConfig {
    /// Success rate of an evaluation, in [0, 1]. Contacts do not count against it.
    pub until_success: f64,
    /// Environment steps of training. A run file that gives minutes and no steps drops the recipe's steps.
    pub max_env_steps: u64,
    /// Minutes of wall time, summed over resumed parts.
    pub max_minutes: f64,
}

/// Section `[checkpoint]`.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema, Serialize)]
#[serde(deny_unknown_fields)]
pub struct CheckpointConfig {
    /// Rounds between two checkpoints, at least 1.
    pub every_rounds: u64,
    /// Checkpoints to keep, at least 1.
    pub keep: usize,
}

/// A configuration that cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ConfigError {
    /// A setting is out of its range.
    #[error(transparent)]
    OutOfRange(#[from] OutOfRange),
    /// The task does not exist.
    #[error(transparent)]
    Task(#[from] UnknownTask),
    /// The description of the task is invalid.
    #[error("description.{0}")]
    Description(#[from] InvalidTask),
}

impl RunConfig {
    /// Returns the task of the learning policy.
    ///
    /// # Errors
    /// When the task does not exist, its description is invalid, or `task` or `arms` contradict the description.
    pub fn task_spec(&self) -> Result<TaskSpec, ConfigError> {
        let Some(description) = &self.description else {
            let task: Task = self.task.parse()?;
            let is_count = (task.min_arms()..=MAX_ARMS).contains(&self.arms);
            let expected = if task.min_arms() == 1 { "1 or 2" } else { "2" };
            OutOfRange::unless(is_count, "arms", self.arms, expected)?;
            return Ok(TaskSpec::built_in(task, self.arms));
        };
        let task = TaskSpec::new(description.clone())?;
        let (name, n_arms) = (task.name(), task.n_arms());
        let expected = format_args!("{name:?}, the name of the description").to_string();
        OutOfRange::unless(self.task == name, "task", self.task.as_str(), expected)?;
        let expected = format_args!("{n_arms}, as in the description").to_string();
        OutOfRange::unless(self.arms == n_arms, "arms", self.arms, expected)?;
        Ok(task)
    }

    /// Returns the number of control steps per episode; 1 for a task that [`checked`](Self::checked) refuses.
    #[must_use]
    pub fn episode_steps(&self) -> usize {
        match &self.description {
            Some(description) => description.episode_steps,
            None => self.task_spec().map_or(1, |task| task.episode_steps()),
        }
    }

    /// Returns the number of episodes per round.
    #[must_use]
    pub const fn episodes_per_round(&self) -> u64 {
        (self.rounds.slots * self.rounds.rollouts) as u64
    }

    /// Returns the number of episodes of the run's largest slot, in training or in an evaluation.
    #[must_use]
    pub fn largest_slot(&self) -> usize {
        let n_evaluated = usize::try_from(self.evaluation.episodes).unwrap_or(usize::MAX);
        self.rounds.rollouts.max(n_evaluated.min(EVALUATION_SLOT_EPISODES))
    }

    /// Returns the units of advice of the whole run.
    #[must_use]
    pub const fn advice_budget(&self) -> u64 {
        match self.advice.budget_scope {
            BudgetScope::Run => self.advice.budget,
            BudgetScope::Slot => self.advice.budget.saturating_mul(self.rounds.slots as u64),
        }
    }

    /// Returns the number of environment steps per round.
    #[must_use]
    pub fn env_steps_per_round(&self) -> u64 {
        self.episodes_per_round() * self.episode_steps() as u64
    }

    /// Returns the number of updates per round, at least one.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "checked: not negative, below 2^53"
    )]
    pub fn updates_per_round(&self) -> u64 {
        ((self.env_steps_per_round() as f64 * self.rounds.updates_per_env_step).round() as u64)
            .max(1)
    }

    /// Returns true if the parameters after `round` rounds are evaluated: those of every
    /// [`rounds_per_evaluation`](Self::rounds_per_evaluation), and the early ones.
    #[must_use]
    pub fn is_evaluated(&self, round: u64) -> bool {
        let (regular, n_early) = (self.rounds_per_evaluation(), self.evaluation.early_points);
        if round >= regular {
            return round.is_multiple_of(regular);
        }
        let early = |point| u128::from(point) * u128::from(regular) / u128::from(n_early);
        (0..n_early).any(|point| early(point) == u128::from(round))
    }

    /// Returns the number of rounds between two evaluations, at least one.
    #[must_use]
    pub fn rounds_per_evaluation(&self) -> u64 {
        (self.evaluation.every_env_steps / self.env_steps_per_round()).max(1)
    }
}
