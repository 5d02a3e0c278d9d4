//! The run's metrics for Prometheus.
//!
//! Reading them requires no token, so they contain no secret and no worker's own label.

use std::sync::Arc;
use std::time::Duration;

use tandem_net::Metrics;
use tandem_net::metrics::{ConstCounter, ConstGauge, Info, Registry};
use tandem_rl::trainer::Counters;
use tandem_telemetry::MetricsRow;

use crate::progress::{EnvironmentChecks, Progress};
use crate::shared::Shared;
use crate::work_queue::WorkQueue;

/// Adds the state of the run to `metrics`, until it is dropped. The state holds metrics itself, so the metrics must not
/// keep it alive.
pub(crate) fn add(metrics: &Metrics, shared: &Arc<Shared>) {
    let shared = Arc::downgrade(shared);
    metrics.add_source(move |registry| {
        if let Some(shared) = shared.upgrade() {
            add_state(registry, &shared);
        }
    });
}

fn add_state(registry: &mut Registry, shared: &Shared) {
    let progress = shared.progress.borrow().clone();
    let state = shared.lock();
    add_queue(registry, &state.queue, (shared.clock)());
    let n_replay_episodes = state.n_replay_episodes as f64;
    drop(state);
    gauge(registry, "replay_episodes", "Episodes in the replay buffer", n_replay_episodes);
    add_progress(registry, &progress);
    add_evaluations(registry, &progress);
    add_environment(registry, progress.environment);
}

/// Adds the slots and the workers.
fn add_queue(registry: &mut Registry, queue: &WorkQueue, now: Duration) {
    let (waiting, playing) = (queue.n_waiting() as f64, queue.n_assigned() as f64);
    gauge(registry, "assignments_waiting", "Slots that wait for a worker", waiting);
    gauge(registry, "assignments_playing", "Slots that a worker plays", playing);
    gauge(registry, "workers", "Workers that have called lately", queue.n_alive(now) as f64);
}

/// Adds the counters and rates of the run.
fn add_progress(registry: &mut Registry, progress: &Progress) {
    gauge(
        registry,
        "ended",
        "1 once the run has ended",
        f64::from(u8::from(progress.end.is_some())),
    );
    let needs_attention = f64::from(u8::from(!progress.warning.is_empty()));
    gauge(
        registry,
        "needs_attention",
        "1 while the run has a warning; tandem status prints it",
        needs_attention,
    );
    if progress.phase.is_none() {
        // The checkpoint is not loaded yet.
        return;
    }
    let labels = vec![
        ("task", progress.task.clone()),
        ("arms", progress.n_arms.to_string()),
        ("strategy", progress.strategy.clone()),
    ];
    registry.register("run", "What is learned, and how it is advised", Info::new(labels));
    add_counts(registry, progress);
    let left = progress.budget_left as f64;
    gauge(registry, "advice_left", "Units of advice that are left", left);
    gauge(registry, "wall_seconds", "Seconds of the run, resumed parts added up", progress.wall_s);
    let (steps_per_s, updates_per_s) = (progress.env_steps_per_s, progress.updates_per_s);
    gauge(
        registry,
        "env_steps_per_second",
        "Recent environment steps of training per second",
        steps_per_s,
    );
    gauge(registry, "updates_per_second", "Recent updates per second", updates_per_s);
}

/// Returns one of the counters.
type Count = fn(&Counters) -> u64;

/// Adds what the run has done: a counter of this process, and a gauge of the run. A run that continues from a checkpoint has
/// done less than before its learner was killed, which a counter must not show.
fn add_counts(registry: &mut Registry, progress: &Progress) {
    let (now, before) = (&progress.counters, &progress.counters_before);
    let counts: [(&str, &str, Count); 6] = [
        ("rounds", "Rounds that were learned", |counters| counters.round),
        ("env_steps", "Training steps in environments", |counters| counters.env_steps),
        ("episodes", "Training episodes", |counters| counters.episodes),
        ("updates", "Updates of the networks", |counters| counters.updates),
        ("advice_spent", "Units of advice that learned episodes have cost", |counters| {
            counters.advice_spent
        }),
        ("advice_queries", "Training steps on which the teacher was asked", |counters| {
            counters.advice_queries
        }),
    ];
    for (name, help, of) in counts {
        let help_of_process = format!("{help}, since the learner started");
        counter(registry, name, &help_of_process, of(now).saturating_sub(of(before)));
        let help_of_run = format!("{help}, since the run began");
        gauge(registry, &format!("run_{name}"), &help_of_run, of(now) as f64);
    }
}

