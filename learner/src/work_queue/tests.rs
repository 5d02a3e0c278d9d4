//! The queue by itself, and beside a model that keeps a plain list of slots.

mod lock_steps;
mod model;
mod reconnected;
mod removed;

use tandem_core::work::{EpisodeExploration, EpisodeOrder};
use tandem_core::{Layout, Task};

use super::*;

const fn at(seconds: u64) -> Duration {
    Duration::from_secs(seconds)
}

fn order(number: u64, kind: EpisodeKind) -> SlotOrder {
    let episode = EpisodeOrder {
        number,
        seed: 1,
        advised: false,
        exploration: EpisodeExploration::Noise,
        record: false,
        advised_steps: None,
    };
    SlotOrder { slot: 0, parameter_version: 0, kind, episodes: vec![episode] }
}

fn played(number: u64) -> Vec<Episode> {
    vec![Episode::zeros(Layout::new(Task::Push, 1), number)]
}

/// A queue with `n_slots` training slots of one episode each and two workers.
fn queue_of(n_slots: u64) -> (WorkQueue, u64, u64) {
    let mut queue = WorkQueue::default();
    (0..n_slots).for_each(|number| queue.push(order(number, EpisodeKind::Training)));
    let (a, b) = (join(&mut queue, at(0)), join(&mut queue, at(0)));
    (queue, a, b)
}

fn join(queue: &mut WorkQueue, now: Duration) -> u64 {
    queue.join("w".to_owned(), None, now).expect("there is room")
}

fn next_slot(queue: &mut WorkQueue, worker: u64, now: Duration) -> Option<u64> {
    queue.next(worker, now).expect("joined").map(|order| order.slot)
}

fn taken(queue: &mut WorkQueue) -> Vec<u64> {
    queue.take(EpisodeKind::Training, 0).iter().map(|episode| episode.number).collect()
}

#[test]
fn episodes_are_taken_in_order_regardless_of_arrival() {
    let (mut queue, a, b) = queue_of(2);
    assert_eq!(
        (next_slot(&mut queue, a, at(0)), next_slot(&mut queue, b, at(0))),
        (Some(0), Some(1))
    );
    assert_eq!(queue.submit(b, 1, played(1), at(1)), Ok(true));
    assert!(!queue.is_complete(EpisodeKind::Training, 0));
    assert_eq!(queue.submit(a, 0, played(0), at(1)), Ok(true));
    assert!(queue.is_complete(EpisodeKind::Training, 0));
    assert_eq!(taken(&mut queue), [0, 1]);
}

#[test]
fn a_disconnected_workers_slot_goes_to_the_next_worker_at_once() {
    let (mut queue, a, b) = queue_of(3);
    assert_eq!(
        (next_slot(&mut queue, a, at(0)), next_slot(&mut queue, b, at(0))),
        (Some(0), Some(1))
    );
    assert!(queue.release_slot(a));
    assert!(!queue.release_slot(a), "it has no other");
    assert_eq!(queue.submit(b, 1, played(1), at(1)), Ok(true));
    assert_eq!(next_slot(&mut queue, b, at(1)), Some(0), "before slot 2, which was never given");
    // It was only cut off, calls again and delivers: it is the first, and counts.
    assert_eq!(queue.submit(a, 0, played(0), at(2)), Ok(true));
    assert_eq!(queue.submit(b, 0, played(0), at(2)), Ok(false));
    assert!(!queue.release_slot(b), "what it had is in");
    assert!(!queue.release_slot(99), "a stranger");
}

#[test]
fn training_comes_before_evaluation() {
    let mut queue = WorkQueue::default();
    queue.push(order(0, EpisodeKind::Evaluation));
    queue.push(order(7, EpisodeKind::Training));
    let a = join(&mut queue, at(0));
    let first = queue.next(a, at(0)).expect("joined").expect("a slot");
    assert_eq!((first.slot, first.kind), (1, EpisodeKind::Training));
}

