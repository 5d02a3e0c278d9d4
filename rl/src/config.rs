//! The run file: everything that decides what a run learns.
//!
//! A recipe gives every value; a run file and `--set` change some. Unknown keys are refused.

use serde::{Deserialize, Serialize};
use tandem_core::layout::{EPISODE_STEPS, GOAL_TOLERANCE_M, Layout, Task, UnknownTask};
use tandem_core::work::{Exploration, WorldTerms};

use crate::ddpg::DdpgConfig;
use crate::her::{ReplayConfig, RewardKind};

/// A named set of values for every setting.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Recipe {
    /// The paper's DDPG + HER with the reference implementation's values.
    Paper,
    /// What learns fastest on two cores.
    Tandem,
}

/// A whole run, resolved.
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Name of the run; also of its account at the teacher.
    pub name: String,
    /// `push` or `pick-and-place`.
    pub task: String,
    /// Arms of the learning policy, 1 or 2.
    pub arms: usize,
    /// Where every random draw of the run starts from.
    pub seed: u64,
    /// The recipe that the defaults came from.
    pub recipe: Recipe,
    /// Which network acts: `target` (the paper) or `online`.
    pub behaviour: Behaviour,
    /// Who is asked for advice, and when.
    pub advice: AdviceConfig,
    /// How a round is made up.
    pub rounds: RoundsConfig,
    /// How training episodes explore.
    pub exploration: ExplorationConfig,
    /// How episodes start and how finely they are simulated.
    pub world: WorldSettings,
    /// What is kept of the past and how batches are drawn from it.
    pub replay: ReplayConfig,
    /// The update.
    pub ddpg: DdpgConfig,
    /// When and on what the policy is judged.
    pub evaluation: EvaluationConfig,
    /// When the run ends.
    pub stop: StopConfig,
    /// When the learning state is saved.
    pub checkpoint: CheckpointConfig,
}

/// Which network's parameters the workers act with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Behaviour {
    /// The Polyak-averaged one (the paper, section 4.1).
    Target,
    /// The one that is being updated.
    Online,
}

/// The strategy without advice whose student starts as a copy of the teacher for each arm.
pub const INIT_TEACHER: &str = "init:teacher";

/// `[advice]`
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct AdviceConfig {
    /// `none`, `ea`, `eamc:T`, `mc-q:T`, `mc-act:A` or `mc-act-abs:A` (section 3.2 of the paper), or [`INIT_TEACHER`].
    pub strategy: String,
    /// Units of advice for the whole run (paper: 500,000).
    pub budget: u64,
    /// Share of the training episodes that are advised, in [0, 1] (paper: 1).
    pub share: f64,
}

impl AdviceConfig {
    /// Whether anybody is asked at all.
    #[must_use]
    pub fn asks(&self) -> bool {
        self.strategy != "none" && !self.starts_from_teacher() && self.share > 0.0
    }

    /// Whether the run starts from copies of the teacher instead of asking it.
    #[must_use]
    pub fn starts_from_teacher(&self) -> bool {
        self.strategy == INIT_TEACHER
    }

    /// Whether the run has a use for a teacher's policy at all.
    #[must_use]
    pub fn needs_teacher(&self) -> bool {
        self.asks() || self.starts_from_teacher()
    }
}

/// `[rounds]`
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RoundsConfig {
    /// Slots a round (paper: 16, one a worker).
    pub slots: usize,
    /// Episodes a slot, stepped in lock step (paper: 2).
    pub rollouts: usize,
    /// 0: a round is played with the parameters of the round before (paper). 1: it is played while the round before
    /// is being learned.
    pub lag: u32,
    /// Updates for each environment step of a round, 1e-9 to 100; a round has at least one.
    pub updates_per_env_step: f64,
    /// Polyak averaging after every update (`update`) or once a round (`round`, paper).
    pub polyak_every: PolyakEvery,
    /// Training starts with this many environment steps of random actions.
    pub warmup_env_steps: u64,
}

/// When the target networks move.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum PolyakEvery {
    /// After every update.
    Update,
    /// Once at the end of a round's updates.
    Round,
}

/// `[exploration]`
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ExplorationConfig {
    /// Standard deviation of the Gaussian added to every action component.
    pub noise_std: f32,
    /// Share of an arm's steps with random actions, in [0, 1).
    pub random_share: f32,
    /// Steps for which a random action is kept, on average, at least 1.
    pub random_hold_mean_steps: f32,
}

