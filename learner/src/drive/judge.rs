//! Judging the policy: evaluations, their row in the metrics, and the policies that are kept.

use std::collections::BTreeMap;

use tandem_core::{EpisodeKind, EpisodeOutcome, EvaluationSummary};
use tandem_policy::Policy;
use tandem_telemetry::MetricsRow;
use tandem_telemetry::events::EvaluationFinished;

use super::progress::evaluation_message;
use super::{Drive, EVALUATION_PATIENCE_ROUNDS, Pending, ROUNDS_PER_PAPER_EPOCH};
use crate::config::Recipe;
use crate::error::Error;
use crate::teacher::Ledger;
use crate::trainer::RoundFigures;

impl Drive<'_> {
    /// Starts an evaluation when one is due, and takes in those that are done or overdue.
    pub(super) fn judge(&mut self, figures: &RoundFigures) -> Result<(), Error> {
        let round = self.trainer.counters().round;
        if round.is_multiple_of(self.config.run.rounds_per_evaluation()) {
            self.start_evaluation(figures);
        }
        while let Some(oldest) = self.pending.front() {
            let overdue = round >= oldest.row.round + EVALUATION_PATIENCE_ROUNDS;
            if !overdue {
                break;
            }
            if !self.finish_evaluation()? {
                break;
            }
        }
        Ok(())
    }

    pub(super) fn start_evaluation(&mut self, figures: &RoundFigures) {
        let version = self.trainer.counters().round;
        let row = self.row(figures);
        self.pending.push_back(Pending {
            version,
            policy: self.trainer.policy(BTreeMap::new()),
            row,
        });
        self.add(self.trainer.evaluation_orders(version));
    }

    /// Takes in the oldest pending evaluation. Gives whether it could: false when interrupted.
    pub(super) fn finish_evaluation(&mut self) -> Result<bool, Error> {
        let Some(pending) = self.pending.front() else { return Ok(false) };
        let Some(episodes) = self.wait_for(EpisodeKind::Evaluation, pending.version) else {
            return Ok(false);
        };
        let Some(Pending { mut policy, mut row, .. }) = self.pending.pop_front() else {
            return Ok(false);
        };
        let outcomes: Vec<EpisodeOutcome> = episodes.iter().map(EpisodeOutcome::of).collect();
        judge_into(&mut row, &EvaluationSummary::of(&outcomes));
        row.best = self.best.as_ref().is_none_or(|best| is_better(&row, best));
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
        self.metrics.append(&row).map_err(self.in_run_directory("append to", "metrics.jsonl"))?;
        self.judged_round = Some(row.round);
        policy.metadata = self.metadata(&row);
        if row.best {
            self.save_policy(&policy, "best")?;
            self.best = Some(row.clone());
        }
        self.save_policy(&policy, "last")?;
        let until = self.config.run.stop.until_success;
        if until > 0.0 && row.success >= until {
            self.success_reached = Some(row.success);
        }
        let evaluation = evaluation_message(&row);
        let best = self.best.as_ref().map(evaluation_message);
        self.shared.progress.send_modify(|progress| {
            progress.evaluation = Some(evaluation);
            progress.best = best;
        });
        Ok(true)
    }

    fn save_policy(&self, policy: &Policy, name: &str) -> Result<(), Error> {
        let directory = self.config.out.join("policy");
        let path = directory.join(format!("{name}.safetensors"));
        std::fs::create_dir_all(&directory).map_err(self.in_run_directory("create", "policy"))?;
        policy.save(&path).map_err(|source| Error::RunDirectory {
            action: "write",
            path,
            source: source.into(),
        })
    }

    fn in_run_directory<E: std::error::Error + Send + Sync + 'static>(
        &self,
        action: &'static str,
        name: &str,
    ) -> impl FnOnce(E) -> Error + use<E> {
        let path = self.config.out.join(name);
        move |source| Error::RunDirectory { action, path, source: source.into() }
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

    /// A row of metrics for the present state, without the evaluation's figures.
    fn row(&self, figures: &RoundFigures) -> MetricsRow {
        let counters = self.trainer.counters();
        MetricsRow {
            round: counters.round,
            env_steps: counters.env_steps,
            episodes: counters.episodes,
            updates: counters.updates,
            paper_epochs: counters.round as f64 / ROUNDS_PER_PAPER_EPOCH,
            wall_s: self.now_s(),
            mean_q: figures.mean_q,
            critic_loss: figures.critic_loss,
            actor_loss: figures.actor_loss,
            advice_spent: counters.advice_spent,
            budget_left: self.budget_left(),
            training_success: figures.training_success,
            training_moved: figures.training_moved,
            ..MetricsRow::default()
        }
    }

    pub(super) fn budget_left(&self) -> u64 {
        self.ledger.as_ref().map_or(0, Ledger::left)
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

/// Whether an evaluation beats another: more success, or as much with fewer contacts.
fn is_better(row: &MetricsRow, than: &MetricsRow) -> bool {
    row.success > than.success
        || (row.success >= than.success && row.collision_rate < than.collision_rate)
}
