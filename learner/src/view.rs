//! Snapshots of the run for displays.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use tandem_rl::config::RunConfig;
use tandem_telemetry::{EndView, RunView, WorkerState, WorkerView};
use tokio::sync::watch;

use crate::progress::{Progress, RunEnd};
use crate::shared::Shared;
use crate::work_queue::{WorkQueue, Worker};

/// Time between two snapshots.
const PERIOD: Duration = Duration::from_millis(400);
/// Time without a call after which a worker without a connection is shown as disconnected.
const DISCONNECTED_AFTER: Duration = Duration::from_millis(200);

/// Sends snapshots while it is polled, and never ends. Without a receiver it does nothing.
pub(crate) async fn publish(
    views: Option<watch::Sender<RunView>>,
    shared: Arc<Shared>,
    run: RunConfig,
) {
    let Some(views) = views else { return std::future::pending().await };
    let mut shown_s = 0.0;
    loop {
        let view = snapshot(&shared, &run, shown_s);
        shown_s = view.wall_s;
        views.send_replace(view);
        tokio::time::sleep(PERIOD).await;
    }
}

/// Returns the state of the run. The previous snapshot showed the wall time `shown_s`.
fn snapshot(shared: &Shared, run: &RunConfig, shown_s: f64) -> RunView {
    let progress = shared.progress.borrow().clone();
    let teacher = shared.teacher.borrow().clone();
    let now = (shared.clock)();
    let state = shared.lock();
    let counters = progress.counters;
    RunView {
        run: run.name.clone(),
        task: run.task.clone(),
        n_arms: run.arms,
        strategy: run.advice.strategy.clone(),
        seed: run.seed,
        phase: progress.phase.map_or("", |phase| phase.name()).to_owned(),
        wall_s: wall_s(&progress, now, shown_s),
        round: counters.round,
        resumed_from_round: progress.counters_before.round,
        env_steps: counters.env_steps,
        max_env_steps: run.stop.max_env_steps,
        max_minutes: run.stop.max_minutes,
        episodes: counters.episodes,
        updates: counters.updates,
        env_steps_per_s: progress.env_steps_per_s,
        updates_per_s: progress.updates_per_s,
        advice_spent: counters.advice_spent,
        advice_queries: counters.advice_queries,
        advice_left: progress.budget_left,
        advice_per_min: progress.advice_per_min,
        training_success: progress.stats.training_success,
        mean_q: progress.stats.mean_q,
        critic_loss: progress.stats.critic_loss,
        actor_loss: progress.stats.actor_loss,
        acted: progress.acted,
        n_waiting_slots: state.queue.n_waiting(),
        n_playing_slots: state.queue.n_assigned(),
        n_replay_episodes: state.n_replay_episodes,
        workers: workers(&state.queue, now),
        teacher,
        warning: progress.warning,
        end: progress.end.map(end),
        evaluations: state.evaluations.clone(),
        evaluated: state.evaluated.clone(),
    }
}

/// Returns the wall time to show, in seconds. It passes while the run waits too, stands still after the end, and never
/// goes back.
fn wall_s(progress: &Progress, now: Duration, shown_s: f64) -> f64 {
    match progress.end {
        Some(_) => progress.wall_s.max(shown_s),
        None => progress.wall_before_s + now.as_secs_f64(),
    }
}

fn end(end: RunEnd) -> EndView {
    EndView { reason: end.reason, interrupted: end.interrupted, digest: end.digest }
}

/// Returns the workers, without an inactive one if a later one of the same name was seen after it: that is the same
/// worker, restarted.
fn workers(queue: &WorkQueue, now: Duration) -> Vec<WorkerView> {
    let all: Vec<(u64, &Worker)> = queue.workers().collect();
    let mut seen = BTreeMap::new();
    let mut shown = Vec::new();
    for (id, worker) in all.into_iter().rev() {
        let state = worker_state(worker, now);
        let later: &mut Duration = seen.entry(worker.name.as_str()).or_default();
        if !state.is_active() && *later > worker.last_seen {
            continue;
        }
        *later = worker.last_seen.max(*later);
        shown.push(WorkerView {
            id,
            name: worker.name.clone(),
            state,
            slot: worker.slot,
            n_episodes: worker.n_episodes,
            last_seen_s: now.saturating_sub(worker.last_seen).as_secs_f64(),
        });
    }
    shown.reverse();
    shown
}

fn worker_state(worker: &Worker, now: Duration) -> WorkerState {
    let is_quiet = now.saturating_sub(worker.last_seen) >= DISCONNECTED_AFTER;
    match worker.slot {
        _ if worker.connection.is_none() && is_quiet => WorkerState::Disconnected,
        _ if worker.reported_silent => WorkerState::Silent,
        Some(_) => WorkerState::Playing,
        None => WorkerState::Waiting,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_passes_while_the_run_waits_and_stands_still_after_its_end() {
        let at = Duration::from_secs;
        let mut progress = Progress { wall_s: 62.0, wall_before_s: 60.0, ..Progress::default() };
        assert_eq!(wall_s(&progress, at(2), 0.0), 62.0);
        assert_eq!(wall_s(&progress, at(32), 62.0), 92.0, "nothing was published for 30 s");
        let reason = "an error".to_owned();
        progress.end = Some(RunEnd { reason, interrupted: true, digest: None });
        assert_eq!(wall_s(&progress, at(50), 92.0), 92.0, "an event before the end is no later");
    }

    #[test]
    fn a_restarted_worker_takes_the_place_of_its_former_self() {
        let mut queue = WorkQueue::default();
        let at = Duration::from_secs;
        let mut join = |name: &str, connection, now| {
            let id = queue.join(name.to_owned(), Some(connection), now).expect("there is room");
            queue.next(id, now).expect("it has joined");
            id
        };
        let (first, second) = (join("a", 1, at(0)), join("b", 2, at(0)));
        let states = |queue: &WorkQueue, now| {
            let shown = workers(queue, now).into_iter();
            shown.map(|worker| (worker.id, worker.state)).collect::<Vec<_>>()
        };
        let (waiting, gone) = (WorkerState::Waiting, WorkerState::Disconnected);
        assert_eq!(states(&queue, at(0)), [(first, waiting), (second, waiting)]);
        queue.remove_connection(1);
        assert_eq!(states(&queue, at(1)), [(first, gone), (second, waiting)]);
        let again = queue.join("a".to_owned(), Some(3), at(2)).expect("there is room");
        queue.next(again, at(2)).expect("it has joined");
        assert_eq!(states(&queue, at(2)), [(second, waiting), (again, waiting)]);
        queue.reclaim(at(30));
        assert_eq!(
            states(&queue, at(30)),
            [(second, WorkerState::Silent), (again, WorkerState::Silent)]
        );
    }
}
