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
    gauge(registry, "workers", "Workers that call", queue.n_alive(now) as f64);
}

/// Adds the counters and rates of the run.
fn add_progress(registry: &mut Registry, progress: &Progress) {
    let labels = vec![
        ("task", progress.task.clone()),
        ("arms", progress.n_arms.to_string()),
        ("strategy", progress.strategy.clone()),
    ];
    registry.register("run", "What is learned, and how it is advised", Info::new(labels));
    let Counters { round, env_steps, episodes, updates, advice_spent, advice_queries } =
        progress.counters;
    counter(registry, "rounds", "Rounds that were learned", round);
    counter(registry, "env_steps", "Training steps in environments", env_steps);
    counter(registry, "episodes", "Training episodes", episodes);
    counter(registry, "updates", "Updates of the networks", updates);
    counter(
        registry,
        "advice_spent",
        "Units of advice that learned episodes have cost",
        advice_spent,
    );
    let help = "Training steps on which the teacher was asked";
    counter(registry, "advice_queries", help, advice_queries);
    let left = progress.budget_left as f64;
    gauge(registry, "advice_left", "Units of advice that are left", left);
    gauge(registry, "wall_seconds", "Seconds of the run, resumed parts added up", progress.wall_s);
    let (steps_per_s, updates_per_s) = (progress.env_steps_per_s, progress.updates_per_s);
    gauge(registry, "env_steps_per_second", "Training steps a second, of late", steps_per_s);
    gauge(registry, "updates_per_second", "Updates a second, of late", updates_per_s);
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
        "1 while something requires an operator, see Status",
        needs_attention,
    );
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
