//! A learner that dies at any moment and is resumed leaves what a calm one leaves.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tandem_learner::checkpoint::{self, CheckpointError};
use tandem_learner::{Error, LearnerConfig, RunOutcome};
use tandem_rl::RunConfig;
use tandem_telemetry::MetricsLog;
use tempfile::TempDir;

use crate::service_tests::run::{Left, Served, calm, copy_all, learner_config, real_clock};
use crate::service_tests::silence::clock_of;
use crate::service_tests::toy::config;

async fn resume(run: RunConfig, out: &Path) -> Result<RunOutcome, Error> {
    Served::start(learner_config(run, out, true)).await.finish(2).await
}

/// The run directory as it was before and after every delivery of a run.
async fn moments(run: RunConfig) -> (TempDir, Vec<PathBuf>) {
    let keep = tempfile::tempdir().expect("a directory");
    let out = keep.path().join("run");
    let served = Served::start(learner_config(run, &out, false)).await;
    let mut toy = served.join("toy").await;
    let mut moments = copies_of(&out, keep.path());
    moments.copy();
    while let Some((order, episodes)) = toy.take().await {
        moments.copy();
        toy.deliver(order.slot, &episodes).await.expect("taken");
        moments.copy();
    }
    served.end().await.expect("a run");
    moments.copy();
    let copies = moments.copies;
    (keep, copies)
}

/// Copies of a run directory at several moments.
pub(crate) struct Moments {
    out: PathBuf,
    keep: PathBuf,
    pub(crate) copies: Vec<PathBuf>,
}

/// Copies of the run directory `out`, made in `keep`.
pub(crate) fn copies_of(out: &Path, keep: &Path) -> Moments {
    Moments { out: out.to_owned(), keep: keep.to_owned(), copies: Vec::new() }
}

impl Moments {
    /// Copies the directory as it is now.
    pub(crate) fn copy(&mut self) {
        let copy = self.keep.join(self.copies.len().to_string());
        copy_all(&self.out, &copy);
        self.copies.push(copy);
    }
}