/// `[world]`
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct WorldSettings {
    /// Share of training episodes that start with the objects grasped (pick and place), in [0, 1].
    pub gripped_start_share: f32,
    /// Share of training episodes that start with the hand anywhere above the table, in [0, 1].
    pub wide_start_share: f32,
    /// Physics steps of each control step of 0.04 s: 20, or 10 for quick tests.
    pub substeps: u32,
}

/// `[evaluation]`
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct EvaluationConfig {
    /// Environment steps between two evaluations.
    pub every_env_steps: u64,
    /// Fixed goals of an evaluation (paper: 240).
    pub episodes: u64,
    /// Which goals: the choosing set of the run. Reports use another.
    pub seed: u64,
    /// How many of an evaluation's episodes are logged.
    pub recorded_episodes: u64,
    /// Test goals on which the best policy is measured once the run has ended.
    pub test_episodes: u64,
}

/// `[stop]`: a run ends at the first of these; 0 means never.
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct StopConfig {
    /// Success rate of an evaluation, in [0, 1].
    pub until_success: f64,
    /// Environment steps of training. A run file that gives minutes and no steps drops the recipe's steps.
    pub max_env_steps: u64,
    /// Minutes of wall time, resumed parts added up.
    pub max_minutes: f64,
}

/// `[checkpoint]`
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct CheckpointConfig {
    /// Rounds between two checkpoints.
    pub every_rounds: u64,
    /// How many are kept.
    pub keep: usize,
}

/// A value that cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ConfigError {
    /// A number outside its range.
    #[error("{key} is {value}: expected {expected}")]
    OutOfRange {
        /// Dotted name of the setting.
        key: &'static str,
        /// What it is.
        value: String,
        /// What it may be.
        expected: &'static str,
    },
    /// A task that does not exist.
    #[error(transparent)]
    Task(#[from] UnknownTask),
}

impl RunConfig {
    /// The recipe's values for a task and a number of arms.
    ///
    /// Sources: paper, section 4 and the HER reference implementation (OpenAI baselines) for [`Recipe::Paper`].
    #[must_use]
    pub fn defaults(recipe: Recipe, task: Task, n_arms: usize) -> Self {
        let tandem = recipe == Recipe::Tandem;
        let pick = |for_tandem: f64, for_paper: f64| if tandem { for_tandem } else { for_paper };
        Self {
            name: format!("{task}-{n_arms}"),
            task: task.name().to_owned(),
            arms: n_arms,
            seed: 1,
            recipe,
            behaviour: Behaviour::Target,
            advice: AdviceConfig {
                strategy: if n_arms == 1 { "none" } else { "mc-q:0.1" }.to_owned(),
                budget: 500_000,
                share: pick(0.5, 1.0),
            },
            rounds: rounds(recipe),
            exploration: ExplorationConfig {
                noise_std: 0.2,
                random_share: 0.3,
                random_hold_mean_steps: if tandem { 4.0 } else { 1.0 },
            },
            world: world(recipe, task),
            replay: replay(recipe, n_arms),
            ddpg: ddpg(recipe, n_arms),
            evaluation: EvaluationConfig {
                every_env_steps: 20_000,
                episodes: 240,
                seed: 240_240,
                recorded_episodes: 2,
                test_episodes: 240,
            },
            stop: stop(recipe, task, n_arms),
            checkpoint: CheckpointConfig { every_rounds: 50, keep: 2 },
        }
    }

    /// The settings with which a run that starts from a teacher of the recipe's size can do so: the teacher's depth, and
    /// its width for each arm.
    #[must_use]
    pub fn sized_for_copies(mut self, task: Task) -> Self {
        let teacher = Self::defaults(self.recipe, task, 1).ddpg;
        self.ddpg.n_hidden = teacher.n_hidden * self.arms;
        self.ddpg.n_hidden_layers = teacher.n_hidden_layers;
        self
    }

    /// The layout of the learning policy.
    ///
    /// # Errors
    /// When the task does not exist.
    pub fn layout(&self) -> Result<Layout, ConfigError> {
        Ok(Layout::new(self.task.parse()?, self.arms))
    }

