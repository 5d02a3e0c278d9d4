//! Judging the policy: evaluations, their row in the metrics, and the policies that are kept.

use std::collections::BTreeMap;

use tandem_core::{EpisodeKind, EpisodeOutcome, EvaluationSummary};
use tandem_policy::Policy;
use tandem_telemetry::MetricsRow;
use tandem_telemetry::events::EvaluationFinished;

use super::progress::evaluation_message;
use super::{Drive, EVALUATION_PATIENCE_ROUNDS, ROUNDS_PER_PAPER_EPOCH};
use crate::error::Error;
use crate::records::Pending;
use tandem_rl::config::Recipe;
use tandem_rl::trainer::{Counters, RoundFigures};

impl Drive<'_> {
    /// Notes an evaluation of the present parameters when one is due. Its episodes are ordered by
    /// [`Self::order_evaluation`]; a checkpoint in between holds it.
    pub(super) fn note_evaluation(&mut self, figures: &RoundFigures) {
        let round = self.trainer.counters().round;
        if round.is_multiple_of(self.config.run.rounds_per_evaluation()) {
            self.push_evaluation(figures);
        }
    }

    pub(super) fn push_evaluation(&mut self, figures: &RoundFigures) {
        self.pending.push_back(Pending {
            counters: self.trainer.counters(),
            figures: *figures,
            wall_s: self.now_s(),
            policy: self.trainer.policy(BTreeMap::new()),
        });
    }

    /// Hands out the episodes of the evaluation that was noted after the latest round, if one was.
    pub(super) fn order_evaluation(&self) {
        let round = self.trainer.counters().round;
        if self.pending.back().is_some_and(|pending| pending.counters.round == round) {
            self.add(self.trainer.evaluation_orders(round));
        }
    }

    /// Whether the parameters after `round` are judged or being judged.
    pub(super) fn is_judged(&self, round: u64) -> bool {
        self.pending.back().is_some_and(|pending| pending.counters.round == round)
            || self.records.judged().rows.last().is_some_and(|row| row.round == round)
    }

    /// Takes in the evaluations that have had their time, waiting for them if need be; false when interrupted. When an
    /// evaluation is taken in depends on the round alone: it may end the run.
    pub(super) fn take_overdue_evaluations(&mut self) -> Result<bool, Error> {
        let round = self.trainer.counters().round;
        let is_overdue =
            |pending: &Pending| round >= pending.counters.round + EVALUATION_PATIENCE_ROUNDS;
        while self.pending.front().is_some_and(is_overdue) {
            if !self.finish_evaluation()? {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Takes in the oldest pending evaluation. Gives whether it could: false when there is none, or when interrupted.
    pub(super) fn finish_evaluation(&mut self) -> Result<bool, Error> {
        let Some(version) = self.pending.front().map(|pending| pending.counters.round) else {
            return Ok(false);
        };
        let Some(episodes) = self.wait_for(EpisodeKind::Evaluation, version)? else {
            return Ok(false);
        };
        let Some(pending) = self.pending.pop_front() else { return Ok(false) };
        let mut row = self.row(&pending);
        let outcomes: Vec<EpisodeOutcome> = episodes.iter().map(EpisodeOutcome::of).collect();
        judge_into(&mut row, &EvaluationSummary::of(&outcomes));
        let is_cooled = row.round > 0 && self.config.run.is_cooldown(row.round - 1);
        let best = self.records.judged().best_row();
        row.best = best.is_none_or(|best| is_better(&row, best, is_cooled));
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
        self.records.add(row, policy);
        self.write_records();
        self.tell_evaluation();
        Ok(true)
    }

    /// Tells of the latest evaluation and the best.
    pub(super) fn tell_evaluation(&self) {
        let judged = self.records.judged();
        let latest = judged.rows.last().map(evaluation_message);
        let best = judged.best_row().map(evaluation_message);
        self.shared.progress.send_modify(|progress| {
            progress.evaluation = latest;
            progress.best = best;
        });
    }

    fn metadata(&self, row: &MetricsRow) -> BTreeMap<String, String> {
        let run = &self.config.run;
        let entries = [
            ("run", run.name.clone()),
            ("seed", run.seed.to_string()),
            ("recipe", if run.recipe == Recipe::Tandem { "tandem" } else { "paper" }.to_owned()),
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
        entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
    }

    /// A row of metrics without the evaluation's figures.
    fn row(&self, pending: &Pending) -> MetricsRow {
        let Pending { counters, figures, wall_s, .. } = pending;
        MetricsRow {
            round: counters.round,
            env_steps: counters.env_steps,
            episodes: counters.episodes,
            updates: counters.updates,
            paper_epochs: counters.round as f64 / ROUNDS_PER_PAPER_EPOCH,
            wall_s: *wall_s,
            mean_q: figures.mean_q,
            critic_loss: figures.critic_loss,
            actor_loss: figures.actor_loss,
            advice_spent: counters.advice_spent,
            budget_left: self.budget_left(*counters),
            training_success: figures.training_success,
            training_moved: figures.training_moved,
            ..MetricsRow::default()
        }
    }

    /// What the run may still spend; a teacher's account may know of charges for episodes that are not learned yet.
    pub(super) fn budget_left(&self, at: Counters) -> u64 {
        let advice = &self.config.run.advice;
        if advice.asks() { advice.budget.saturating_sub(at.advice_spent) } else { 0 }
    }

    pub(super) fn now_s(&self) -> f64 {
        self.wall_before_s + (self.config.clock)().as_secs_f64()
    }
}

fn judge_into(row: &mut MetricsRow, summary: &EvaluationSummary) {
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
}

/// Whether an evaluation beats an earlier one: more success, or as much with fewer contacts. In the cooldown the policy
/// gets better by less than 240 goals can tell, so there the later wins unless their intervals lie apart.
fn is_better(row: &MetricsRow, than: &MetricsRow, is_cooled: bool) -> bool {
    if is_cooled && row.success_high >= than.success_low {
        return true;
    }
    row.success > than.success
        || (row.success >= than.success && row.collision_rate < than.collision_rate)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_later_of_two_alike_is_kept_in_the_cooldown_and_only_there() {
        let row = |success, [success_low, success_high]: [f64; 2], collision_rate| MetricsRow {
            success,
            success_low,
            success_high,
            collision_rate,
            ..MetricsRow::default()
        };
        let lucky = row(1.0, [0.984, 1.0], 0.02);
        let alike = row(0.983, [0.958, 0.994], 0.02);
        let worse = row(0.9, [0.856, 0.932], 0.0);
        assert!(is_better(&alike, &lucky, true));
        assert!(!is_better(&alike, &lucky, false));
        assert!(!is_better(&worse, &lucky, true));
        assert!(is_better(&row(1.0, [0.984, 1.0], 0.01), &lucky, false), "fewer contacts");
    }
}