#[test]
fn a_slot_delivered_twice_counts_once() {
    let (mut queue, a, b) = queue_of(1);
    assert_eq!(next_slot(&mut queue, a, at(0)), Some(0));
    assert_eq!(next_slot(&mut queue, b, at(1)), None, "too early for a backup");
    assert_eq!(next_slot(&mut queue, b, at(4)), Some(0), "as a backup");
    assert_eq!(queue.submit(b, 0, played(0), at(5)), Ok(true));
    assert_eq!(queue.submit(a, 0, played(0), at(6)), Ok(false));
    assert_eq!(taken(&mut queue), [0]);
    assert_eq!(queue.submit(a, 0, played(0), at(7)), Ok(false), "its round is over");
    assert_eq!(taken(&mut queue), [0; 0]);
}

#[test]
fn a_dead_workers_slot_is_reassigned_after_three_seconds() {
    let (mut queue, a, b) = queue_of(1);
    next_slot(&mut queue, a, at(0));
    assert_eq!(
        queue.next_backup_in(Duration::from_millis(1200)),
        Some(Duration::from_millis(1800))
    );
    assert_eq!(queue.next_backup_in(at(9)), Some(Duration::ZERO));
    assert_eq!(next_slot(&mut queue, b, Duration::from_millis(2999)), None);
    assert_eq!(next_slot(&mut queue, b, BACKUP_AFTER), Some(0));
    assert_eq!(
        queue.next_backup_in(BACKUP_AFTER),
        Some(BACKUP_AFTER),
        "the backup has its own time"
    );
}

#[test]
fn slow_slots_are_reassigned_after_twice_their_mean_time() {
    let (mut queue, a, b) = queue_of(2);
    assert_eq!(
        (next_slot(&mut queue, a, at(0)), next_slot(&mut queue, b, at(0))),
        (Some(0), Some(1))
    );
    assert_eq!(queue.submit(a, 0, played(0), at(5)), Ok(true));
    assert_eq!(queue.next_backup_in(at(5)), Some(at(5)));
    assert_eq!(next_slot(&mut queue, a, at(9)), None, "the other is as slow as this one");
    assert_eq!(next_slot(&mut queue, a, at(10)), Some(1), "the other is slower");
}

#[test]
fn a_silent_workers_slots_return_to_the_queue() {
    let (mut queue, a, b) = queue_of(1);
    next_slot(&mut queue, a, at(0));
    next_slot(&mut queue, b, at(2));
    let silent = SilentWorker { worker_id: a, name: "w".into(), n_slots: 1 };
    assert_eq!(queue.reclaim(at(16)), [silent]);
    assert_eq!(queue.reclaim(at(16)), [], "reported once");
    assert_eq!(next_slot(&mut queue, b, at(16)), Some(0));
}

#[test]
fn a_worker_mistaken_for_dead_still_delivers_and_counts_once() {
    for someone_else_plays_it in [false, true] {
        let (mut queue, a, b) = queue_of(1);
        next_slot(&mut queue, a, at(0));
        next_slot(&mut queue, b, at(0));
        assert_eq!(queue.reclaim(at(20)).len(), 2);
        if someone_else_plays_it {
            assert_eq!(next_slot(&mut queue, b, at(20)), Some(0));
        }
        assert_eq!(queue.submit(a, 0, played(0), at(21)), Ok(true));
        assert!(queue.is_complete(EpisodeKind::Training, 0));
        assert_eq!(queue.submit(b, 0, played(0), at(22)), Ok(false));
        assert_eq!(taken(&mut queue), [0]);
        assert_eq!(next_slot(&mut queue, a, at(23)), None, "it is in the run again");
    }
}