    /// Episodes of a round.
    #[must_use]
    pub const fn episodes_per_round(&self) -> u64 {
        (self.rounds.slots * self.rounds.rollouts) as u64
    }

    /// Environment steps of a round.
    #[must_use]
    pub const fn env_steps_per_round(&self) -> u64 {
        self.episodes_per_round() * EPISODE_STEPS as u64
    }

    /// Updates of a round, at least one.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "checked: not negative, below 2^32"
    )]
    pub fn updates_per_round(&self) -> u64 {
        ((self.env_steps_per_round() as f64 * self.rounds.updates_per_env_step).round() as u64)
            .max(1)
    }

    /// Whether round `round`, from 0, lies in the last `ddpg.cooldown_share` of the run's environment steps. A run
    /// whose end is not given in environment steps never cools down.
    #[must_use]
    pub fn is_cooldown(&self, round: u64) -> bool {
        let max = self.stop.max_env_steps;
        let first = (1.0 - f64::from(self.ddpg.cooldown_share)) * max as f64;
        max > 0 && (round * self.env_steps_per_round()) as f64 >= first
    }

    /// Rounds between two evaluations, at least one.
    #[must_use]
    pub fn rounds_per_evaluation(&self) -> u64 {
        (self.evaluation.every_env_steps / self.env_steps_per_round()).max(1)
    }

    /// How workers explore.
    #[must_use]
    pub const fn exploration(&self) -> Exploration {
        let ExplorationConfig { noise_std, random_share, random_hold_mean_steps } =
            self.exploration;
        Exploration { noise_std, random_share, random_hold_mean_steps }
    }

    /// How workers start and simulate episodes.
    #[must_use]
    pub const fn world_terms(&self) -> WorldTerms {
        let WorldSettings { gripped_start_share, wide_start_share, substeps } = self.world;
        WorldTerms { gripped_start_share, wide_start_share, substeps }
    }

    /// Checks what the types cannot; NaN fails every range.
    ///
    /// # Errors
    /// Names the first setting that cannot be used and what it may be.
    pub fn checked(self) -> Result<Self, ConfigError> {
        let layout = self.layout()?;
        check("arms", &self.arms, (1..=2).contains(&layout.n_arms), "1 or 2")?;
        check(
            "name",
            &&self.name,
            is_name(&self.name),
            "1 to 100 letters, digits, '-', '_' or '.'",
        )?;
        check(
            "seed",
            &self.seed,
            self.seed != self.evaluation.seed,
            "another than evaluation.seed",
        )?;
        let shares = [
            ("advice.share", self.advice.share),
            ("world.gripped_start_share", f64::from(self.world.gripped_start_share)),
            ("world.wide_start_share", f64::from(self.world.wide_start_share)),
            ("replay.her_future_share", f64::from(self.replay.her_future_share)),
            ("replay.moved_share", f64::from(self.replay.moved_share)),
            ("replay.advised_share", f64::from(self.replay.advised_share)),
            ("replay.recombined_share", f64::from(self.replay.recombined_share)),
            ("replay.swap_share", f64::from(self.replay.swap_share)),
            ("stop.until_success", self.stop.until_success),
        ];
        for (key, share) in shares {
            check(key, &share, (0.0..=1.0).contains(&share), "a number in [0, 1]")?;
        }
        self.check_rounds()?;
        self.check_exploration()?;
        check(
            "stop.max_minutes",
            &self.stop.max_minutes,
            self.stop.max_minutes >= 0.0 && self.stop.max_minutes.is_finite(),
            "0 (never) or more",
        )?;
        check(
            "advice.budget",
            &self.advice.budget,
            self.advice.budget <= 1_000_000_000_000,
            "at most 10^12",
        )?;
        self.ddpg.check().map_err(|(key, value, expected)| ConfigError::OutOfRange {
            key,
            value,
            expected,
        })?;
        Ok(self)
    }

    fn check_rounds(&self) -> Result<(), ConfigError> {
        let (rounds, evaluation) = (&self.rounds, &self.evaluation);
        check("rounds.slots", &rounds.slots, (1..=4096).contains(&rounds.slots), "1 to 4096")?;
        check("rounds.rollouts", &rounds.rollouts, (1..=64).contains(&rounds.rollouts), "1 to 64")?;
        check("rounds.lag", &rounds.lag, rounds.lag <= 1, "0 or 1")?;
        let updates = rounds.updates_per_env_step;
        check(
            "rounds.updates_per_env_step",
            &updates,
            (1e-9..=100.0).contains(&updates),
            "1e-9 to 100",
        )?;
        check(
            "evaluation.episodes",
            &evaluation.episodes,
            (1..=100_000).contains(&evaluation.episodes),
            "1 to 100,000",
        )?;
        check(
            "evaluation.test_episodes",
            &evaluation.test_episodes,
            (1..=100_000).contains(&evaluation.test_episodes),
            "1 to 100,000",
        )?;
        let tolerance_m = self.replay.goal_tolerance_m;
        check(
            "replay.goal_tolerance_m",
            &tolerance_m,
            (1e-4..=1.0).contains(&tolerance_m),
            "0.0001 to 1",
        )?;
        let cost = self.replay.contact_cost;
        check("replay.contact_cost", &cost, (0.0..=100.0).contains(&cost), "0 to 100")?;
        let foresight = self.replay.contact_foresight_steps;
        check("replay.contact_foresight_steps", &foresight, foresight <= EPISODE_STEPS, "0 to 50")?;
        let kept = self.replay.capacity_transitions;
        check("replay.capacity_transitions", &kept, kept >= EPISODE_STEPS, "at least 50")?;
        check(
            "checkpoint.every_rounds",
            &self.checkpoint.every_rounds,
            self.checkpoint.every_rounds > 0,
            "at least 1",
        )?;
        check("checkpoint.keep", &self.checkpoint.keep, self.checkpoint.keep > 0, "at least 1")
    }

    fn check_exploration(&self) -> Result<(), ConfigError> {
        let ExplorationConfig { noise_std, random_share, random_hold_mean_steps } =
            self.exploration;
        check("exploration.noise_std", &noise_std, (0.0..=10.0).contains(&noise_std), "0 to 10")?;
        check(
            "exploration.random_share",
            &random_share,
            (0.0..1.0).contains(&random_share),
            "a number in [0, 1)",
        )?;
        let hold = random_hold_mean_steps;
        check(
            "exploration.random_hold_mean_steps",
            &&hold,
            (1.0..=50.0).contains(&hold),
            "1 to 50",
        )?;
        check(
            "world.substeps",
            &self.world.substeps,
            matches!(self.world.substeps, 10 | 20),
            "10 or 20",
        )
    }
}

