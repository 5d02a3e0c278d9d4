//! Evaluations of the policy: their schedule, their rows of metrics, and the choice of the best policy.

use std::collections::{BTreeMap, VecDeque};

use tandem_core::{Episode, EpisodeOutcome, EvaluationSummary, Wilson};
use tandem_policy::Policy;
use tandem_policy::policy::RANDOMIZATION_KEY;
use tandem_rl::trainer::{RoundStats, Trainer};
use tandem_telemetry::events::EvaluationFinished;
use tandem_telemetry::{ContactMetrics, MetricsRow};

use super::progress_publisher::budget_left;
use crate::evaluation_store::{
    EvaluationHistory, EvaluationStore, PendingEvaluation, UnwrittenFile,
};
use crate::shared::LearnerConfig;

/// Rounds after which an evaluation must be complete. Until then its slots fill the workers' idle time.
const MAX_PENDING_ROUNDS: u64 = 4;

/// The run's evaluations, pending and complete.
pub(super) struct Evaluations<'a> {
    config: &'a LearnerConfig,
    store: EvaluationStore,
    /// Oldest first.
    pending: VecDeque<PendingEvaluation>,
}

impl<'a> Evaluations<'a> {
    /// Continues with the evaluations of a checkpoint. The run started at `started_s`, seconds since 1970.
    pub(super) fn new(
        config: &'a LearnerConfig,
        history: EvaluationHistory,
        pending: Vec<PendingEvaluation>,
        started_s: f64,
    ) -> Self {
        let symmetrized = config.run.evaluation.symmetrized;
        let store = EvaluationStore::new(&config.out, history, started_s, symmetrized);
        Self { config, store, pending: pending.into() }
    }

    /// Returns the complete evaluations.
    pub(super) const fn history(&self) -> &EvaluationHistory {
        self.store.history()
    }

    /// Returns the pending evaluations, oldest first.
    pub(super) const fn pending(&self) -> &VecDeque<PendingEvaluation> {
        &self.pending
    }

    /// Returns true if an evaluation follows `round` rounds and is neither complete nor pending.
    pub(super) fn is_due(&self, round: u64) -> bool {
        self.config.run.is_evaluated(round) && !self.covers(round)
    }

    /// Schedules an evaluation of the present parameters. The caller orders its episodes; a checkpoint in between
    /// contains it.
    pub(super) fn schedule(&mut self, trainer: &Trainer, stats: &RoundStats, wall_s: f64) {
        self.pending.push_back(PendingEvaluation {
            counters: trainer.counters(),
            stats: *stats,
            wall_s,
            policy: trainer.policy(BTreeMap::new()),
        });
    }

    /// Returns true if the newest pending evaluation is that of the parameters after `round`.
    pub(super) fn is_pending(&self, round: u64) -> bool {
        self.pending.back().is_some_and(|pending| pending.counters.round == round)
    }

    /// Returns true if the parameters after `round` are evaluated or being evaluated.
    pub(super) fn covers(&self, round: u64) -> bool {
        let rows = &self.history().rows;
        self.is_pending(round) || rows.last().is_some_and(|row| row.round == round)
    }

    /// Returns the parameter version of the oldest pending evaluation.
    pub(super) fn oldest_version(&self) -> Option<u64> {
        self.pending.front().map(|pending| pending.counters.round)
    }

    /// Returns the parameter version of the oldest evaluation if it must be complete after `round`. That depends on the
    /// round alone, because the result of an evaluation may end the run.
    pub(super) fn overdue_version(&self, round: u64) -> Option<u64> {
        self.oldest_version().filter(|version| round >= version + MAX_PENDING_ROUNDS)
    }

    /// Completes the oldest pending evaluation with its episodes: adds its row, and its policy if it is the best.
    pub(super) fn complete(&mut self, episodes: &[Episode]) {
        let Some(pending) = self.pending.pop_front() else { return };
        let mut row = self.training_row(&pending);
        let outcomes: Vec<EpisodeOutcome> = episodes.iter().map(EpisodeOutcome::of).collect();
        add_summary(&mut row, &EvaluationSummary::of(&outcomes));
        let is_cooldown = row.round > 0 && self.config.run.at_round(row.round - 1).is_cooldown;
        let best = self.history().best_row();
        row.best = best.is_none_or(|best| is_better(&row, best, is_cooldown));
        EvaluationFinished {
            round: row.round,
            env_steps: row.env_steps,
            success: row.success,
            success_low: row.success_low,
            success_high: row.success_high,
            collision_rate: row.collision_rate,
            mean_q: row.mean_q,
            best: row.best,
        }
        .emit();
        let policy = Policy { metadata: self.metadata(&row), ..pending.policy };
        self.store.add(row, policy);
    }

    /// Writes the files that are out of date; returns those that could not be written.
    pub(super) fn write(&mut self) -> Vec<UnwrittenFile> {
        self.store.write()
    }

    /// Returns true if a file is out of date.
    pub(super) const fn has_unwritten(&self) -> bool {
        self.store.is_due()
    }