#[test]
fn a_worker_that_never_delivers_holds_one_slot_for_a_short_time() {
    let (mut queue, bad, good) = queue_of(3);
    for millis in 0..3000 {
        assert_eq!(next_slot(&mut queue, bad, Duration::from_millis(millis)), Some(0));
    }
    for slot in [1, 2] {
        assert_eq!(next_slot(&mut queue, good, at(1)), Some(slot));
        assert_eq!(queue.submit(good, slot, played(slot), at(1)), Ok(true));
    }
    assert_eq!(next_slot(&mut queue, bad, BACKUP_AFTER), Some(0));
    assert_eq!(next_slot(&mut queue, good, BACKUP_AFTER), Some(0), "however often the other asks");
    assert_eq!(queue.submit(good, 0, played(0), at(4)), Ok(true));
    assert_eq!(taken(&mut queue), [0, 1, 2]);
}

#[test]
fn a_thousand_short_lived_workers_leave_no_state_behind() {
    let (mut queue, _, _) = queue_of(1000);
    for generation in 0..3 {
        let now = at(generation * 20);
        let ids: Vec<u64> = (0..1000).map(|_| join(&mut queue, now)).collect();
        for id in &ids {
            assert!(next_slot(&mut queue, *id, now).is_some());
        }
        let n_slots: usize =
            queue.reclaim(now + SILENT_AFTER).iter().map(|silent| silent.n_slots).sum();
        assert_eq!((n_slots, queue.waiting.len(), queue.assigned.len()), (1000, 1000, 0));
    }
    assert_eq!(queue.workers.len(), 3000, "without the two that never asked");
    queue.reclaim(at(40) + FORGET_AFTER);
    assert_eq!(queue.workers.len(), 0);
    let last = join(&mut queue, at(700));
    for slot in 0..1000 {
        assert_eq!(next_slot(&mut queue, last, at(700)), Some(slot));
        assert_eq!(queue.submit(last, slot, played(slot), at(700)), Ok(true));
    }
    assert_eq!(taken(&mut queue), (0..1000).collect::<Vec<_>>());
}

#[test]
fn a_live_worker_replaces_a_silent_one_in_a_full_run() {
    let mut queue = WorkQueue::default();
    queue.push(order(0, EpisodeKind::Training));
    let first = join(&mut queue, at(0));
    next_slot(&mut queue, first, at(0));
    for _ in 1..MAX_WORKERS {
        let worker = join(&mut queue, at(1));
        next_slot(&mut queue, worker, at(1));
    }
    assert_eq!(queue.join("w".to_owned(), None, at(2)), Err(JoinError::RunFull));
    let newest = join(&mut queue, at(0) + SILENT_AFTER);
    assert_eq!(queue.workers.len(), MAX_WORKERS);
    assert_eq!((queue.n_waiting(), queue.n_assigned()), (1, 0), "its slot is free at once");
    assert_eq!(queue.next(first, at(16)), Err(QueueError::UnknownWorker(first)));
    assert_eq!(next_slot(&mut queue, newest, at(16)), Some(0), "the forgotten worker's slot");
}

#[test]
fn workers_that_never_ask_for_work_are_replaced_after_a_second() {
    let mut queue = WorkQueue::default();
    for _ in 0..MAX_WORKERS {
        join(&mut queue, at(0));
    }
    let soon = ASK_WITHIN / 2;
    assert_eq!(queue.join("w".to_owned(), None, soon), Err(JoinError::RunFull));
    let honest = join(&mut queue, ASK_WITHIN);
    assert_eq!(queue.next(honest, at(2)), Ok(None));
    for _ in 1..MAX_WORKERS {
        join(&mut queue, at(2));
    }
    assert_eq!(queue.workers.len(), MAX_WORKERS);
    assert_eq!(queue.next(honest, at(3)), Ok(None), "a worker that asks stays");
    assert_eq!(queue.reclaim(at(20)).len(), 1, "of the others nothing is said");
    assert_eq!(queue.workers.len(), 1);
}

