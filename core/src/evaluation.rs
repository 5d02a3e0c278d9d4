//! What an evaluation counts, and how sure one can be of it.

use crate::episode::{Contacts, Episode};
use crate::layout::EPISODE_STEPS;

/// What is kept of one evaluation episode.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeOutcome {
    /// Every object within the tolerance of its goal after the last step.
    pub success: bool,
    /// The joint norm within the tolerance after the last step.
    pub success_joint: bool,
    /// Each arm's own success.
    pub success_per_arm: Vec<bool>,
    /// At least one arm–arm or arm–table contact.
    pub collided: bool,
    /// At least one such contact before every object had arrived for good.
    pub collided_before_success: bool,
    /// At least one object displaced.
    pub moved: bool,
    /// Sum of the joint rewards.
    pub episode_return: f32,
}

impl EpisodeOutcome {
    /// Reads an episode's outcome from its transitions.
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
            episode_return: (0..EPISODE_STEPS)
                .map(|step_idx| episode.joint_reward_after(step_idx))
                .sum(),
        }
    }
}

/// Steps after which every object stays within the tolerance of its goal; `EPISODE_STEPS` when that never happens.
fn steps_until_settled(episode: &Episode) -> usize {
    let at_goal = |step_idx: usize| {
        episode.layout.arms().all(|arm| {
            let goal = &episode.goal[episode.layout.goal_of(arm)];
            crate::reward::sparse_reward(episode.achieved(step_idx, arm), goal) > -0.5
        })
    };
    (0..EPISODE_STEPS)
        .rev()
        .find(|step_idx| !at_goal(step_idx + 1))
        .map_or(0, |last_bad| last_bad + 1)
}

/// Wilson's 95 % interval of a share.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wilson {
    /// Lower end, in [0, 1].
    pub low: f64,
    /// Upper end, in [0, 1].
    pub high: f64,
}

impl Wilson {
    /// The interval for `n_hits` of `n_trials`; without trials it is all of [0, 1].
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

/// The figures of an evaluation: shares of its episodes.
#[derive(Debug, Clone, PartialEq)]
pub struct EvaluationSummary {
    /// How many episodes were played.
    pub n_episodes: usize,
    /// Share with every object at its goal.
    pub success: f64,
    /// Its 95 % interval.
    pub interval: Wilson,
    /// Share with the joint norm within the tolerance.
    pub success_joint: f64,
    /// Each arm's share.
    pub success_per_arm: Vec<f64>,
    /// Share with at least one arm–arm or arm–table contact.
    pub collision_rate: f64,
    /// Share with such a contact before every object had arrived for good.
    pub collision_rate_before_success: f64,
    /// Share in which an object was displaced.
    pub moved: f64,
    /// Mean sum of joint rewards.
    pub mean_return: f64,
}

impl EvaluationSummary {
    /// The 95 % interval of one of this evaluation's shares.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a share of few episodes"
    )]
    pub fn interval_of(&self, share: f64) -> Wilson {
        Wilson::of((share * self.n_episodes as f64).round() as usize, self.n_episodes)
    }

    /// Sums up `outcomes` of one layout; all shares are 0 when there are none.
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
    fn wilsons_interval_has_the_textbook_values() {
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
