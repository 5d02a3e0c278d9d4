//! `[ddpg]` in the run file.

use serde::{Deserialize, Serialize};

/// The update. The defaults are recipe `tandem`'s for a student; the paper's values stand beside them.
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct DdpgConfig {
    /// Discount per control step, in [0, 1) (paper, section 4.1: 0.98).
    pub discount: f32,
    /// Weight of the mean squared action in the actor's loss, 0 or more (HER reference implementation: 1).
    pub action_penalty: f32,
    /// Weight of the squared error to the teacher's action where it was executed, 0 or more (paper: 0).
    pub cloning_weight: f32,
    /// Share of the old target network kept by each Polyak step, in [0, 1] (HER reference implementation: 0.95).
    pub polyak_keep: f32,
    /// Adam's step size for the actor, 1e-8 to 1 (HER reference implementation: 0.001).
    pub actor_learning_rate: f32,
    /// Adam's step size for the critic, 1e-8 to 1 (HER reference implementation: 0.001).
    pub critic_learning_rate: f32,
    /// The last share of a run's `stop.max_env_steps`, in [0, 1], over which both networks learn at
    /// `cooldown_learning_rate` (paper: 0).
    pub cooldown_share: f32,
    /// Adam's step size for both networks over that share, 1e-8 to 1.
    pub cooldown_learning_rate: f32,
    /// Transitions per update (paper, section 4.1: 256).
    pub batch_size: usize,
    /// Units of each hidden layer of both networks (paper, section 4.1: 256).
    pub n_hidden: usize,
    /// Hidden layers of both networks (paper, section 4.1: teacher 3, student 4).
    pub n_hidden_layers: usize,
}

impl Default for DdpgConfig {
    fn default() -> Self {
        Self {
            discount: 0.95,
            action_penalty: 0.1,
            cloning_weight: 2.0,
            polyak_keep: 0.95,
            actor_learning_rate: 1e-3,
            critic_learning_rate: 1e-3,
            cooldown_share: 0.2,
            cooldown_learning_rate: 2e-4,
            batch_size: 256,
            n_hidden: 256,
            n_hidden_layers: 4,
        }
    }
}

impl DdpgConfig {
    /// Checks what the types cannot; NaN fails every range.
    ///
    /// # Errors
    /// Names the first setting that cannot be used, its value and what it may be.
    pub fn check(&self) -> Result<(), (&'static str, String, &'static str)> {
        let weight = |weight: f32| weight >= 0.0 && weight.is_finite();
        let share = |share: f32| (0.0..=1.0).contains(&share);
        let rate = |rate: f32| (1e-8..=1.0).contains(&rate);
        let numbers = [
            (
                "ddpg.discount",
                self.discount,
                (0.0..1.0).contains(&self.discount),
                "a number in [0, 1)",
            ),
            ("ddpg.action_penalty", self.action_penalty, weight(self.action_penalty), "0 or more"),
            ("ddpg.cloning_weight", self.cloning_weight, weight(self.cloning_weight), "0 or more"),
            ("ddpg.polyak_keep", self.polyak_keep, share(self.polyak_keep), "a number in [0, 1]"),
            (
                "ddpg.cooldown_share",
                self.cooldown_share,
                share(self.cooldown_share),
                "a number in [0, 1]",
            ),
            (
                "ddpg.cooldown_learning_rate",
                self.cooldown_learning_rate,
                rate(self.cooldown_learning_rate),
                "1e-8 to 1",
            ),
            (
                "ddpg.actor_learning_rate",
                self.actor_learning_rate,
                rate(self.actor_learning_rate),
                "1e-8 to 1",
            ),
            (
                "ddpg.critic_learning_rate",
                self.critic_learning_rate,
                rate(self.critic_learning_rate),
                "1e-8 to 1",
            ),
        ];
        for (key, value, fine, expected) in numbers {
            if !fine {
                return Err((key, value.to_string(), expected));
            }
        }
        let sizes = [
            ("ddpg.batch_size", self.batch_size, 65_536, "1 to 65,536"),
            ("ddpg.n_hidden", self.n_hidden, 4096, "1 to 4,096"),
            ("ddpg.n_hidden_layers", self.n_hidden_layers, 16, "1 to 16"),
        ];
        for (key, value, most, expected) in sizes {
            if !(1..=most).contains(&value) {
                return Err((key, value.to_string(), expected));
            }
        }
        Ok(())
    }
}
