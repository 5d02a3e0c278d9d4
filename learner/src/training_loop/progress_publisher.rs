//! Publishes the progress of the run.

use std::collections::{BTreeSet, VecDeque};

use tandem_rl::trainer::{Counters, RoundStats, Trainer};

use crate::evaluation_store::EvaluationHistory;
use crate::progress::{Activity, Phase, WorkerProgress};
use crate::shared::{LearnerConfig, Shared};
use crate::work_queue::{WorkQueue, Worker};

/// Time span over which rates are measured.
const RATE_SPAN_S: f64 = 15.0;
/// Shortest time between two snapshots during the updates of a round.
const UPDATE_PERIOD_S: f64 = 1.0;

/// Publishes snapshots of the run, with its rates and its wall time.
pub(super) struct ProgressPublisher<'a> {
    config: &'a LearnerConfig,
    shared: &'a Shared,
    /// Wall time of the parts of the run before this process.
    wall_before_s: f64,
    /// The ends of recent rounds, oldest first.
    samples: VecDeque<RateSample>,
}

#[derive(Debug, Clone, Copy)]
struct RateSample {
    wall_s: f64,
    env_steps: u64,
    updates: u64,
}

impl<'a> ProgressPublisher<'a> {
    pub(super) const fn new(
        config: &'a LearnerConfig,
        shared: &'a Shared,
        wall_before_s: f64,
    ) -> Self {
        Self { config, shared, wall_before_s, samples: VecDeque::new() }
    }

    /// Returns the wall time of the run so far, seconds, summed over resumed parts.
    pub(super) fn wall_s(&self) -> f64 {
        self.wall_before_s + (self.config.clock)().as_secs_f64()
    }

    /// Publishes the state of the run.
    pub(super) fn publish(&self, phase: Phase, trainer: &Trainer, stats: &RoundStats) {
        let counters = trainer.counters();
        let run = &self.config.run;
        let (env_steps_per_s, updates_per_s) = self.rates();
        let mut state = self.shared.lock();
        state.n_replay_episodes = trainer.replay.n_episodes();
        let workers = workers(&state.queue);
        drop(state);
        self.shared.progress.send_modify(|progress| {
            progress.task.clone_from(&run.task);
            progress.n_arms = run.arms;
            progress.strategy.clone_from(&run.advice.strategy);
            progress.max_env_steps = run.stop.max_env_steps;
            progress.max_minutes = run.stop.max_minutes;
            progress.counters = counters;
            progress.wall_s = self.wall_s();
            progress.env_steps_per_s = env_steps_per_s;
            progress.updates_per_s = updates_per_s;
            progress.budget_left = budget_left(self.config, counters);
            progress.phase = Some(phase);
            progress.training_success = stats.training_success;
            progress.workers = workers;
        });
    }

    /// Publishes the latest evaluation and the best one.
    pub(super) fn publish_evaluations(&self, history: &EvaluationHistory) {
        self.shared.progress.send_modify(|progress| {
            progress.latest = history.rows.last().cloned();
            progress.best = history.best_row().cloned();
        });
    }

    /// Returns a callback for the updates of a round, which measures each of them and publishes their number about once
    /// a second. `learned` are
    /// the counters before the first update.
    pub(super) fn on_update(&self, learned: Counters) -> impl FnMut(u64) {
        let mut published_at_s = self.wall_s();
        let mut updated_at_s = published_at_s;
        move |n_updates| {
            let now_s = self.wall_s();
            self.shared.timings.update_seconds.observe(now_s - updated_at_s);
            updated_at_s = now_s;
            if now_s - published_at_s > UPDATE_PERIOD_S {
                published_at_s = now_s;
                self.shared.progress.send_modify(|progress| {
                    progress.counters.updates = learned.updates + n_updates;
                    progress.wall_s = now_s;
                    progress.phase = Some(Phase::Updating);
                });
            }
        }
    }

    /// Records the end of a round for the rates.
    pub(super) fn record_round(&mut self, learned: Counters) {
        let now_s = self.wall_s();
        let Counters { env_steps, updates, .. } = learned;
        self.samples.push_back(RateSample { wall_s: now_s, env_steps, updates });
        while self.samples.len() > 2 && self.samples[0].wall_s < now_s - RATE_SPAN_S {
            self.samples.pop_front();
        }
    }

    /// Returns recent environment steps and updates per second.
    fn rates(&self) -> (f64, f64) {
        match (self.samples.front(), self.samples.back()) {
            (Some(first), Some(last)) if last.wall_s > first.wall_s => {
                let span_s = last.wall_s - first.wall_s;
                let env_steps = (last.env_steps - first.env_steps) as f64;
                (env_steps / span_s, (last.updates - first.updates) as f64 / span_s)
            }
            _ => (0.0, 0.0),
        }
    }
}

/// Returns the units of advice that the run may still spend. A teacher's account may include charges for episodes that
/// are not learned yet; they do not count here.
pub(super) fn budget_left(config: &LearnerConfig, at: Counters) -> u64 {
    let run = &config.run;
    if run.advice.asks() { run.advice_budget().saturating_sub(at.advice_spent) } else { 0 }
}

/// Returns the workers, without a silent one whose name an active one has: that is a restarted worker.
fn workers(queue: &WorkQueue) -> Vec<WorkerProgress> {
    let active = queue.workers().filter(|(_, worker)| !worker.silent);
    let active: BTreeSet<&str> = active.map(|(_, worker)| worker.name.as_str()).collect();
    let is_shown = |worker: &Worker| !worker.silent || !active.contains(worker.name.as_str());
    let shown = queue.workers().filter(|(_, worker)| is_shown(worker));
    let progress = |(worker_id, worker): (u64, &Worker)| WorkerProgress {
        worker_id,
        name: worker.name.clone(),
        n_episodes: worker.n_episodes,
        activity: activity(worker),
    };
    shown.map(progress).collect()
}

fn activity(worker: &Worker) -> Activity {
    match worker.slot {
        _ if worker.silent => Activity::Silent,
        Some(slot) => Activity::Slot(slot),
        None => Activity::Waiting,
    }
}
