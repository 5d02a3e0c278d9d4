//! Publishes the progress of the run.

use std::collections::{BTreeSet, VecDeque};

use tandem_core::Episode;
use tandem_rl::trainer::{Counters, RoundStats, Trainer};
use tandem_telemetry::ActedSteps;

use crate::evaluation_store::EvaluationHistory;
use crate::progress::{Activity, Phase, WorkerProgress};
use crate::shared::{LearnerConfig, Shared};
use crate::work_queue::{WorkQueue, Worker};

/// Time span over which rates are measured.
const RATE_SPAN_S: f64 = 15.0;
/// Shortest time between two snapshots during the updates of a round, and while episodes are awaited.
const PERIOD_S: f64 = 1.0;
/// Episodes of the latest evaluation that are kept for displays.
const KEPT_EPISODES: usize = 4;

/// Publishes snapshots of the run, with its rates and its wall time.
pub(super) struct ProgressPublisher<'a> {
    config: &'a LearnerConfig,
    shared: &'a Shared,
    /// Wall time of the parts of the run before this process.
    wall_before_s: f64,
    /// The ends of recent rounds, oldest first.
    samples: VecDeque<RateSample>,
    /// Wall time of the latest snapshot.
    published_at_s: f64,
}

#[derive(Debug, Clone, Copy)]
struct RateSample {
    wall_s: f64,
    env_steps: u64,
    updates: u64,
    advice_spent: u64,
}

/// Recent rates.
#[derive(Debug, Clone, Copy, Default)]
struct Rates {
    env_steps_per_s: f64,
    updates_per_s: f64,
    advice_per_min: f64,
}

impl<'a> ProgressPublisher<'a> {
    pub(super) const fn new(
        config: &'a LearnerConfig,
        shared: &'a Shared,
        wall_before_s: f64,
    ) -> Self {
        let published_at_s = wall_before_s;
        Self { config, shared, wall_before_s, samples: VecDeque::new(), published_at_s }
    }

    /// Returns the wall time of the run so far, seconds, summed over resumed parts.
    pub(super) fn wall_s(&self) -> f64 {
        self.wall_before_s + (self.config.clock)().as_secs_f64()
    }

    /// Returns true about a second after the latest snapshot.
    pub(super) fn is_due(&self) -> bool {
        self.wall_s() - self.published_at_s >= PERIOD_S
    }

    /// Publishes the state of the run.
    pub(super) fn publish(&mut self, phase: Phase, trainer: &Trainer, stats: &RoundStats) {
        let counters = trainer.counters();
        let run = &self.config.run;
        let now_s = self.wall_s();
        self.published_at_s = now_s;
        let rates = rates(&self.samples, now_s);
        let mut state = self.shared.lock();
        state.n_replay_episodes = trainer.replay.n_episodes();
        let workers = workers(&state.queue);
        drop(state);
        self.shared.progress.send_modify(|progress| {
            if progress.phase.is_none() {
                progress.counters_before = counters;
            }
            progress.task.clone_from(&run.task);
            progress.n_arms = run.arms;
            progress.strategy.clone_from(&run.advice.strategy);
            progress.max_env_steps = run.stop.max_env_steps;
            progress.max_minutes = run.stop.max_minutes;
            progress.counters = counters;
            progress.wall_s = now_s;
            progress.wall_before_s = self.wall_before_s;
            progress.env_steps_per_s = rates.env_steps_per_s;
            progress.updates_per_s = rates.updates_per_s;
            progress.budget_left = budget_left(self.config, counters);
            progress.phase = Some(phase);
            progress.stats = *stats;
            progress.advice_per_min = rates.advice_per_min;
            progress.workers = workers;
        });
    }

    /// Publishes the latest evaluation and the best one.
    pub(super) fn publish_evaluations(&self, history: &EvaluationHistory) {
        self.shared.lock().evaluations = history.rows.as_slice().into();
        self.shared.progress.send_modify(|progress| {
            progress.latest = history.rows.last().cloned();
            progress.best = history.best_row().cloned();
        });
    }

    /// Keeps the first episodes of the latest evaluation for displays.
    pub(super) fn keep_evaluated(&self, episodes: &[Episode]) {
        let n_kept = episodes.len().min(KEPT_EPISODES);
        self.shared.lock().evaluated = episodes[..n_kept].into();
    }

    /// Counts who acted in the steps of a round's training episodes.
    pub(super) fn record_acted(&self, episodes: &[Episode]) {
        self.shared.progress.send_modify(|progress| {
            for episode in episodes {
                count_acted(&mut progress.acted, episode);
            }
        });
    }