#[test]
fn one_connection_cannot_crowd_out_others() {
    let mut queue = WorkQueue::default();
    let mut join_over = |connection, now| {
        let worker = queue.join("w".to_owned(), Some(connection), now).expect("there is room");
        queue.next(worker, now).expect("joined");
        worker
    };
    let first = join_over(1, at(0));
    let honest = join_over(2, at(0));
    let mut last = first;
    for _ in 0..20_000 {
        last = join_over(1, at(0));
    }
    assert_eq!(queue.workers.len(), MAX_UNPROVEN_PER_CONNECTION + 1);
    assert_eq!(queue.next(first, at(0)), Err(QueueError::UnknownWorker(first)));
    assert_eq!(queue.next(last, at(0)), Ok(None));
    assert_eq!(queue.next(honest, at(0)), Ok(None));
}

/// Connection 1 with as many workers as may play over it without having delivered; the first has slot 0, and so on.
fn crowded_connection() -> (WorkQueue, Vec<u64>) {
    let mut queue = WorkQueue::default();
    (0..2000).for_each(|number| queue.push(order(number, EpisodeKind::Training)));
    let workers = (0..MAX_UNPROVEN_PER_CONNECTION as u64).map(|slot| {
        let worker = queue.join("w".to_owned(), Some(1), at(0)).expect("there is room");
        assert_eq!(next_slot(&mut queue, worker, at(0)), Some(slot));
        worker
    });
    let workers = workers.collect();
    (queue, workers)
}

#[test]
fn playing_workers_are_not_removed_for_others_of_their_connection() {
    let (mut queue, workers) = crowded_connection();
    assert_eq!(queue.join("w".to_owned(), Some(1), at(0)), Err(JoinError::ConnectionFull));
    assert!(queue.join("w".to_owned(), Some(2), at(0)).is_ok());
    assert_eq!(queue.submit(workers[0], 0, played(0), at(1)), Ok(true));
    assert!(queue.join("w".to_owned(), Some(1), at(1)).is_ok(), "one has delivered");
}

#[test]
fn a_worker_frees_one_place_on_its_connection_regardless_of_deliveries() {
    let (mut queue, workers) = crowded_connection();
    for _ in 0..2 {
        let slot = next_slot(&mut queue, workers[0], at(1)).expect("a slot");
        assert_eq!(queue.submit(workers[0], slot, played(slot), at(1)), Ok(true));
    }
    let newcomer = queue.join("w".to_owned(), Some(1), at(1)).expect("one has delivered");
    assert!(next_slot(&mut queue, newcomer, at(1)).is_some());
    assert_eq!(queue.join("w".to_owned(), Some(1), at(1)), Err(JoinError::ConnectionFull));
}

#[test]
fn a_worker_that_only_repeated_deliveries_counts_as_unproven() {
    let (mut queue, workers) = crowded_connection();
    let other = join(&mut queue, at(1));
    assert_eq!(queue.submit(other, 0, played(0), at(1)), Ok(true));
    assert_eq!(queue.submit(workers[0], 0, played(0), at(1)), Ok(false));
    assert!(queue.join("w".to_owned(), Some(1), at(1)).is_ok());
    assert_eq!(queue.next(workers[0], at(1)), Err(QueueError::UnknownWorker(workers[0])));
}

#[test]
fn removed_workers_free_their_places_on_the_connection() {
    let mut queue = WorkQueue::default();
    let mut join_one = |now| queue.join("w".to_owned(), Some(1), now).expect("there is room");
    let kept = join_one(at(0));
    for _ in 1..MAX_UNPROVEN_PER_CONNECTION {
        join_one(at(0));
    }
    assert_eq!(queue.next(kept, at(14)), Ok(None));
    queue.reclaim(at(15));
    assert_eq!(queue.workers.len(), 1, "the others never asked");
    for _ in 1..MAX_UNPROVEN_PER_CONNECTION {
        queue.join("w".to_owned(), Some(1), at(16)).expect("there is room");
    }
    assert_eq!(queue.next(kept, at(16)), Ok(None), "it did not have to make room");
}

