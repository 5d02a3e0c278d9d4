//! Checks of ranges; NaN is in none.

use std::fmt::Display;

use tandem_core::TaskSpec;
use tandem_core::evaluation::TEST_SEED;
use tandem_core::settings::OutOfRange;

use super::{ConfigError, EvaluationConfig, RunConfig};

/// Most episodes of a round, whose reservations a teacher takes in one request.
const MAX_EPISODES: usize = 65_536;

impl RunConfig {
    /// Returns the configuration if every setting is in its range.
    ///
    /// # Errors
    /// Names the first setting that cannot be used, its value and its range.
    pub fn checked(self) -> Result<Self, ConfigError> {
        let task = self.task_spec()?;
        self.check_run()?;
        self.check_symmetrized(&task)?;
        self.check_advice(&task)?;
        self.check_rounds()?;
        self.check_stop()?;
        self.exploration.check(task.episode_steps())?;
        self.world.check()?;
        self.replay.check(&task)?;
        self.ddpg.check()?;
        Ok(self)
    }

    fn check_run(&self) -> Result<(), OutOfRange> {
        let is_simulated = self.description.is_some() || (1..=2).contains(&self.arms);
        check("arms", self.arms, is_simulated, "1 or 2")?;
        let is_named = is_name(&self.name);
        check("name", &self.name, is_named, "1 to 100 letters, digits, '-', '_' or '.'")?;
        let seed = self.evaluation.seed;
        let expected = "another seed: this one is that of the test goals";
        check("evaluation.seed", seed, seed != TEST_SEED, expected)?;
        check("seed", self.seed, self.seed != TEST_SEED, expected)?;
        let is_own = self.seed != self.evaluation.seed;
        check("seed", self.seed, is_own, "another than evaluation.seed")?;
        let EvaluationConfig { episodes, early_points, test_episodes, .. } = self.evaluation;
        OutOfRange::check_range("evaluation.episodes", episodes, 1..=100_000)?;
        OutOfRange::check_range("evaluation.early_points", early_points, 0..=100)?;
        OutOfRange::check_range("evaluation.test_episodes", test_episodes, 1..=100_000)?;
        let every_rounds = self.checkpoint.every_rounds;
        check("checkpoint.every_rounds", every_rounds, every_rounds > 0, "at least 1")?;
        check("checkpoint.keep", self.checkpoint.keep, self.checkpoint.keep > 0, "at least 1")
    }

    fn check_symmetrized(&self, task: &TaskSpec) -> Result<(), OutOfRange> {
        let symmetrized = self.evaluation.symmetrized;
        let is_usable = !symmetrized || task.has_interchangeable_arms();
        let expected = "false: the arms of this task are not interchangeable";
        check("evaluation.symmetrized", symmetrized, is_usable, expected)
    }

    fn check_advice(&self, task: &TaskSpec) -> Result<(), OutOfRange> {
        let strategy = self.advice.strategy.as_str();
        let can_be_advised = !self.advice.needs_teacher() || task.single_arm().is_some();
        let expected = "none for this task: its arms are not instances of one task of one arm";
        check("advice.strategy", strategy, can_be_advised, expected)?;
        OutOfRange::check_fraction("advice.share", self.advice.share)?;
        let budget = self.advice_budget();
        check("advice.budget", budget, budget <= 1_000_000_000_000, "at most 10^12 in the run")
    }

    fn check_rounds(&self) -> Result<(), OutOfRange> {
        let rounds = &self.rounds;
        check("rounds.slots", rounds.slots, (1..=4096).contains(&rounds.slots), "1 to 4096")?;
        OutOfRange::check_range("rounds.rollouts", rounds.rollouts, 1..=64)?;
        let is_round = rounds.slots * rounds.rollouts <= MAX_EPISODES;
        let expected =
            "at most 65,536 / rounds.rollouts, because a teacher advises no more episodes";
        check("rounds.slots", rounds.slots, is_round, expected)?;
        check("rounds.lag", rounds.lag, rounds.lag <= 1, "0 or 1")?;
        let updates = rounds.updates_per_env_step;
        let is_rate = (1e-9..=100.0).contains(&updates);
        check("rounds.updates_per_env_step", updates, is_rate, "1e-9 to 100")?;
        OutOfRange::check_fraction("rounds.final_greedy_share", rounds.final_greedy_share)?;
        OutOfRange::check_range("rounds.per_epoch", rounds.per_epoch, 1..=1_000_000)
    }

    fn check_stop(&self) -> Result<(), OutOfRange> {
        OutOfRange::check_fraction("stop.until_success", self.stop.until_success)?;
        let minutes = self.stop.max_minutes;
        let is_time = minutes >= 0.0 && minutes.is_finite();
        check("stop.max_minutes", minutes, is_time, "0 (never) or more")
    }
}

/// Names a setting unless its value `is_usable`.
pub(crate) fn check(
    key: &'static str,
    value: impl Display + Copy,
    is_usable: bool,
    expected: &'static str,
) -> Result<(), OutOfRange> {
    OutOfRange::unless(is_usable, key, value, expected)
}

/// Returns true if `name` can be the name of a run: 1 to 100 letters, digits, '-', '_' or '.'.
#[must_use]
pub fn is_name(name: &str) -> bool {
    (1..=100).contains(&name.len())
        && name.chars().all(|c| c.is_ascii_alphanumeric() || "-_.".contains(c))
}
