//! What the learner tells of the run as it goes.

use std::collections::BTreeSet;

use tandem_proto::pb;
use tandem_telemetry::MetricsRow;

use super::Drive;
use crate::board::Worker;
use tandem_rl::trainer::RoundFigures;

impl Drive<'_> {
    /// Publishes the progress.
    pub(super) fn tell(&self, phase: &str, figures: &RoundFigures) {
        let counters = self.trainer.counters();
        let rate =
            |count: fn(&(f64, u64, u64)) -> u64| match (self.rates.front(), self.rates.back()) {
                (Some(first), Some(last)) if last.0 > first.0 => {
                    (count(last) - count(first)) as f64 / (last.0 - first.0)
                }
                _ => 0.0,
            };
        let run = &self.config.run;
        self.shared.lock().n_replay_episodes = self.trainer.replay.n_episodes();
        let workers = self.workers();
        self.shared.progress.send_modify(|progress| {
            progress.task.clone_from(&run.task);
            progress.n_arms = u32::try_from(run.arms).unwrap_or(u32::MAX);
            progress.strategy.clone_from(&run.advice.strategy);
            progress.round = counters.round;
            progress.env_steps = counters.env_steps;
            progress.episodes = counters.episodes;
            progress.updates = counters.updates;
            progress.wall_s = self.now_s();
            progress.env_steps_per_s = rate(|(_, env_steps, _)| *env_steps);
            progress.updates_per_s = rate(|(_, _, updates)| *updates);
            progress.advice_spent = counters.advice_spent;
            progress.budget_left = self.budget_left(counters);
            progress.phase = phase.to_owned();
            progress.training_success = figures.training_success;
            progress.workers = workers;
        });
    }

    /// The workers, without those that are silent while another has their name: started again, as a rule.
    fn workers(&self) -> Vec<pb::WorkerProgress> {
        let state = self.shared.lock();
        let alive: BTreeSet<&str> = state
            .board
            .workers()
            .filter(|(_, worker)| !worker.silent)
            .map(|(_, worker)| worker.name.as_str())
            .collect();
        let shown = state
            .board
            .workers()
            .filter(|(_, worker)| !worker.silent || !alive.contains(worker.name.as_str()));
        shown
            .map(|(worker_id, worker)| pb::WorkerProgress {
                worker_id,
                name: worker.name.clone(),
                episodes: worker.n_episodes,
                doing: doing(worker),
            })
            .collect()
    }
}

fn doing(worker: &Worker) -> String {
    match worker.slot {
        _ if worker.silent => "silent".to_owned(),
        Some(slot) => format!("slot {slot}"),
        None => "waiting".to_owned(),
    }
}

/// An evaluation's figures as a message.
pub(super) fn evaluation_message(row: &MetricsRow) -> pb::Evaluation {
    pb::Evaluation {
        round: row.round,
        env_steps: row.env_steps,
        n_episodes: u32::try_from(row.n_episodes).unwrap_or(u32::MAX),
        success: row.success,
        success_low: row.success_low,
        success_high: row.success_high,
        success_joint: row.success_joint,
        success_per_arm: row.success_per_arm.clone(),
        collision_rate: row.collision_rate,
        mean_q: row.mean_q,
    }
}
