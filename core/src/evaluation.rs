//! Outcomes of evaluation episodes, success rates and their confidence intervals.

use crate::episode::{Contacts, Episode};

/// The outcome of one evaluation episode.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeOutcome {
    /// Every object was within the tolerance of its goal after the last step.
    pub success: bool,
    /// The norm over all arms' distances together was within the tolerance after the last step.
    pub success_joint: bool,
    /// The success of each arm, in arm order.
    pub success_per_arm: Vec<bool>,
    /// There was at least one arm–arm or arm–table contact.
    pub collided: bool,
    /// There was at least one such contact before all objects were at their goals to stay.
    pub collided_before_success: bool,
    /// At least one object was displaced; see [`Episode::moved`].
    pub moved: bool,
    /// Sum of the joint rewards, undiscounted.
    pub episode_return: f32,
}

impl EpisodeOutcome {
    /// Derives the outcome of `episode` from its transitions.
    #[must_use]
    pub fn of(episode: &Episode) -> Self {
        let collided = episode.contacts.iter().any(|contacts| contacts.any());
        let settled_after = steps_until_settled(episode);
        let first_contact = episode.contacts.iter().position(|contacts: &Contacts| contacts.any());
        Self {
            success: episode.succeeded(),
            success_joint: episode.succeeded_jointly(),
            success_per_arm: episode.layout.arms().map(|arm| episode.arm_succeeded(arm)).collect(),
            collided,
            collided_before_success: first_contact.is_some_and(|step_idx| step_idx < settled_after),
            moved: episode.moved(),
            episode_return: (0..episode.n_steps())
                .map(|step_idx| episode.joint_reward(step_idx))
                .sum(),
        }
    }
}

/// Returns the number of steps after which every object stays within the tolerance of its goal, the episode's steps if that
/// never happens.
fn steps_until_settled(episode: &Episode) -> usize {
    let at_goal =
        |step_idx| episode.layout.is_success(episode.observation(step_idx), &episode.goal);
    (0..episode.n_steps())
        .rev()
        .find(|step_idx| !at_goal(step_idx + 1))
        .map_or(0, |last_bad| last_bad + 1)
}

/// The Wilson score interval of a proportion, at a confidence of 95 %.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wilson {
    /// Lower end, in [0, 1].
    pub low: f64,
    /// Upper end, in [0, 1].
    pub high: f64,
}

impl Wilson {
    /// Computes the interval for `n_hits` successes in `n_trials` trials; without trials it is [0, 1].
    #[must_use]
    pub fn of(n_hits: usize, n_trials: usize) -> Self {
        const Z: f64 = 1.959_963_984_540_054;
        if n_trials == 0 {
            return Self { low: 0.0, high: 1.0 };
        }
        let n = n_trials as f64;
        let share = n_hits as f64 / n;
        let centre = share + Z * Z / (2.0 * n);
        let spread = Z * (share * (1.0 - share) / n + Z * Z / (4.0 * n * n)).sqrt();
        let scale = 1.0 + Z * Z / n;
        Self {
            low: ((centre - spread) / scale).max(0.0),
            high: ((centre + spread) / scale).min(1.0),
        }
    }
}

/// The result of an evaluation. Rates are fractions of its episodes, in [0, 1].
#[derive(Debug, Clone, PartialEq)]
pub struct EvaluationSummary {
    /// Number of episodes.
    pub n_episodes: usize,
    /// Fraction with every object at its goal.
    pub success: f64,
    /// The 95 % interval of `success`.
    pub interval: Wilson,
    /// Fraction with the joint norm within the tolerance.
    pub success_joint: f64,
    /// Success rate of each arm, in arm order.
    pub success_per_arm: Vec<f64>,
    /// Fraction with at least one arm–arm or arm–table contact.
    pub collision_rate: f64,
    /// Fraction with such a contact before all objects were at their goals to stay.
    pub collision_rate_before_success: f64,
    /// Fraction in which at least one object was displaced.
    pub moved: f64,
    /// Mean sum of joint rewards.
    pub mean_return: f64,
}

impl EvaluationSummary {
    /// Returns the 95 % interval of `share`, which is one of this evaluation's rates.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a fraction of few episodes"
    )]
    pub fn interval_of(&self, share: f64) -> Wilson {
        Wilson::of((share * self.n_episodes as f64).round() as usize, self.n_episodes)
    }

    /// Summarises `outcomes`, which belong to one layout. Without outcomes all rates are 0.
    #[must_use]
    pub fn of(outcomes: &[EpisodeOutcome]) -> Self {
        let n = outcomes.len().max(1) as f64;
        let count = |holds: &dyn Fn(&EpisodeOutcome) -> bool| {
            outcomes.iter().filter(|outcome| holds(outcome)).count()
        };
        let share = |holds: &dyn Fn(&EpisodeOutcome) -> bool| count(holds) as f64 / n;
        let n_arms = outcomes.first().map_or(0, |outcome| outcome.success_per_arm.len());
        Self {
            n_episodes: outcomes.len(),
            success: share(&|outcome| outcome.success),
            interval: Wilson::of(count(&|outcome| outcome.success), outcomes.len()),
            success_joint: share(&|outcome| outcome.success_joint),
            success_per_arm: (0..n_arms)
                .map(|arm| share(&|outcome| outcome.success_per_arm[arm]))
                .collect(),
            collision_rate: share(&|outcome| outcome.collided),
            collision_rate_before_success: share(&|outcome| outcome.collided_before_success),
            moved: share(&|outcome| outcome.moved),
            mean_return: outcomes
                .iter()
                .map(|outcome| f64::from(outcome.episode_return))
                .sum::<f64>()
                / n,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_wilson_interval_has_the_textbook_values() {
        let check = |hits, trials, low: f64, high: f64| {
            let interval = Wilson::of(hits, trials);
            assert!(
                (interval.low - low).abs() < 5e-4 && (interval.high - high).abs() < 5e-4,
                "{interval:?}"
            );
        };
        check(0, 10, 0.0, 0.2775);
        check(5, 10, 0.2366, 0.7634);
        check(240, 240, 0.9842, 1.0);
        check(0, 0, 0.0, 1.0);
    }
}
