//! The run in figures, as Prometheus reads them (OpenMetrics text).
//!
//! They are for dashboards and for whoever decides how many workers there shall be. Nobody needs a token to read them, so
//! nothing here may be a secret, and no worker's own label is given.

use std::time::Duration;

use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::Registry;
use tandem_proto::pb;

use crate::board::Board;
use crate::shared::Shared;

pub(crate) const PATH: &str = "/metrics";
pub(crate) const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// How things stand.
pub(crate) fn page(shared: &Shared) -> String {
    let progress = shared.progress.borrow().clone();
    let mut registry = Registry::with_prefix("tandem");
    let state = shared.lock();
    add_board(&mut registry, &state.board, (shared.clock)());
    let n_replay_episodes = state.n_replay_episodes;
    drop(state);
    gauge(
        &mut registry,
        "replay_episodes",
        "Episodes in the replay buffer",
        n_replay_episodes as f64,
    );
    add_progress(&mut registry, &progress);
    add_judgement(&mut registry, &progress);
    let mut page = String::new();
    encode(&mut page, &registry).expect("a text takes whatever is written to it");
    page
}

/// What is to be played, and by how many.
fn add_board(registry: &mut Registry, board: &Board, now: Duration) {
    let (waiting, playing) = (board.n_waiting() as f64, board.n_out() as f64);
    gauge(registry, "assignments_waiting", "Slots that wait for a worker", waiting);
    gauge(registry, "assignments_playing", "Slots that a worker plays", playing);
    gauge(registry, "workers", "Workers that are heard of", board.n_alive(now) as f64);
}

/// How far the run has come.
fn add_progress(registry: &mut Registry, progress: &pb::Progress) {
    let labels = vec![
        ("task", progress.task.clone()),
        ("arms", progress.n_arms.to_string()),
        ("strategy", progress.strategy.clone()),
    ];
    registry.register("run", "What is learned, and how it is advised", Info::new(labels));
    let pb::Progress { round, env_steps, episodes, updates, advice_spent, .. } = *progress;
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
    let left = progress.budget_left as f64;
    gauge(registry, "advice_left", "Units of advice that are left", left);
    gauge(registry, "wall_seconds", "Seconds of the run, resumed parts added up", progress.wall_s);
    let (steps_per_s, updates_per_s) = (progress.env_steps_per_s, progress.updates_per_s);
    gauge(registry, "env_steps_per_second", "Training steps a second, of late", steps_per_s);
    gauge(registry, "updates_per_second", "Updates a second, of late", updates_per_s);
    gauge(registry, "ended", "1 once the run has ended", f64::from(u8::from(progress.ended)));
    let needs_a_person = f64::from(u8::from(!progress.warning.is_empty()));
    gauge(
        registry,
        "needs_attention",
        "1 while something needs a person, see Status",
        needs_a_person,
    );
}

/// How good the policy is; what has not been judged yet is left out.
fn add_judgement(registry: &mut Registry, progress: &pb::Progress) {
    let training = "Share of the latest training episodes that succeeded";
    gauge(registry, "training_success_ratio", training, progress.training_success);
    if let Some(evaluation) = &progress.evaluation {
        let latest = "Share of the latest evaluation's episodes that succeeded";
        gauge(registry, "evaluation_success_ratio", latest, evaluation.success);
    }
    if let Some(best) = &progress.best {
        let help = "Share of the best evaluation's episodes that succeeded";
        gauge(registry, "best_evaluation_success_ratio", help, best.success);
    }
}

fn gauge(registry: &mut Registry, name: &str, help: &str, value: f64) {
    registry.register(name, help, ConstGauge::new(value));
}

fn counter(registry: &mut Registry, name: &str, help: &str, value: u64) {
    registry.register(name, help, ConstCounter::new(value));
}
