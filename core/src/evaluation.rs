//! Outcomes of evaluation episodes, success rates and their confidence intervals.

use crate::episode::{Contacts, Episode};

/// Seed of the test goals of reports. No run trains or selects its best policy on them.
pub const TEST_SEED: u64 = 777;

/// The outcome of one evaluation episode.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeOutcome {
    /// Every object was within the tolerance of its goal, and the task's other conditions held, after the last step or,
    /// if the task asks for more of them, after the last steps.
    pub success: bool,
    /// The norm over all arms' distances together was within the tolerance after the last step.
    pub success_joint: bool,
    /// The success of each arm, in arm order.
    pub success_per_arm: Vec<bool>,
    /// There was at least one arm–arm contact; `None` if the task does not report contacts.
    pub arm_contact: Option<bool>,
    /// There was at least one arm–table contact; `None` if the task does not report contacts.
    pub table_contact: Option<bool>,
    /// The link avoidance limited the motion of an arm in at least one step; `None` if this is not known.
    pub avoidance: Option<bool>,
    /// There was at least one arm–arm or arm–table contact; `false` if the task does not report contacts.
    pub collided: bool,
    /// There was at least one such contact before all objects were at their goals to stay.
    pub collided_before_success: bool,
    /// The goal was achieved and lost again; see [`Episode::lost_goal`].
    pub lost_goal: bool,
    /// At least one object was displaced; see [`Episode::moved`].
    pub moved: bool,
    /// Sum of the joint rewards, undiscounted: from minus the number of steps to 0.
    pub episode_return: f32,
}

impl EpisodeOutcome {
    /// Derives the outcome of `episode` from its transitions.
    #[must_use]
    pub fn of(episode: &Episode) -> Self {
        let collided = episode.contacts.iter().any(|contacts| contacts.any());
        let has = |contact: Contacts| {
            let mut contacts = episode.contacts.iter();
            episode.task.reports_contacts().then(|| contacts.any(|each| each.contains(contact)))
        };
        let settled_after = steps_until_settled(episode);
        let first_contact = episode.contacts.iter().position(|contacts: &Contacts| contacts.any());
        Self {
            success: episode.succeeded(),
            success_joint: episode.succeeded_jointly(),
            success_per_arm: episode.task.arms().map(|arm| episode.arm_succeeded(arm)).collect(),
            arm_contact: has(Contacts::ARM_ARM),
            table_contact: has(Contacts::ARM_TABLE),
            avoidance: episode.avoidance_steps.map(|n_steps| n_steps > 0),
            collided,
            collided_before_success: first_contact.is_some_and(|step_idx| step_idx < settled_after),
            lost_goal: episode.lost_goal(),
            moved: episode.moved(),
            episode_return: (0..episode.n_steps())
                .map(|step_idx| episode.joint_reward(step_idx))
                .sum(),
        }
    }

    /// Returns true if every object ended at its goal and the arms never touched each other; `None` if the task does
    /// not report contacts.
    #[must_use]
    pub fn success_without_contact(&self) -> Option<bool> {
        self.arm_contact.map(|arm_contact| self.success && !arm_contact)
    }
}

/// Returns the number of steps after which every object stays within the tolerance of its goal, the episode's steps if that
/// never happens.
fn steps_until_settled(episode: &Episode) -> usize {
    let at_goal = |step_idx| episode.task.is_success(episode.observation(step_idx), &episode.goal);
    (0..episode.n_steps())
        .rev()
        .find(|step_idx| !at_goal(step_idx + 1))
        .map_or(0, |last_bad| last_bad + 1)
}

/// The score interval of a proportion at a confidence of 95 % (Wilson 1927).
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
        // Centre and spread are equal without successes, and so are their distances from 1 without failures: rounding
        // would leave a difference.
        Self {
            low: if n_hits == 0 { 0.0 } else { ((centre - spread) / scale).max(0.0) },
            high: if n_hits == n_trials { 1.0 } else { ((centre + spread) / scale).min(1.0) },
        }
    }
}

/// The result of an evaluation. Rates are fractions of its episodes, in [0, 1].
#[derive(Debug, Clone, PartialEq)]
pub struct EvaluationSummary {
    /// Number of episodes.
    pub n_episodes: usize,
    /// Fraction with every object at its goal and no contact between the arms; `None` if the task does not report
    /// contacts.
    pub success_without_contact: Option<f64>,
    /// Fraction with every object at its goal.
    pub success: f64,
    /// The 95 % interval of `success`.
    pub interval: Wilson,
    /// Fraction with the joint norm within the tolerance.
    pub success_joint: f64,
    /// Success rate of each arm, in arm order.
    pub success_per_arm: Vec<f64>,
    /// Fraction with at least one arm–arm contact; `None` if the task does not report contacts.
    pub arm_contact_rate: Option<f64>,
    /// Fraction with at least one arm–table contact; `None` if the task does not report contacts.
    pub table_contact_rate: Option<f64>,
    /// Fraction in which the link avoidance limited the motion of an arm; `None` if this is not known.
    pub avoidance_rate: Option<f64>,
    /// Fraction with at least one arm–arm or arm–table contact; 0 if the task does not report contacts.
    pub collision_rate: f64,
    /// Fraction with such a contact before all objects were at their goals to stay.
    pub collision_rate_before_success: f64,
    /// Fraction in which the goal was achieved and lost again; see [`Episode::lost_goal`].
    pub lost_goal_rate: f64,
    /// Fraction in which at least one object was displaced.
    pub moved: f64,
    /// Mean undiscounted sum of joint rewards.
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