async fn check_every_moment(run: RunConfig, step: usize) {
    let expected = calm(run.clone()).await;
    let (_keep, copies) = moments(run.clone()).await;
    assert!(copies.len() > 30, "{} moments", copies.len());
    for (n, out) in copies.iter().enumerate().step_by(step) {
        let ended = resume(run.clone(), out).await.expect("continues");
        assert_eq!(Left::behind(&ended, out), expected, "from moment {n}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_learner_killed_at_any_moment_ends_with_the_same_bits() {
    check_every_moment(config(0), 3).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_learner_with_lag_killed_at_any_moment_ends_with_the_same_bits() {
    check_every_moment(config(1), 3).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_that_ends_with_a_success_rate_ends_with_the_same_one_when_resumed() {
    let whole = calm(config(1)).await;
    let successes: Vec<f64> = whole.rows.iter().map(|row| row.success).collect();
    let highest = successes[..4].iter().copied().fold(0.0, f64::max);
    assert!(highest > 0.0 && highest > successes[0], "the toy must vary: {successes:?}");
    let mut run = config(1);
    run.stop.until_success = highest;
    run.stop.max_env_steps = 0;
    let ended = calm(run.clone()).await;
    assert!(ended.rows.last().is_some_and(|row| row.round < 16), "it ended by success");
    check_every_moment(run, 4).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_interrupted_repeatedly_ends_with_the_same_bits() {
    for lag in [0, 1] {
        check_interruptions(config(lag), 7).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_interrupted_in_an_evaluation_that_ends_it_learns_no_further_round() {
    let whole = calm(config(0)).await;
    let highest = whole.rows[..4].iter().map(|row| row.success).fold(0.0, f64::max);
    let mut run = config(0);
    run.stop.until_success = highest;
    run.stop.max_env_steps = 0;
    // A round has four slots.
    for n_slots in 4..=8 {
        check_interruptions(run.clone(), n_slots).await;
    }
}

/// Checks that a run that is interrupted each time it has played `n_slots` slots ends as an undisturbed one.
async fn check_interruptions(run: RunConfig, n_slots: usize) {
    let expected = calm(run.clone()).await;
    let directory = tempfile::tempdir().expect("a directory");
    let mut n_starts = 0;
    let ended = loop {
        n_starts += 1;
        let served =
            Served::start(learner_config(run.clone(), directory.path(), n_starts > 1)).await;
        let mut toy = served.join("toy").await;
        for _ in 0..n_slots {
            if !toy.play_one().await {
                break;
            }
        }
        served.shutdown.cancel();
        let ended = served.end().await.expect("saved");
        assert_eq!(ended.digest.len(), 64, "reported after an interruption too");
        if !ended.interrupted {
            break ended;
        }
    };
    assert!(n_starts > 2, "{n_starts} starts");
    assert_eq!(Left::behind(&ended, directory.path()), expected, "{n_slots} slots at a time");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_finished_run_is_resumed_without_workers_and_ends_as_before() {
    let directory = tempfile::tempdir().expect("a directory");
    let served = Served::start(learner_config(config(1), directory.path(), false)).await;
    let ended = served.finish(2).await.expect("a run");
    let left = Left::behind(&ended, directory.path());
    let again = Served::start(learner_config(config(1), directory.path(), true)).await;
    let ended = again.end().await.expect("nothing is left to do");
    assert!(!ended.interrupted);
    assert_eq!(Left::behind(&ended, directory.path()), left);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_damaged_checkpoint_is_refused_until_it_is_removed() {
    let directory = tempfile::tempdir().expect("a directory");
    let (out, run) = (directory.path(), config(0));
    let expected = calm(run.clone()).await;
    Served::start(learner_config(run.clone(), out, false)).await.finish(1).await.expect("a run");
    let newest = checkpoint::list(&out.join("checkpoint")).pop().expect("saved");
    let mut bytes = std::fs::read(&newest).expect("readable");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&newest, bytes).expect("writes");
    let refused = resume(run.clone(), out).await.expect_err("must be refused");
    let Error::Checkpoint(CheckpointError::Damaged { path, what }) = refused else {
        panic!("{refused}");
    };
    assert_eq!(path, newest);
    assert!(what.contains("remove it to continue from"), "{what}");
    std::fs::remove_file(&newest).expect("removes");
    let ended = resume(run, out).await.expect("continues from the former one");
    assert_eq!(Left::behind(&ended, out), expected);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_new_run_does_not_overwrite_a_former_one_nor_join_a_running_one() {
    let directory = tempfile::tempdir().expect("a directory");
    let out = directory.path();
    let first = Served::start(learner_config(config(0), out, false)).await;
    first.join("toy").await;
    // It waits for half a minute by its clock, which is fast.
    let clock = real_clock();
    let second = Served::start(LearnerConfig {
        clock: Arc::new(move || clock() * 1000),
        ..learner_config(config(0), out, true)
    });
    let second = second.await;
    let refused = second.end().await.expect_err("one is at work").to_string();
    assert!(refused.starts_with("cannot lock"), "{refused}");
    let third = Served::start(learner_config(config(0), out, true)).await;
    let ended = first.finish(1).await.expect("a run");
    let again = third.end().await.expect("the directory is free, and the run is over");
    assert_eq!(again.digest, ended.digest);
    let rows = MetricsLog::read_all(&out.join("metrics.jsonl")).expect("rows");
    let anew = Served::start(learner_config(config(0), out, false)).await;
    let refused = anew.end().await.expect_err("a run is there");
    assert!(matches!(refused, Error::Checkpoint(CheckpointError::RunExists(_))), "{refused}");
    assert_eq!(MetricsLog::read_all(&out.join("metrics.jsonl")).expect("rows"), rows);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_ends_after_its_minutes_and_a_resumed_one_has_none_left() {
    let directory = tempfile::tempdir().expect("a directory");
    let seconds = Arc::new(AtomicU64::new(0));
    let mut run = config(0);
    (run.stop.max_env_steps, run.stop.max_minutes) = (0, 1.0);
    let of = |resume| {
        let clock = clock_of(&seconds);
        LearnerConfig { clock, ..learner_config(run.clone(), directory.path(), resume) }
    };
    let served = Served::start(of(false)).await;
    let mut toy = served.join("toy").await;
    seconds.store(59, Ordering::Relaxed);
    for _ in 0..4 {
        assert!(toy.play_one().await, "the slots of a round");
    }
    assert!(toy.play_one().await, "there is time for a second round");
    seconds.store(60, Ordering::Relaxed);
    while toy.play_one().await {}
    let ended = served.end().await.expect("a run");
    let rows = Left::behind(&ended, directory.path()).rows;
    assert_eq!((ended.interrupted, rows.last().expect("rows").round), (false, 2));
    let resumed = Served::start(of(true)).await.end().await.expect("it is over");
    assert_eq!(resumed.digest, ended.digest);
}
