//! Settings that change during a run, as functions of the round.
//!
//! Every schedule is in fractions of the run's environment steps; a run without a limit in environment steps keeps the
//! initial values.

use super::RunConfig;
use crate::ddpg::UpdateSettings;

/// The values that scheduled settings have in a round.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RoundSettings {
    /// Discount, weight of behaviour cloning, filter of advice and learning rates of the round's updates.
    pub update: UpdateSettings,
    /// Whether both networks learn at `ddpg.cooldown_learning_rate`: in the last `ddpg.cooldown_share` of the run.
    pub is_cooldown: bool,
    /// Cost of a contact, in units of reward, 0 or more. It grows between a tenth and half of the run.
    pub contact_cost: f32,
    /// Fraction of the episodes without advice that are played without exploration, in [0, 1]. It grows between one
    /// quarter and three quarters of the run.
    pub greedy_share: f64,
}

impl RunConfig {
    /// Returns the scheduled settings in round `round`, from 0.
    #[must_use]
    pub fn at_round(&self, round: u64) -> RoundSettings {
        let (ddpg, replay) = (&self.ddpg, &self.replay);
        let start = RoundStart {
            env_steps: (round * self.env_steps_per_round()) as f64,
            max_env_steps: self.stop.max_env_steps as f64,
        };
        let middle = start.fraction_of_part(0.25, 0.75);
        let is_cooldown = start.is_past(1.0 - f64::from(ddpg.cooldown_share));
        let learning_rate = |usual| if is_cooldown { ddpg.cooldown_learning_rate } else { usual };
        let filter_start = ddpg.bc_filter_start;
        let cost_growth = start.fraction_of_part(0.1, 0.5) * (replay.contact_cost_growth - 1.0);
        RoundSettings {
            update: UpdateSettings {
                discount: discount(ddpg.discount, ddpg.final_discount, middle),
                bc_weight: ddpg.bc_weight * (1.0 - middle * (1.0 - ddpg.bc_final_fraction)),
                filters_advice: filter_start < 1.0 && start.is_past(f64::from(filter_start)),
                actor_learning_rate: learning_rate(ddpg.actor_learning_rate),
                critic_learning_rate: learning_rate(ddpg.critic_learning_rate),
            },
            is_cooldown,
            contact_cost: replay.contact_cost * (1.0 + cost_growth),
            greedy_share: self.rounds.final_greedy_share * f64::from(middle),
        }
    }
}

/// The start of a round within its run.
#[derive(Debug, Clone, Copy)]
struct RoundStart {
    /// Environment steps before the round.
    env_steps: f64,
    /// The run's limit in environment steps; 0 means no limit.
    max_env_steps: f64,
}

impl RoundStart {
    /// Returns true if `fraction` of the run lies before the round.
    fn is_past(self, fraction: f64) -> bool {
        self.max_env_steps > 0.0 && self.env_steps >= fraction * self.max_env_steps
    }

    /// Returns the fraction, in [0, 1], of the part of the run from `start` to `end` that lies before the round.
    #[expect(clippy::cast_possible_truncation, reason = "a number in [0, 1]")]
    fn fraction_of_part(self, start: f64, end: f64) -> f32 {
        if self.max_env_steps == 0.0 {
            return 0.0;
        }
        let fraction = self.env_steps / self.max_env_steps;
        ((fraction - start) / (end - start)).clamp(0.0, 1.0) as f32
    }
}

/// Returns the discount whose horizon `1 / (1 - discount)` is at `fraction` between the horizons of two discounts. A
/// `last` discount of 0 means that the first one stays.
fn discount(first: f32, last: f32, fraction: f32) -> f32 {
    if last == 0.0 || fraction == 0.0 {
        return first;
    }
    let horizon = |discount: f32| 1.0 / (1.0 - discount);
    let (first, last) = (horizon(first), horizon(last));
    1.0 - 1.0 / (first + fraction * (last - first))
}