#[test]
fn only_new_episodes_count_for_a_worker() {
    let (mut queue, a, b) = queue_of(3);
    let n_episodes = |queue: &WorkQueue, id| queue.worker(id).expect("known").n_episodes;
    for slot in 0..3 {
        assert_eq!(next_slot(&mut queue, a, at(0)), Some(slot));
        assert_eq!(n_episodes(&queue, a), slot);
        assert_eq!(queue.submit(a, slot, played(slot), at(0)), Ok(true));
        assert_eq!(queue.submit(b, slot, played(slot), at(0)), Ok(false));
    }
    assert_eq!((n_episodes(&queue, a), n_episodes(&queue, b)), (3, 0));
}

#[test]
fn a_silent_worker_is_listed_and_does_not_count_as_alive() {
    let (mut queue, a, b) = queue_of(0);
    assert_eq!(queue.n_alive(at(14)), 2);
    assert_eq!(queue.next(b, at(14)), Ok(None));
    assert_eq!(queue.n_alive(at(15)), 1);
    assert_eq!(queue.n_alive(at(29)), 0);
    let last_seen: Vec<_> = queue.workers().map(|(id, worker)| (id, worker.last_seen)).collect();
    assert_eq!(last_seen, [(a, at(0)), (b, at(14))]);
}

#[test]
fn a_disconnected_worker_does_not_return_a_reassigned_slot() {
    let (mut queue, a, b) = queue_of(1);
    next_slot(&mut queue, a, at(0));
    assert_eq!(next_slot(&mut queue, b, BACKUP_AFTER), Some(0), "as a backup");
    assert!(!queue.release_slot(a), "the slot is with the other");
    assert_eq!((queue.n_waiting(), queue.n_assigned()), (0, 1));
}

#[test]
fn a_worker_of_an_earlier_start_is_unknown() {
    let earlier = join(&mut WorkQueue::default(), at(0));
    let mut queue = WorkQueue::new(AdviceUnit::EnvStep, 4096);
    queue.push(order(0, EpisodeKind::Training));
    let later = join(&mut queue, at(0));
    for stranger in [earlier, 4096, later + 1] {
        let unknown = QueueError::UnknownWorker(stranger);
        assert_eq!(queue.next(stranger, at(0)), Err(unknown.clone()));
        assert_eq!(queue.submit(stranger, 0, played(0), at(0)), Err(unknown));
    }
    assert!(later > 4096, "{later}");
}

#[test]
fn a_full_queue_removes_a_worker_of_the_largest_connection() {
    let mut queue = WorkQueue::default();
    for n in 0..MAX_WORKERS {
        let connection = if n < 9_990 { n as u64 / 1000 } else { 100 + n as u64 };
        let worker = queue.join("w".to_owned(), Some(connection), at(0)).expect("there is room");
        queue.next(worker, at(0)).expect("joined");
    }
    for newcomer in 0..500 {
        let joined = queue.join("w".to_owned(), Some(50_000 + newcomer), at(1));
        assert!(joined.is_ok(), "newcomer {newcomer}: {joined:?}");
    }
    let mut alone = WorkQueue::default();
    for n in 0..MAX_WORKERS {
        let worker = alone.join("w".to_owned(), Some(n as u64), at(0)).expect("there is room");
        alone.next(worker, at(0)).expect("joined");
    }
    let refused = alone.join("w".to_owned(), Some(50_000), at(1));
    assert_eq!(refused, Err(JoinError::RunFull), "no connection has more than this one would have");
}

/// An advised training slot of one episode, and an episode that claims `charged` units with these arms advised.
fn advised(charged: u32, advised_arms: &[u8]) -> (SlotOrder, Vec<Episode>) {
    let mut ordered = order(0, EpisodeKind::Training);
    ordered.episodes[0].advised = true;
    let mut episodes = played(0);
    episodes[0].advice_charged = charged;
    episodes[0].advised_arms[..advised_arms.len()].copy_from_slice(advised_arms);
    (ordered, episodes)
}