fn check(
    key: &'static str,
    value: &(impl ToString + ?Sized),
    fine: bool,
    expected: &'static str,
) -> Result<(), ConfigError> {
    if fine {
        Ok(())
    } else {
        Err(ConfigError::OutOfRange { key, value: value.to_string(), expected })
    }
}

/// Whether `name` can be a run's: 1 to 100 letters, digits, '-', '_' or '.'.
#[must_use]
pub fn is_name(name: &str) -> bool {
    (1..=100).contains(&name.len())
        && name.chars().all(|c| c.is_ascii_alphanumeric() || "-_.".contains(c))
}

const fn rounds(recipe: Recipe) -> RoundsConfig {
    match recipe {
        Recipe::Tandem => RoundsConfig {
            slots: 8,
            rollouts: 2,
            lag: 1,
            updates_per_env_step: 0.5,
            polyak_every: PolyakEvery::Update,
            warmup_env_steps: 2000,
        },
        Recipe::Paper => RoundsConfig {
            slots: 16,
            rollouts: 2,
            lag: 0,
            updates_per_env_step: 0.025,
            polyak_every: PolyakEvery::Round,
            warmup_env_steps: 0,
        },
    }
}

/// Where a run ends: the paper's recipe by the clock, because it has no end in sight on two cores.
const fn stop(recipe: Recipe, task: Task, n_arms: usize) -> StopConfig {
    let max_env_steps = match (recipe, task, n_arms) {
        (Recipe::Paper, ..) => 0,
        (Recipe::Tandem, Task::Push, 1) => 200_000,
        (Recipe::Tandem, ..) => 300_000,
    };
    let max_minutes = if max_env_steps == 0 { 30.0 } else { 0.0 };
    StopConfig { until_success: 0.0, max_env_steps, max_minutes }
}

