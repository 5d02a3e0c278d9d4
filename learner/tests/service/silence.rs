//! Workers that die, and a learner whose own thread does.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use tandem_learner::{Clock, Error, LearnerConfig};
use tandem_proto::pb;
use tandem_proto::pb::next_work_response::Work;

use crate::service_tests::run::{DEADLINE, Left, Served, calm, learner_config, real_clock};
use crate::service_tests::toy::config;

/// Serves a run in `directory` whose clock shows the returned number of seconds, from 0.
async fn served_by_hand_clock(directory: &Path) -> (Served, Arc<AtomicU64>) {
    let seconds = Arc::new(AtomicU64::new(0));
    let clock = clock_of(&seconds);
    let config = LearnerConfig { clock, ..learner_config(config(0), directory, false) };
    (Served::start(config).await, seconds)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dead_workers_slot_is_played_by_another_within_seconds() {
    let expected = calm(config(0)).await;
    let directory = tempfile::tempdir().expect("a directory");
    let (served, seconds) = served_by_hand_clock(directory.path()).await;
    let (mut dead, mut alive) = (served.join("dead").await, served.join("alive").await);
    let (lost, _) = dead.take().await.expect("a slot");
    for _ in 0..3 {
        assert!(alive.play_one().await, "the other slots");
    }
    seconds.store(2, Ordering::Relaxed);
    let answer = alive.ask().await;
    assert!(!matches!(answer, Ok(Work::Slot(_))), "the other worker may be slow: {answer:?}");
    // Far from the 15 s after which a dead worker loses its slot.
    seconds.store(4, Ordering::Relaxed);
    let taken = tokio::time::timeout(DEADLINE, alive.take()).await.expect("in time");
    let (order, episodes) = taken.expect("the lost slot");
    assert_eq!(order.slot, lost.slot);
    alive.deliver(order.slot, &episodes).await.expect("taken");
    while alive.play_one().await {}
    seconds.store(60, Ordering::Relaxed);
    let ended = served.end().await.expect("a run");
    assert_eq!(Left::behind(&ended, directory.path()), expected);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_that_plays_beyond_the_end_receives_it() {
    let directory = tempfile::tempdir().expect("a directory");
    let served = Served::start(learner_config(config(0), directory.path(), false)).await;
    let (mut slow, mut fast) = (served.join("slow").await, served.join("fast").await);
    let (order, episodes) = slow.take().await.expect("a slot");
    while fast.play_one().await {}
    // Far longer than the learner stays for those who have nothing to do.
    tokio::time::sleep(Duration::from_millis(500)).await;
    slow.deliver(order.slot, &episodes).await.expect("the learner is still there");
    match slow.ask().await {
        Ok(Work::Finished(finished)) => assert!(!finished.interrupted, "{}", finished.reason),
        other => panic!("{other:?}"),
    }
    assert!(!served.end().await.expect("a run").interrupted);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_disconnected_workers_slot_is_played_by_another_at_once() {
    let expected = calm(config(0)).await;
    let directory = tempfile::tempdir().expect("a directory");
    // The clock does not advance before the end, so no worker is slow or silent.
    let (served, seconds) = served_by_hand_clock(directory.path()).await;
    let (mut gone, mut alive) = (served.join("gone").await, served.join("alive").await);
    gone.take().await.expect("a slot");
    drop(gone);
    let played = async { while alive.play_one().await {} };
    tokio::time::timeout(DEADLINE, played).await.expect("every slot is to be had");
    // The disconnected worker might still be playing, until it counts as dead.
    seconds.store(15, Ordering::Relaxed);
    let ended = served.end().await.expect("a run");
    assert_eq!(Left::behind(&ended, directory.path()), expected);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_that_disconnects_again_loses_its_slot_at_once_again() {
    let expected = calm(config(0)).await;
    let directory = tempfile::tempdir().expect("a directory");
    // The clock does not advance before the end, so no worker is slow or silent.
    let (served, seconds) = served_by_hand_clock(directory.path()).await;
    let (mut cut, mut alive) = (served.join("cut").await, served.join("alive").await);
    let (lost, _) = cut.take().await.expect("a slot");
    cut.client = served.client().await;
    // The other worker gets the slot once the learner has noticed the end of the first connection.
    let plays_the_lost_slot = async {
        loop {
            let (order, episodes) = alive.take().await.expect("a slot");
            alive.deliver(order.slot, &episodes).await.expect("taken");
            if order.slot == lost.slot {
                break;
            }
        }
    };
    tokio::time::timeout(DEADLINE, plays_the_lost_slot).await.expect("in time");
    cut.take().await.expect("a slot, over the second connection");
    drop(cut);
    let played = async { while alive.play_one().await {} };
    tokio::time::timeout(DEADLINE, played).await.expect("every slot is to be had");
    seconds.store(15, Ordering::Relaxed);
    let ended = served.end().await.expect("a run");
    assert_eq!(Left::behind(&ended, directory.path()), expected);
}

/// Returns a clock that shows `seconds`.
pub(crate) fn clock_of(seconds: &Arc<AtomicU64>) -> Clock {
    let seconds = seconds.clone();
    Arc::new(move || Duration::from_secs(seconds.load(Ordering::Relaxed)))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_disconnected_worker_that_plays_beyond_the_end_receives_it() {
    let directory = tempfile::tempdir().expect("a directory");
    let (served, seconds) = served_by_hand_clock(directory.path()).await;
    let (mut cut, mut other) = (served.join("cut").await, served.join("other").await);
    let mut leaving = served.join("leaving").await;
    let (order, episodes) = cut.take().await.expect("a slot");
    // Its connection ends. The learner does not wait for the worker that leaves without a slot.
    cut.client = served.client().await;
    assert!(leaving.play_one().await);
    drop(leaving);
    while other.play_one().await {}
    // Far longer than the learner stays for those who have nothing to do.
    tokio::time::sleep(Duration::from_millis(500)).await;
    seconds.store(3, Ordering::Relaxed);
    cut.deliver(order.slot, &episodes).await.expect("the learner is still there");
    match cut.ask().await {
        Ok(Work::Finished(finished)) => assert!(!finished.interrupted, "{}", finished.reason),
        other => panic!("{other:?}"),
    }
    assert!(!served.end().await.expect("a run").interrupted);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_panic_of_the_learning_thread_ends_the_run_for_all_workers() {
    let directory = tempfile::tempdir().expect("a directory");
    let (broken, clock) = (Arc::new(AtomicBool::new(false)), real_clock());
    let breaks = broken.clone();
    let config = LearnerConfig {
        clock: Arc::new(move || {
            let is_learning = std::thread::current().name() == Some("learn");
            assert!(!(is_learning && breaks.load(Ordering::Relaxed)), "a bug, for a test");
            clock()
        }),
        ..learner_config(config(0), directory.path(), false)
    };
    let served = Served::start(config).await;
    let (mut toy, mut idle) = (served.join("toy").await, served.join("idle").await);
    // A watcher that never reads does not keep the process alive either.
    let watching = idle.client.clone().watch(pb::WatchRequest {}).await.expect("watched");
    let held: Vec<_> = [toy.take().await, idle.take().await].into_iter().flatten().collect();
    assert_eq!(held.len(), 2);
    broken.store(true, Ordering::Relaxed);
    let answer = tokio::time::timeout(DEADLINE, async {
        loop {
            match idle.ask().await {
                Ok(Work::Slot(_) | Work::Wait(_)) => {
                    tokio::time::sleep(Duration::from_millis(5)).await;
                }
                told => break told,
            }
        }
    });
    match answer.await.expect("the worker is told in time") {
        Ok(Work::Finished(finished)) => assert_eq!(finished.reason, "the learning thread panicked"),
        Ok(work) => panic!("{work:?}"),
        Err(_) => {}
    }
    let ended = served.end().await;
    assert!(matches!(ended, Err(Error::Panicked)), "{ended:?}");
    drop(watching);
}