#[test]
fn impossible_claims_of_advice_are_refused_by_name() {
    let check = |charged, arms: &[u8], expected: &str| {
        let (ordered, episodes) = advised(charged, arms);
        let mut queue = WorkQueue::default();
        queue.push(ordered);
        queue.limit_claims([(0, 3)]);
        let worker = join(&mut queue, at(0));
        next_slot(&mut queue, worker, at(0));
        let outcome = queue.submit(worker, 0, episodes.clone(), at(0)).map_err(|e| e.to_string());
        match expected {
            "" => assert_eq!(outcome, Ok(true), "{charged} for {arms:?}"),
            expected => assert_eq!(outcome, Err(format!("episode 0: advice_charged: {expected}"))),
        }
    };
    check(0, &[], "");
    check(3, &[1, 0, 1, 0, 1], "");
    check(50, &[], "expected 0, the steps with an advised arm, got 50");
    check(0, &[1, 1], "expected 2, the steps with an advised arm, got 0");
    check(2, &[1], "expected 1, the steps with an advised arm, got 2");
    check(4, &[1; 4], "expected at most 3, the units reserved for it, got 4");
}

#[test]
fn a_lease_limits_the_claim_of_its_episode_until_delivery() {
    let (ordered, episodes) = advised(4, &[1; 4]);
    let mut queue = WorkQueue::default();
    queue.push(ordered);
    queue.limit_claims([(0, 3)]);
    let worker = join(&mut queue, at(0));
    assert!(queue.submit(worker, 0, episodes.clone(), at(0)).is_err());
    queue.lift_claim_limits();
    assert_eq!(queue.submit(worker, 0, episodes, at(0)), Ok(true));
    queue.limit_claims([(0, 3)]);
    assert_eq!(taken(&mut queue), [0]);
    assert!(queue.claim_limits.is_empty(), "no limit outlives its episode");
}

#[test]
fn episodes_that_do_not_match_the_order_are_refused_by_name() {
    let (mut queue, a, _) = queue_of(1);
    assert_eq!(next_slot(&mut queue, a, at(0)), Some(0));
    let mut check = |slot, spoil: fn(&mut Vec<Episode>), message: &str| {
        let mut episodes = played(0);
        spoil(&mut episodes);
        let refusal = queue.submit(a, slot, episodes, at(0)).expect_err("must be refused");
        assert_eq!(refusal.to_string(), message);
        assert!(!queue.is_complete(EpisodeKind::Training, 0));
        assert_eq!(queue.take(EpisodeKind::Training, 0), []);
    };
    check(1, |_| (), "slot: expected one of the 1 that were ordered, got 1");
    check(
        u64::MAX,
        |_| (),
        &format!("slot: expected one of the 1 that were ordered, got {}", u64::MAX),
    );
    check(0, Vec::clear, "episodes: expected the 1 of slot 0, got 0");
    check(0, |all| all.extend(played(1)), "episodes: expected the 1 of slot 0, got 2");
    check(0, |all| all[0].number = 5, "episode 5: number: expected 0, got 5");
    check(
        0,
        |all| all[0].kind = EpisodeKind::Evaluation,
        "episode 0: kind: expected Training, got Evaluation",
    );
    check(0, |all| all[0].parameter_version = 9, "episode 0: parameter_version: expected 0, got 9");
    check(
        0,
        |all| all[0].advice_charged = 3,
        "episode 0: advice_charged: expected 0, as no advice was ordered, got 3",
    );
    check(
        0,
        |all| all[0].advised_arms[7] = 1,
        "episode 0: advised_arms: expected no advised arm, as no advice was ordered, got 0b00000001 on step 7",
    );
    assert_eq!(queue.submit(77, 0, played(0), at(0)), Err(QueueError::UnknownWorker(77)));
    assert_eq!(queue.submit(a, 0, played(0), at(0)), Ok(true), "the worker may try again");
}