fn world(recipe: Recipe, task: Task) -> WorldSettings {
    let helped = recipe == Recipe::Tandem && task == Task::PickAndPlace;
    WorldSettings {
        gripped_start_share: if helped { 0.2 } else { 0.0 },
        wide_start_share: 0.0,
        substeps: 20,
    }
}

fn replay(recipe: Recipe, n_arms: usize) -> ReplayConfig {
    let tandem = recipe == Recipe::Tandem;
    ReplayConfig {
        capacity_transitions: 1_000_000,
        her_future_share: 0.8,
        moved_share: if tandem { 0.5 } else { 0.0 },
        advised_share: 0.0,
        recombined_share: if tandem && n_arms == 2 { 1.0 } else { 0.0 },
        swap_share: if tandem && n_arms == 2 { 0.5 } else { 0.0 },
        reward: if tandem { RewardKind::PerArm } else { RewardKind::Joint },
        goal_tolerance_m: if tandem { 0.04 } else { GOAL_TOLERANCE_M },
        contact_cost: if tandem && n_arms == 2 { 1.0 } else { 0.0 },
        contact_foresight_steps: if tandem && n_arms == 2 { 5 } else { 0 },
    }
}

fn ddpg(recipe: Recipe, n_arms: usize) -> DdpgConfig {
    let tandem = recipe == Recipe::Tandem;
    DdpgConfig {
        n_hidden: 256,
        n_hidden_layers: if n_arms == 1 { 3 } else { 4 },
        discount: if tandem { 0.95 } else { 0.98 },
        action_penalty: if tandem { 0.1 } else { 1.0 },
        cloning_weight: if tandem && n_arms > 1 { 2.0 } else { 0.0 },
        cooldown_share: if tandem { 0.2 } else { 0.0 },
        ..DdpgConfig::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_recipe_passes_its_own_checks() {
        for (recipe, task, n_arms) in [
            (Recipe::Tandem, Task::Push, 1),
            (Recipe::Tandem, Task::PickAndPlace, 2),
            (Recipe::Paper, Task::Push, 2),
            (Recipe::Paper, Task::PickAndPlace, 1),
        ] {
            assert!(RunConfig::defaults(recipe, task, n_arms).checked().is_ok());
        }
    }

    #[test]
    fn the_papers_round_has_forty_updates() {
        let paper = RunConfig::defaults(Recipe::Paper, Task::Push, 2);
        assert_eq!((paper.episodes_per_round(), paper.updates_per_round()), (32, 40));
    }

    #[test]
    fn a_run_cools_down_over_its_last_fifth_if_it_has_an_end() {
        let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
        config.stop.max_env_steps = 10_000;
        let first = (0..100).find(|round| config.is_cooldown(*round));
        assert_eq!((config.env_steps_per_round(), first), (800, Some(10)), "8,000 of 10,000");
        config.ddpg.cooldown_share = 0.0;
        assert!((0..=12).all(|round| !config.is_cooldown(round)), "no share of it");
        config.stop.max_env_steps = 0;
        assert!((0..100).all(|round| !config.is_cooldown(round)), "without an end");
    }

    #[test]
    fn a_bad_value_is_named() {
        let check = |change: fn(&mut RunConfig), key| {
            let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
            change(&mut config);
            let message = config.checked().expect_err("must be refused").to_string();
            assert!(message.contains(key), "{message:?} does not name {key:?}");
        };
        check(|config| config.arms = 3, "arms");
        check(|config| config.task = "shove".to_owned(), "shove");
        check(|config| config.advice.share = f64::NAN, "advice.share");
        check(|config| config.rounds.updates_per_env_step = 0.0, "rounds.updates_per_env_step");
        check(|config| config.rounds.updates_per_env_step = 1e-300, "updates_per_env_step");
        check(|config| config.replay.goal_tolerance_m = 1e-30, "replay.goal_tolerance_m");
        check(|config| config.stop.max_minutes = f64::INFINITY, "stop.max_minutes");
        check(|config| config.ddpg.actor_learning_rate = 1e-40, "ddpg.actor_learning_rate");
        check(|config| config.exploration.random_share = 1.0, "exploration.random_share");
        check(|config| config.name = "a/b".to_owned(), "name");
        check(|config| config.ddpg.discount = 1.0, "ddpg.discount");
    }
}
