//! The values that a recipe gives to every setting.

use std::fmt;
use std::str::FromStr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tandem_core::{AdviceUnit, Exploration, JudgedAction, Task, TaskSpec, World, WorldSettings};

use super::{
    AdviceConfig, Behaviour, BudgetScope, CheckpointConfig, EvaluationConfig, PolyakEvery,
    RoundsConfig, RunConfig, StopConfig,
};
use crate::ddpg::DdpgConfig;
use crate::her::{ReplayConfig, RewardKind};

/// A named set of values for all settings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, JsonSchema, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Recipe {
    /// The paper's DDPG + HER, with the values of the HER reference implementation where the paper gives none.
    Paper,
    /// The values that learn fastest on two cores.
    Tandem,
}

impl Recipe {
    /// Both recipes.
    pub const ALL: [Self; 2] = [Self::Paper, Self::Tandem];

    /// Returns the name used in files and on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Paper => "paper",
            Self::Tandem => "tandem",
        }
    }
}

impl fmt::Display for Recipe {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// An unknown name of a recipe.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("recipe is {0:?}: expected \"tandem\" or \"paper\"")]
pub struct UnknownRecipe(pub String);

impl FromStr for Recipe {
    type Err = UnknownRecipe;

    fn from_str(name: &str) -> Result<Self, UnknownRecipe> {
        Self::ALL
            .into_iter()
            .find(|recipe| recipe.name() == name)
            .ok_or_else(|| UnknownRecipe(name.to_owned()))
    }
}

/// Rounds of the paper's epoch (decision 005).
const PAPER_EPOCH_ROUNDS: u64 = 50;
/// Slots of the paper's round, and episodes of a slot.
const PAPER_SLOTS: usize = 16;
const PAPER_ROLLOUTS: usize = 2;

/// Width of the hidden layers, in both recipes; recipe `tandem` halves it for two arms in the world `shared`.
const N_HIDDEN: usize = 256;

impl RunConfig {
    /// Returns the recipe's settings for a built-in task and a number of arms.
    ///
    /// # Panics
    /// If `n_arms` is 0 or exceeds 8.
    #[must_use]
    pub fn defaults(recipe: Recipe, task: Task, n_arms: usize) -> Self {
        Self::defaults_of(recipe, &TaskSpec::built_in(task, n_arms))
    }

    /// Returns the recipe's settings for a task.
    ///
    /// Sources of [`Recipe::Paper`]: section 4 of the paper and the HER reference implementation (OpenAI baselines).
    #[must_use]
    pub fn defaults_of(recipe: Recipe, task: &TaskSpec) -> Self {
        let (task_name, n_arms) = (task.name(), task.n_arms());
        let tandem = recipe == Recipe::Tandem;
        Self {
            name: format!("{}-{n_arms}", task_name.replace('/', "-")),
            task: task_name.to_owned(),
            arms: n_arms,
            seed: 1,
            recipe,
            behaviour: Behaviour::Target,
            advice: AdviceConfig {
                strategy: if n_arms == 1 || task.single_arm().is_none() {
                    "none"
                } else if tandem && carries_past_others(task) {
                    "mc-q:0.4"
                } else {
                    "mc-q:0.1"
                }
                .to_owned(),
                budget: 500_000,
                budget_scope: if tandem { BudgetScope::Run } else { BudgetScope::Slot },
                unit: if tandem { AdviceUnit::EnvStep } else { AdviceUnit::SlotStep },
                judged_action: if tandem { JudgedAction::Executed } else { JudgedAction::Policy },
                share: match (tandem, is_shared(task)) {
                    // Of twice as many episodes as in push, half the share is as many advised ones.
                    (true, true) if carries_past_others(task) => 0.1,
                    (true, true) => 0.2,
                    (true, false) => 0.5,
                    (false, _) => 1.0,
                },
            },
            rounds: rounds(recipe, task),
            exploration: Exploration {
                noise_std: 0.2,
                random_action_prob: 0.3,
                sticky_random_mean_steps: if tandem {
                    4.0_f32.min(task.episode_steps() as f32)
                } else {
                    1.0
                },
                joint_random_actions: !tandem,
            },
            world: world(recipe, task),
            replay: replay(recipe, task),
            ddpg: ddpg(recipe, task),
            evaluation: EvaluationConfig {
                // The paper evaluates once per epoch.
                every_env_steps: if tandem { 20_000 } else { paper_epoch_env_steps(task) },
                early_points: 4,
                episodes: 240,
                seed: 240_240,
                recorded_episodes: 2,
                test_episodes: 240,
                symmetrized: tandem && task.has_interchangeable_arms(),
            },
            stop: stop(recipe, task),
            checkpoint: CheckpointConfig { every_rounds: 50, keep: 2 },
            description: task.as_built_in().is_none().then(|| task.description().clone()),
        }
    }