    /// Summarises `outcomes`, which belong to one task. Without outcomes all rates are 0.
    #[must_use]
    pub fn of(outcomes: &[EpisodeOutcome]) -> Self {
        let n = outcomes.len().max(1) as f64;
        let count = |holds: &dyn Fn(&EpisodeOutcome) -> bool| {
            outcomes.iter().filter(|outcome| holds(outcome)).count()
        };
        let share = |holds: &dyn Fn(&EpisodeOutcome) -> bool| count(holds) as f64 / n;
        let known_share = |of: &dyn Fn(&EpisodeOutcome) -> Option<bool>| {
            let known: Option<Vec<bool>> = outcomes.iter().map(of).collect();
            known.map(|holds| holds.iter().filter(|holds| **holds).count() as f64 / n)
        };
        let n_arms = outcomes.first().map_or(0, |outcome| outcome.success_per_arm.len());
        Self {
            n_episodes: outcomes.len(),
            success_without_contact: known_share(&EpisodeOutcome::success_without_contact),
            success: share(&|outcome| outcome.success),
            interval: Wilson::of(count(&|outcome| outcome.success), outcomes.len()),
            success_joint: share(&|outcome| outcome.success_joint),
            success_per_arm: (0..n_arms)
                .map(|arm| share(&|outcome| outcome.success_per_arm[arm]))
                .collect(),
            arm_contact_rate: known_share(&|outcome| outcome.arm_contact),
            table_contact_rate: known_share(&|outcome| outcome.table_contact),
            avoidance_rate: known_share(&|outcome| outcome.avoidance),
            collision_rate: share(&|outcome| outcome.collided),
            collision_rate_before_success: share(&|outcome| outcome.collided_before_success),
            lost_goal_rate: share(&|outcome| outcome.lost_goal),
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
    use crate::layout::{Layout, Task};

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

    #[test]
    fn without_successes_or_failures_a_bound_of_the_wilson_interval_is_exact() {
        for n_trials in 1..=1000 {
            let (none, all) = (Wilson::of(0, n_trials), Wilson::of(n_trials, n_trials));
            assert_eq!((none.low, all.high), (0.0, 1.0), "{n_trials}");
            assert!(none.high < 1.0 && all.low > 0.0, "{n_trials}");
        }
    }

    fn outcome(
        success: bool,
        contacts: &[Contacts],
        avoidance_steps: Option<u32>,
    ) -> EpisodeOutcome {
        let mut episode = Episode::zeros(Layout::new(Task::Push, 2), 0);
        episode.goal.fill(if success { 0.0 } else { 1.0 });
        episode.contacts[..contacts.len()].copy_from_slice(contacts);
        episode.avoidance_steps = avoidance_steps;
        EpisodeOutcome::of(&episode)
    }

    #[test]
    fn only_a_contact_between_the_arms_spoils_success_without_contact() {
        let check = |success, contacts: &[Contacts], expected| {
            let outcome = outcome(success, contacts, None);
            assert_eq!(outcome.success_without_contact(), Some(expected), "{contacts:?}");
        };
        check(true, &[], true);
        check(true, &[Contacts::ARM_TABLE], true);
        check(true, &[Contacts::NONE, Contacts::ARM_ARM], false);
        check(true, &[Contacts::ARM_TABLE | Contacts::ARM_ARM], false);
        check(false, &[], false);
    }

    #[test]
    fn a_goal_is_lost_if_it_was_achieved_for_as_many_steps_as_count() {
        let layout = Layout::new(Task::CarryBar, 2);
        let lost_goal = |held_after: &[usize]| {
            let mut episode = Episode::zeros(layout, 0);
            for step_idx in held_after {
                let after = step_idx * layout.n_observation();
                for arm in layout.arms() {
                    let openings = after + layout.observation_of(arm).start + 9;
                    episode.observations[openings..openings + 3].fill(0.028);
                }
            }
            EpisodeOutcome::of(&episode).lost_goal
        };
        assert!(!lost_goal(&[]), "never achieved");
        assert!(!lost_goal(&[10, 11, 12, 13]), "four steps");
        assert!(!lost_goal(&[10, 11, 12, 13, 15, 16]), "never five consecutive steps");
        assert!(lost_goal(&[10, 11, 12, 13, 14]));
        assert!(lost_goal(&[10, 11, 12, 13, 14, 47, 48, 49, 50]), "not after all of the last five");
        assert!(!lost_goal(&[10, 11, 12, 13, 14, 46, 47, 48, 49, 50]), "achieved again");
    }

    #[test]
    fn rates_of_contacts_are_separate_and_unknown_ones_are_left_out() {
        let outcomes = [
            outcome(true, &[], Some(0)),
            outcome(true, &[Contacts::ARM_ARM], Some(3)),
            outcome(false, &[Contacts::ARM_TABLE], Some(0)),
            outcome(true, &[Contacts::ARM_TABLE], Some(1)),
        ];
        let summary = EvaluationSummary::of(&outcomes);
        assert_eq!((summary.success, summary.success_without_contact), (0.75, Some(0.5)));
        assert_eq!((summary.arm_contact_rate, summary.table_contact_rate), (Some(0.25), Some(0.5)));
        assert_eq!((summary.collision_rate, summary.avoidance_rate), (0.75, Some(0.5)));
        let mixed = [outcomes[0].clone(), outcome(true, &[], None)];
        assert_eq!(EvaluationSummary::of(&mixed).avoidance_rate, None);
        let unknown = EpisodeOutcome { arm_contact: None, ..outcomes[0].clone() };
        let summary = EvaluationSummary::of(&[unknown]);
        assert_eq!((summary.success, summary.success_without_contact), (1.0, None));
    }
}
