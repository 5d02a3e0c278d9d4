//! The loop of a new run, at a clock that a test sets.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tandem_core::Task;
use tandem_net::{ClientConfig, Pacing, ServerConfig};
use tandem_rl::config::Recipe;

use super::*;
use crate::checkpoint;
use crate::runtime::on_a_thread;
use crate::timings::Timings;

/// The time since the start of the learner.
#[derive(Clone, Default)]
struct SetTime(Arc<AtomicU64>);

impl SetTime {
    fn set_millis(&self, millis: u64) {
        self.0.store(millis, Ordering::Relaxed);
    }
}

fn config(out: &Path, time: &SetTime) -> LearnerConfig {
    let mut run = RunConfig::defaults(Recipe::Tandem, Task::Push, 1);
    (run.rounds.slots, run.ddpg.n_hidden, run.checkpoint.every_rounds) = (1, 4, 3);
    let time = time.clone();
    LearnerConfig {
        run,
        server_config: ServerConfig::default(),
        client_config: ClientConfig::default(),
        teacher: None,
        start_from: None,
        out: out.to_owned(),
        resume: false,
        out_is_locked: false,
        run_file: None,
        n_threads: 1,
        clock: Arc::new(move || Duration::from_millis(time.0.load(Ordering::Relaxed))),
        unix_start: Duration::ZERO,
        version: String::new(),
        first_worker: 0,
        pacing: Pacing::Concurrent,
    }
}

/// Runs `check` with the loop of a new run in `out`, before its first round.
async fn with_loop(
    out: &Path,
    check: impl FnOnce(&mut LearnerLoop<'_>, &SetTime) + Send + 'static,
) {
    let time = SetTime::default();
    let config = config(out, &time);
    let checked = on_a_thread("learn", Pacing::Concurrent, move |runtime| {
        let timings = Timings::register(config.server_config.metrics());
        let shared = Shared::new(&config, timings);
        let shutdown = CancellationToken::new();
        let context =
            Context { config: &config, shared: &shared, runtime: &runtime, shutdown: &shutdown };
        let initial = InitialState::load(context).expect("a new run");
        check(&mut LearnerLoop::new(context, initial, None), &time);
    });
    checked.await.expect("a thread").expect("the checks pass");
}

/// Adds a worker that asks for work once.
fn join(shared: &Shared) -> u64 {
    let mut state = shared.lock();
    let worker = state.queue.join("w".to_owned(), None, Duration::ZERO).expect("there is room");
    state.queue.next(worker, Duration::ZERO).expect("joined");
    worker
}

#[tokio::test]
async fn silent_workers_are_noticed_in_a_run_that_never_waits() {
    let directory = tempfile::tempdir().expect("a directory");
    with_loop(directory.path(), |learner, time| {
        let shared = learner.context.shared;
        let worker = join(shared);
        time.set_millis(20_000);
        // Nothing is ordered, so nothing is awaited.
        let episodes = learner.wait_for(EpisodeKind::Training, 0).expect("nothing is missing");
        assert_eq!(episodes, []);
        assert!(shared.lock().queue.worker(worker).expect("known").reported_silent);
    })
    .await;
}

#[tokio::test]
async fn a_waiting_run_publishes_its_progress_once_a_second() {
    let directory = tempfile::tempdir().expect("a directory");
    with_loop(directory.path(), |learner, time| {
        let shared = learner.context.shared;
        learner.order(learner.trainer.training_orders(0, 0));
        learner.context.shutdown.cancel();
        join(shared);
        let shown = |learner: &mut LearnerLoop<'_>, millis| {
            time.set_millis(millis);
            let awaited = learner.wait_for(EpisodeKind::Training, 0);
            assert!(matches!(awaited, Err(Halt::Interrupted)), "{awaited:?}");
            let progress = shared.progress.borrow();
            (progress.phase, progress.wall_s, progress.workers.len())
        };
        assert_eq!(shown(learner, 900), (Some(Phase::Starting), 0.0, 0));
        assert_eq!(shown(learner, 1000), (Some(Phase::Collecting), 1.0, 1));
        assert_eq!(shown(learner, 1900), (Some(Phase::Collecting), 1.0, 1));
        assert_eq!(shown(learner, 2100), (Some(Phase::Collecting), 2.1, 1));
    })
    .await;
}

#[tokio::test]
async fn evaluations_do_not_postpone_the_repetition_of_a_failed_checkpoint() {
    let directory = tempfile::tempdir().expect("a directory");
    let in_the_way = directory.path().join("checkpoint");
    std::fs::write(&in_the_way, "").expect("writes");
    let path = in_the_way.clone();
    with_loop(directory.path(), move |learner, time| {
        let persist_after_round = |learner: &mut LearnerLoop<'_>, round| {
            learner.trainer.counters.round = round;
            let (persistence, mut state) = learner.persistence_and_state();
            persistence.persist_if_due(&mut state);
            checkpoint::list(&path).len()
        };
        assert_eq!(persist_after_round(learner, 3), 0, "a file is in the way");
        time.set_millis(9_000);
        learner.write_records();
        std::fs::remove_file(&path).expect("removes");
        assert_eq!(persist_after_round(learner, 4), 0, "too early");
        time.set_millis(10_000);
        assert_eq!(persist_after_round(learner, 4), 1);
    })
    .await;
}

#[tokio::test]
async fn the_wall_time_after_a_checkpoint_is_saved_too() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("checkpoint");
    with_loop(directory.path(), move |learner, time| {
        for (millis, saved_wall_s) in [(5_000, 5.0), (5_500, 5.0), (25_000, 25.0)] {
            time.set_millis(millis);
            learner.save();
            let run = &learner.context.config.run;
            let restored = checkpoint::load_newest(&path, run).expect("whole").expect("saved");
            assert_eq!(restored.resumption.wall_s, saved_wall_s, "at {millis} ms");
        }
    })
    .await;
}

#[tokio::test]
async fn a_run_whose_checkpoint_lacks_only_wall_time_can_be_interrupted_without_a_write() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("checkpoint");
    with_loop(directory.path(), move |learner, time| {
        time.set_millis(5_000);
        learner.save();
        let in_the_way = path.join("00000000.safetensors.tmp");
        std::fs::create_dir(&in_the_way).expect("creates");
        time.set_millis(25_000);
        let outcome = learner.finish(None).expect("the checkpoint is complete");
        assert!(outcome.interrupted, "{outcome:?}");
        assert_eq!(learner.context.shared.progress.borrow().warning, "");
        std::fs::remove_dir(&in_the_way).expect("removes");
        let run = &learner.context.config.run;
        let restored = checkpoint::load_newest(&path, run).expect("whole").expect("saved");
        assert_eq!(restored.resumption.wall_s, 5.0);
    })
    .await;
}