    /// Gives the networks the size of copies of the recipe's teacher: its depth, and its width for each arm. A run with
    /// strategy [`INIT_TEACHER`](super::INIT_TEACHER) requires this size.
    #[must_use]
    pub fn sized_for_copies(mut self) -> Self {
        self.ddpg.n_hidden = N_HIDDEN * self.arms;
        self.ddpg.n_hidden_layers = n_hidden_layers(1);
        self
    }
}

fn rounds(recipe: Recipe, task: &TaskSpec) -> RoundsConfig {
    match recipe {
        Recipe::Tandem => RoundsConfig {
            slots: 8,
            rollouts: 2,
            lag: 1,
            updates_per_env_step: match (is_shared(task), task.n_arms()) {
                (true, 1) => 0.25,
                (true, _) => 1.0,
                (false, _) => 0.5,
            },
            polyak_every: PolyakEvery::Update,
            warmup_env_steps: 2000,
            final_greedy_share: if carries_past_others(task) { 0.5 } else { 0.0 },
            per_epoch: 50,
        },
        Recipe::Paper => RoundsConfig {
            slots: PAPER_SLOTS,
            rollouts: PAPER_ROLLOUTS,
            lag: 0,
            updates_per_env_step: 0.025,
            polyak_every: PolyakEvery::Round,
            warmup_env_steps: 0,
            final_greedy_share: 0.0,
            per_epoch: PAPER_EPOCH_ROUNDS,
        },
    }
}

/// Returns true if the task is a built-in one of the world `shared`.
fn is_shared(task: &TaskSpec) -> bool {
    task.as_built_in().is_some_and(|layout| layout.task.world() == World::Shared)
}

/// Returns true if arms carry objects through an area that they share, each its own. An arm whose way is blocked then
/// has to wait until the other has made room (decisions 041 and 042).
fn carries_past_others(task: &TaskSpec) -> bool {
    is_shared(task) && grasps(task) && task.n_arms() > 1
}

/// Returns true if the task is a built-in one in which arms grasp objects.
fn grasps(task: &TaskSpec) -> bool {
    task.as_built_in().is_some_and(|layout| layout.task.grasps())
}

/// Returns the environment steps of the paper's epoch: 80,000 in the built-in tasks, whose episodes have 50 steps.
fn paper_epoch_env_steps(task: &TaskSpec) -> u64 {
    let n_episodes = (PAPER_SLOTS * PAPER_ROLLOUTS) as u64;
    PAPER_EPOCH_ROUNDS * n_episodes * task.episode_steps() as u64
}

/// Limits of the paper's recipe: 50 epochs with one arm and 900 with more, since the paper's slowest curves reach 90 %
/// after 43 and 898.
fn stop(recipe: Recipe, task: &TaskSpec) -> StopConfig {
    let max_env_steps = match (recipe, task.as_built_in()) {
        (Recipe::Paper, _) if task.n_arms() == 1 => 50 * paper_epoch_env_steps(task),
        (Recipe::Paper, _) => 900 * paper_epoch_env_steps(task),
        (Recipe::Tandem, Some(built_in)) if is_shared(task) => {
            match (built_in.n_arms, built_in.task.grasps()) {
                (1, false) => 100_000,
                (1, true) | (_, false) => 200_000,
                (_, true) => 600_000,
            }
        }
        (Recipe::Tandem, Some(layout)) if !layout.task.grasps() && layout.n_arms == 1 => 200_000,
        (Recipe::Tandem, _) => 300_000,
    };
    StopConfig { until_success: 0.0, max_env_steps, max_minutes: 0.0 }
}

fn world(recipe: Recipe, task: &TaskSpec) -> WorldSettings {
    let tandem = recipe == Recipe::Tandem;
    let starts_grasped = tandem && grasps(task);
    let shares_object = task.shares_object();
    WorldSettings {
        grasped_start_prob: match starts_grasped {
            true if shares_object => 0.5,
            true => 0.2,
            false => 0.0,
        },
        grasped_start_env_steps: if starts_grasped && shares_object { 150_000 } else { 0 },
        randomization: if tandem && is_shared(task) { 1.0 } else { 0.0 },
        ..WorldSettings::default()
    }
}

fn replay(recipe: Recipe, task: &TaskSpec) -> ReplayConfig {
    let tandem = recipe == Recipe::Tandem;
    let avoids_contacts = tandem && task.n_arms() > 1 && task.reports_contacts();
    let tolerance = task.tolerance();
    let pair_shares_table = avoids_contacts && is_shared(task);
    ReplayConfig {
        capacity_transitions: 1_000_000,
        her_ratio: 0.8,
        displaced_hindsight: task.shares_object(),
        displaced_fraction: if tandem { 0.5 } else { 0.0 },
        coda_fraction: if tandem && task.has_recombinable_arms() { 1.0 } else { 0.0 },
        coda_contact_prob: 0.0,
        arm_swap_prob: if tandem && task.has_interchangeable_arms() { 0.5 } else { 0.0 },
        reflection_prob: if tandem && task.has_reflection() { 0.5 } else { 0.0 },
        reward: if tandem { RewardKind::PerArm } else { RewardKind::Joint },
        joint_goal_statistics: !tandem,
        // Four or three fifths of the tolerance; of 0.05 m exactly 0.04 or 0.03 m.
        goal_tolerance_m: match (tandem, pair_shares_table) {
            (true, true) => tolerance / 5.0 * 3.0,
            (true, false) => tolerance * 4.0 / 5.0,
            (false, _) => tolerance,
        },
        contact_cost: match (pair_shares_table, avoids_contacts) {
            // It grows, so that the arms first learn to reach their goals.
            (true, _) => 0.2,
            (false, true) => 1.0,
            // One arm of the shared world learns not to press.
            (false, false) => {
                if tandem && is_shared(task) {
                    1.0
                } else {
                    0.0
                }
            }
        },
        contact_cost_growth: if pair_shares_table { 6.0 } else { 1.0 },
        contact_foresight_steps: match (pair_shares_table, avoids_contacts) {
            // Near arms count as contacts, so more steps would leave little advice to clone.
            (true, _) => 1,
            (false, true) => 5.min(task.episode_steps()),
            (false, false) => 0,
        },
    }
}

fn ddpg(recipe: Recipe, task: &TaskSpec) -> DdpgConfig {
    let (tandem, n_arms) = (recipe == Recipe::Tandem, task.n_arms());
    let pair_shares_table = tandem && n_arms > 1 && is_shared(task);
    DdpgConfig {
        n_hidden: if pair_shares_table { N_HIDDEN / 2 } else { N_HIDDEN },
        n_hidden_layers: n_hidden_layers(n_arms),
        discount: if tandem { 0.95 } else { 0.98 },
        final_discount: if pair_shares_table { 0.98 } else { 0.0 },
        action_penalty: if tandem { 0.1 } else { 1.0 },
        bc_weight: if tandem && n_arms > 1 { 2.0 } else { 0.0 },
        cooldown_share: if tandem { 0.2 } else { 0.0 },
        ..DdpgConfig::default()
    }
}

fn n_hidden_layers(n_arms: usize) -> usize {
    if n_arms == 1 { 3 } else { 4 }
}