    /// Returns the metadata of an evaluated policy's file.
    fn metadata(&self, row: &MetricsRow) -> BTreeMap<String, String> {
        let run = &self.config.run;
        let entries = [
            ("run", run.name.clone()),
            ("seed", run.seed.to_string()),
            ("recipe", run.recipe.to_string()),
            ("strategy", run.advice.strategy.clone()),
            ("advice_share", run.advice.share.to_string()),
            ("substeps", run.world.substeps.to_string()),
            ("program", self.config.version.clone()),
            ("env_steps", row.env_steps.to_string()),
            ("updates", row.updates.to_string()),
            ("advice_spent", row.advice_spent.to_string()),
            ("wall_s", format!("{:.1}", row.wall_s)),
            ("evaluation_seed", run.evaluation.seed.to_string()),
            ("evaluation_episodes", row.n_episodes.to_string()),
            ("evaluation_success", row.success.to_string()),
        ];
        let without_contact = row.contacts.success_without_contact;
        let without_contact =
            without_contact.map(|share| ("evaluation_success_without_contact", share.to_string()));
        let randomization = run.world.randomization;
        let randomization =
            (randomization > 0.0).then(|| (RANDOMIZATION_KEY, randomization.to_string()));
        entries
            .into_iter()
            .chain(without_contact)
            .chain(randomization)
            .map(|(key, value)| (key.to_owned(), value))
            .collect()
    }

    /// Returns a row with the state of training and without the evaluation's results.
    fn training_row(&self, pending: &PendingEvaluation) -> MetricsRow {
        let PendingEvaluation { counters, stats, wall_s, .. } = pending;
        MetricsRow {
            round: counters.round,
            env_steps: counters.env_steps,
            episodes: counters.episodes,
            updates: counters.updates,
            paper_epochs: counters.round as f64 / self.config.run.rounds.per_epoch as f64,
            wall_s: *wall_s,
            mean_q: stats.mean_q,
            critic_loss: stats.critic_loss,
            actor_loss: stats.actor_loss,
            advice_spent: counters.advice_spent,
            advice_queries: Some(counters.advice_queries),
            budget_left: budget_left(self.config, *counters),
            training_success: stats.training_success,
            training_moved: stats.training_moved,
            ..MetricsRow::default()
        }
    }
}

fn add_summary(row: &mut MetricsRow, summary: &EvaluationSummary) {
    row.n_episodes = summary.n_episodes as u64;
    row.success = summary.success;
    row.success_low = summary.interval.low;
    row.success_high = summary.interval.high;
    row.success_joint = summary.success_joint;
    row.success_per_arm.clone_from(&summary.success_per_arm);
    row.collision_rate = summary.collision_rate;
    row.collision_rate_before_success = summary.collision_rate_before_success;
    row.moved = summary.moved;
    row.mean_return = summary.mean_return;
    row.contacts = ContactMetrics::of(summary);
}

/// Returns true if an evaluation is better than an earlier one: more success without contact between the arms, or the
/// same with more success, or the same with fewer contacts. During the cooldown the policy improves by less than 240
/// goals can measure, so the later one wins unless the intervals are disjoint.
///
/// If one of them does not distinguish contacts between arms from contacts with the table, because the task does not
/// report contacts or an earlier version made the evaluation, success takes the place of success without contact.
fn is_better(row: &MetricsRow, than: &MetricsRow, is_cooldown: bool) -> bool {
    let success =
        |row: &MetricsRow| (row.success, Wilson { low: row.success_low, high: row.success_high });
    let without_contact = row.contacts.success().zip(than.contacts.success());
    let ((here, Wilson { high, .. }), (there, Wilson { low, .. })) =
        without_contact.unwrap_or_else(|| (success(row), success(than)));
    if is_cooldown && high >= low {
        return true;
    }
    let here = [here, row.success, -row.collision_rate];
    let there = [there, than.success, -than.collision_rate];
    here > there
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_later_of_two_similar_policies_is_best_only_in_the_cooldown() {
        let row = |success, [success_low, success_high]: [f64; 2], collision_rate| MetricsRow {
            success,
            success_low,
            success_high,
            collision_rate,
            ..MetricsRow::default()
        };
        let lucky = row(1.0, [0.984, 1.0], 0.02);
        let similar = row(0.983, [0.958, 0.994], 0.02);
        let worse = row(0.9, [0.856, 0.932], 0.0);
        assert!(is_better(&similar, &lucky, true));
        assert!(!is_better(&similar, &lucky, false));
        assert!(!is_better(&worse, &lucky, true));
        assert!(is_better(&row(1.0, [0.984, 1.0], 0.01), &lucky, false), "fewer contacts");
        assert!(!is_better(&lucky, &lucky, false));
    }

    #[test]
    fn success_without_contact_decides_if_both_evaluations_have_it() {
        let row = |success, collision_rate, without_contact: Option<f64>| MetricsRow {
            success,
            collision_rate,
            contacts: ContactMetrics {
                success_without_contact: without_contact,
                success_without_contact_low: without_contact.map(|share| share - 0.05),
                success_without_contact_high: without_contact.map(|share| share + 0.05),
                ..ContactMetrics::default()
            },
            ..MetricsRow::default()
        };
        let rough = row(0.99, 0.3, Some(0.7));
        let careful = row(0.95, 0.1, Some(0.9));
        assert!(is_better(&careful, &rough, false) && !is_better(&rough, &careful, false));
        assert!(!is_better(&rough, &careful, true), "the intervals are disjoint");
        let unknown = row(0.97, 0.2, None);
        assert!(is_better(&rough, &unknown, false) && !is_better(&careful, &unknown, false));
        assert!(is_better(&row(0.96, 0.1, Some(0.9)), &careful, false), "more success");
    }
}
