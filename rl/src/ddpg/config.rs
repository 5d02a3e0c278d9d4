//! Section `[ddpg]` of the run file.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tandem_core::settings::OutOfRange;

/// Most transitions of an update.
const MAX_TRANSITIONS: usize = 65_536;

/// Section `[ddpg]` of the run file: the update. The defaults are those of recipe `tandem` for a student of two
/// arms in the classic world; the paper's values are in parentheses.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct DdpgConfig {
    /// Discount per control step, in [0, 1) (paper, section 4.1: 0.98).
    pub discount: f32,
    /// Discount from three quarters of the run's environment steps on, in [0, 1). From one quarter, the horizon 1 / (1
    /// - discount) grows linearly until then. 0 keeps `discount`, as does a run without a limit in environment steps.
    #[serde(default)]
    pub final_discount: f32,
    /// Weight of the mean squared action in the actor's loss, 0 or more (HER reference implementation: `action_l2` =
    /// 1).
    pub action_penalty: f32,
    /// Weight of behaviour cloning in the actor's loss: of the squared error to the teacher's action where that was
    /// executed, 0 or more (paper: 0).
    pub bc_weight: f32,
    /// Fraction of `bc_weight` that remains at the end of the run, in [0, 1]. The weight falls linearly from one
    /// quarter to three quarters of `stop.max_env_steps`; a run without that limit keeps it.
    #[serde(default = "all_of_it")]
    pub bc_final_fraction: f32,
    /// Fraction of `stop.max_env_steps` after which advice is cloned only where the critic values it above the actor's
    /// own action, in [0, 1]: the Q-filter of Nair et al. 2018. With a value per arm, the advice to an arm
    /// is compared by the arm's own value. 1 disables the filter, as does a run without that limit.
    #[serde(default = "never")]
    pub bc_filter_start: f32,
    /// Fraction of the old target network that a Polyak step keeps, in [0, 1] (HER reference implementation: 0.95). It
    /// is Spinning Up's `polyak`, and 1 - `tau` of Stable-Baselines3.
    pub polyak_keep: f32,
    /// Adam's step size for the actor, 1e-8 to 1 (HER reference implementation: 0.001).
    pub actor_learning_rate: f32,
    /// Adam's step size for the critic, 1e-8 to 1 (HER reference implementation: 0.001).
    pub critic_learning_rate: f32,
    /// Fraction of `stop.max_env_steps`, at its end, in which both networks learn at `cooldown_learning_rate`, in
    /// [0, 1] (paper: 0).
    pub cooldown_share: f32,
    /// Adam's step size for both networks during the cooldown, 1e-8 to 1.
    pub cooldown_learning_rate: f32,
    /// Transitions per batch, 1 to 65,536 (paper, section 4.2: 256).
    pub batch_size: usize,
    /// Batches per update, whose gradients are summed, 1 to 64. In the HER reference implementation each worker draws
    /// one (`MpiAdam` with `scale_grad_by_procs=False`): 16 with the paper's workers. An update has at most 65,536
    /// transitions.
    #[serde(default = "one_batch")]
    pub batches_per_update: usize,
    /// Units of each hidden layer of both networks, 1 to 4,096 (paper, section 4.1: 256). What workers act with, the
    /// actor and for some strategies the critics, must fit a message of 64 MiB.
    pub n_hidden: usize,
    /// Hidden layers of both networks, 1 to 16 (paper, section 4.1: teacher 3, student 4).
    pub n_hidden_layers: usize,
}

impl Default for DdpgConfig {
    fn default() -> Self {
        Self {
            discount: 0.95,
            final_discount: 0.0,
            action_penalty: 0.1,
            bc_weight: 2.0,
            bc_final_fraction: all_of_it(),
            bc_filter_start: never(),
            polyak_keep: 0.95,
            actor_learning_rate: 1e-3,
            critic_learning_rate: 1e-3,
            cooldown_share: 0.2,
            cooldown_learning_rate: 2e-4,
            batch_size: 256,
            batches_per_update: one_batch(),
            n_hidden: 256,
            n_hidden_layers: 4,
        }
    }
}

/// The settings of an update that can change during a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UpdateSettings {
    /// Discount per control step, in [0, 1).
    pub discount: f32,
    /// Weight of behaviour cloning in the actor's loss, 0 or more.
    pub bc_weight: f32,
    /// Whether advice is cloned only where the critic values it above the actor's own action.
    pub filters_advice: bool,
    /// Adam's step size for the actor.
    pub actor_learning_rate: f32,
    /// Adam's step size for the critic.
    pub critic_learning_rate: f32,
}

const fn one_batch() -> usize {
    1
}

const fn all_of_it() -> f32 {
    1.0
}

/// The start of a filter that never starts.
const fn never() -> f32 {
    1.0
}

impl DdpgConfig {
    /// Returns the number of transitions of an update.
    #[must_use]
    pub const fn transitions_per_update(&self) -> usize {
        self.batch_size * self.batches_per_update
    }

    /// Returns the settings of an update without schedules: the initial discount, the whole weight of behaviour
    /// cloning, no filter of advice and the usual learning rates.
    #[must_use]
    pub const fn without_schedules(&self) -> UpdateSettings {
        UpdateSettings {
            discount: self.discount,
            bc_weight: self.bc_weight,
            filters_advice: false,
            actor_learning_rate: self.actor_learning_rate,
            critic_learning_rate: self.critic_learning_rate,
        }
    }

    /// Checks every range; NaN is in none.
    ///
    /// # Errors
    /// Names the first setting that is out of its range.
    pub fn check(&self) -> Result<(), OutOfRange> {
        OutOfRange::check_below_one("ddpg.discount", self.discount)?;
        OutOfRange::check_below_one("ddpg.final_discount", self.final_discount)?;
        for (key, weight) in
            [("ddpg.action_penalty", self.action_penalty), ("ddpg.bc_weight", self.bc_weight)]
        {
            let is_weight = weight >= 0.0 && weight.is_finite();
            OutOfRange::unless(is_weight, key, weight, "0 or more")?;
        }
        for (key, fraction) in [
            ("ddpg.polyak_keep", self.polyak_keep),
            ("ddpg.cooldown_share", self.cooldown_share),
            ("ddpg.bc_final_fraction", self.bc_final_fraction),
            ("ddpg.bc_filter_start", self.bc_filter_start),
        ] {
            OutOfRange::check_fraction(key, fraction)?;
        }
        for (key, rate) in [
            ("ddpg.cooldown_learning_rate", self.cooldown_learning_rate),
            ("ddpg.actor_learning_rate", self.actor_learning_rate),
            ("ddpg.critic_learning_rate", self.critic_learning_rate),
        ] {
            OutOfRange::unless((1e-8..=1.0).contains(&rate), key, rate, "1e-8 to 1")?;
        }
        for (key, size, most) in [
            ("ddpg.batch_size", self.batch_size, MAX_TRANSITIONS),
            ("ddpg.batches_per_update", self.batches_per_update, 64),
            ("ddpg.n_hidden", self.n_hidden, 4096),
            ("ddpg.n_hidden_layers", self.n_hidden_layers, 16),
        ] {
            OutOfRange::check_range(key, size, 1..=most)?;
        }
        let most = MAX_TRANSITIONS / self.batch_size;
        let (key, n_batches) = ("ddpg.batches_per_update", self.batches_per_update);
        let expected = format_args!("at most {most} batches of {}", self.batch_size).to_string();
        OutOfRange::unless(n_batches <= most, key, n_batches, expected)
    }
}