/// Adds the checks of environments on servers, if there are any.
fn add_environment(registry: &mut Registry, checks: EnvironmentChecks) {
    if checks.n_episodes == 0 {
        return;
    }
    let help = "Episodes that workers have played twice on servers of environments";
    counter(registry, "environment_checked_episodes", help, checks.n_episodes);
    let help = "1 while every episode that was played twice was the same both times";
    let is_deterministic = f64::from(u8::from(!checks.differs));
    gauge(registry, "environment_deterministic", help, is_deterministic);
}

/// Adds success rates, as far as there are any.
fn add_evaluations(registry: &mut Registry, progress: &Progress) {
    let training = "Share of the latest training episodes that succeeded";
    gauge(registry, "training_success_ratio", training, progress.stats.training_success);
    if let Some(evaluation) = &progress.latest {
        let latest = "Share of the latest evaluation's episodes that succeeded";
        gauge(registry, "evaluation_success_ratio", latest, evaluation.success);
        add_measures(registry, evaluation);
    }
    if let Some(best) = &progress.best {
        let help = "Share of the best evaluation's episodes that succeeded";
        gauge(registry, "best_evaluation_success_ratio", help, best.success);
    }
}

/// Adds further measures of the latest evaluation, as far as there are any.
fn add_measures(registry: &mut Registry, evaluation: &MetricsRow) {
    let contacts = &evaluation.contacts;
    for (name, help, value) in [
        (
            "evaluation_success_without_contact_ratio",
            "Share of the latest evaluation's episodes that succeeded without a contact of the arms",
            contacts.success_without_contact,
        ),
        (
            "evaluation_arm_contact_ratio",
            "Share of the latest evaluation's episodes with a contact of the arms",
            contacts.arm_contact_rate,
        ),
        ("evaluation_mean_q", "Mean Q-value at the latest evaluation", Some(evaluation.mean_q)),
        (
            "evaluation_critic_loss",
            "Mean critic loss before the latest evaluation",
            Some(evaluation.critic_loss),
        ),
    ] {
        if let Some(value) = value {
            gauge(registry, name, help, value);
        }
    }
}

fn gauge(registry: &mut Registry, name: &str, help: &str, value: f64) {
    registry.register(name, help, ConstGauge::new(value));
}

fn counter(registry: &mut Registry, name: &str, help: &str, value: u64) {
    registry.register(name, help, ConstCounter::new(value));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::progress::Phase;

    /// Returns the lines of the page that begin with `prefix`.
    fn lines(progress: &Progress, prefix: &str) -> Vec<String> {
        let metrics = Metrics::new(Arc::new(|| Duration::ZERO));
        let progress = progress.clone();
        metrics.add_source(move |registry| add_progress(registry, &progress));
        let page = metrics.page();
        page.lines().filter(|line| line.starts_with(prefix)).map(str::to_owned).collect()
    }

    #[test]
    fn counters_of_a_resumed_run_begin_at_0_once_its_checkpoint_is_loaded() {
        let mut progress = Progress::default();
        assert_eq!(lines(&progress, "tandem_env_steps_total"), [""; 0]);
        assert_eq!(lines(&progress, "tandem_needs_attention "), ["tandem_needs_attention 0.0"]);
        progress.phase = Some(Phase::Collecting);
        progress.counters_before.env_steps = 8500;
        progress.counters.env_steps = 8550;
        assert_eq!(lines(&progress, "tandem_env_steps_total"), ["tandem_env_steps_total 50"]);
        assert_eq!(lines(&progress, "tandem_run_env_steps "), ["tandem_run_env_steps 8550.0"]);
    }
}