    /// Returns a callback for the updates of a round, which measures each of them and publishes their number about once
    /// a second. `learned` are the counters before the first update.
    pub(super) fn on_update(&self, learned: Counters) -> impl FnMut(u64) {
        let mut published_at_s = self.wall_s();
        let mut updated_at_s = published_at_s;
        move |n_updates| {
            let now_s = self.wall_s();
            self.shared.timings.update_seconds.observe(now_s - updated_at_s);
            updated_at_s = now_s;
            if now_s - published_at_s > PERIOD_S {
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
        let Counters { env_steps, updates, advice_spent, .. } = learned;
        self.samples.push_back(RateSample { wall_s: now_s, env_steps, updates, advice_spent });
        while self.samples.len() > 2 && self.samples[0].wall_s < now_s - RATE_SPAN_S {
            self.samples.pop_front();
        }
    }
}

/// Returns the rates between the first and the last of `samples`. They are 0 once the last one is older than
/// [`RATE_SPAN_S`] and than two rounds of recent length: the run waits.
fn rates(samples: &VecDeque<RateSample>, now_s: f64) -> Rates {
    let (Some(first), Some(last)) = (samples.front(), samples.back()) else {
        return Rates::default();
    };
    let span_s = last.wall_s - first.wall_s;
    let round_s = span_s / (samples.len() - 1).max(1) as f64;
    if span_s <= 0.0 || now_s - last.wall_s > RATE_SPAN_S.max(2.0 * round_s) {
        return Rates::default();
    }
    Rates {
        env_steps_per_s: (last.env_steps - first.env_steps) as f64 / span_s,
        updates_per_s: (last.updates - first.updates) as f64 / span_s,
        advice_per_min: (last.advice_spent - first.advice_spent) as f64 * 60.0 / span_s,
    }
}

/// Returns the units of advice that the run may still spend. A teacher's account may include charges for episodes that
/// are not learned yet; they do not count here.
pub(super) fn budget_left(config: &LearnerConfig, at: Counters) -> u64 {
    let run = &config.run;
    if run.advice.asks() { run.advice_budget().saturating_sub(at.advice_spent) } else { 0 }
}

/// Adds the steps of an episode to the counts of its arms.
fn count_acted(acted: &mut Vec<ActedSteps>, episode: &Episode) {
    acted.resize(acted.len().max(episode.task.n_arms()), ActedSteps::default());
    for (arm, counts) in acted.iter_mut().enumerate().take(episode.task.n_arms()) {
        let is_teachers = |arms: &&u8| (u32::from(**arms) >> arm) & 1 == 1;
        let n_teacher = episode.advised_arms.iter().filter(is_teachers).count() as u64;
        counts.teacher += n_teacher;
        counts.student += episode.n_steps() as u64 - n_teacher;
    }
}

/// Returns the workers, without a silent one whose name an active one has: that is a restarted worker.
fn workers(queue: &WorkQueue) -> Vec<WorkerProgress> {
    let active = queue.workers().filter(|(_, worker)| !worker.reported_silent);
    let active: BTreeSet<&str> = active.map(|(_, worker)| worker.name.as_str()).collect();
    let is_shown =
        |worker: &Worker| !worker.reported_silent || !active.contains(worker.name.as_str());
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
        _ if worker.reported_silent => Activity::Silent,
        Some(slot) => Activity::Slot(slot),
        None => Activity::Waiting,
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::{Layout, Task};

    use super::*;

    #[test]
    fn rates_are_0_while_a_run_waits_for_longer_than_two_rounds_take() {
        let samples = |every_s: f64| -> VecDeque<RateSample> {
            let sample = |n: u64| RateSample {
                wall_s: every_s * n as f64,
                env_steps: 100 * n,
                updates: 10 * n,
                advice_spent: n,
            };
            (0..3).map(sample).collect()
        };
        let env_steps_per_s = |every_s, now_s| rates(&samples(every_s), now_s).env_steps_per_s;
        assert_eq!(env_steps_per_s(2.0, 4.0), 50.0);
        assert_eq!(env_steps_per_s(2.0, 19.0), 50.0);
        assert_eq!(env_steps_per_s(2.0, 19.5), 0.0);
        assert_eq!(env_steps_per_s(50.0, 200.0), 2.0, "a slow round");
        assert_eq!(env_steps_per_s(50.0, 201.0), 0.0);
        assert_eq!(rates(&samples(2.0).range(..1).copied().collect(), 0.0).updates_per_s, 0.0);
    }

    #[test]
    fn steps_are_counted_by_arm_and_by_who_acted() {
        let mut acted = Vec::new();
        let mut episode = Episode::zeros(Layout::new(Task::Push, 2), 0);
        episode.advised_arms[..3].copy_from_slice(&[0b01, 0b11, 0b10]);
        count_acted(&mut acted, &episode);
        count_acted(&mut acted, &Episode::zeros(Layout::new(Task::Push, 2), 1));
        let expected = ActedSteps { teacher: 2, student: 98 };
        assert_eq!(acted, [expected, expected]);
    }
}
