//! Workers whose connections end, and that may call again over another one; reports that arrive with a slot.

use super::*;

#[test]
fn joins_end_with_their_connection() {
    let mut queue = WorkQueue::default();
    queue.push(order(0, EpisodeKind::Training));
    let joined: Vec<u64> =
        (0..3).map(|_| queue.join("w".to_owned(), Some(7), at(0)).expect("room")).collect();
    let other = queue.join("w".to_owned(), Some(8), at(0)).expect("room");
    assert_eq!(next_slot(&mut queue, joined[0], at(0)), Some(0));
    assert_eq!(next_slot(&mut queue, joined[1], at(0)), None);
    assert_eq!(queue.remove_connection(7), [joined[0]], "it had a slot");
    assert_eq!(queue.next(joined[2], at(0)), Err(QueueError::UnknownWorker(joined[2])));
    assert_eq!(next_slot(&mut queue, other, at(0)), Some(0));
    // Those that were only cut off call again over another connection.
    assert_eq!(next_slot(&mut queue, joined[1], at(0)), None);
    assert_eq!(queue.submit(joined[0], 0, played(0), at(1)), Ok(true));
    assert_eq!(queue.remove_connection(7), [0; 0], "that is known");
    assert_eq!(queue.remove_connection(99), [0; 0], "a strange one");
}

#[test]
fn a_worker_that_calls_again_belongs_to_its_new_connection() {
    let mut queue = WorkQueue::default();
    (0..2).for_each(|number| queue.push(order(number, EpisodeKind::Training)));
    let worker = queue.join("w".to_owned(), Some(7), at(0)).expect("room");
    assert_eq!(next_slot(&mut queue, worker, at(0)), Some(0));
    // The end of the former connection is not noticed yet.
    queue.attach(worker, 8);
    assert_eq!(queue.worker(worker).expect("known").connection, Some(8));
    assert_eq!(next_slot(&mut queue, worker, at(1)), Some(0));
    assert_eq!(queue.remove_connection(7), [0; 0]);
    assert_eq!((queue.n_waiting(), queue.n_assigned()), (1, 1));
    assert_eq!(queue.remove_connection(8), [worker]);
    // It is noticed before the worker calls again.
    queue.attach(worker, 9);
    assert_eq!(next_slot(&mut queue, worker, at(2)), Some(0));
    assert_eq!(queue.remove_connection(9), [worker]);
    assert_eq!((queue.n_waiting(), queue.n_assigned()), (2, 0));
    queue.attach(99, 9);
    assert_eq!(queue.remove_connection(9), [0; 0], "a stranger belongs to none");
}

#[test]
fn a_worker_that_calls_over_another_connection_frees_its_place_on_the_former_one() {
    let (mut queue, workers) = crowded_connection();
    assert_eq!(queue.join("w".to_owned(), Some(1), at(0)), Err(JoinError::ConnectionFull));
    queue.attach(workers[0], 2);
    assert!(queue.join("w".to_owned(), Some(1), at(0)).is_ok(), "there is room for one");
    queue.attach(workers[0], 1);
    assert_eq!(queue.worker(workers[0]).expect("known").connection, None, "there is no room");
}

#[test]
fn a_new_connection_counts_the_workers_that_have_delivered_nothing() {
    let (mut queue, workers) = crowded_connection();
    assert_eq!(queue.submit(workers[0], 0, played(0), at(1)), Ok(true));
    queue.remove_connection(1);
    let crowd = MAX_UNPROVEN_PER_CONNECTION as u64;
    let mut join_over_2 = || queue.join("w".to_owned(), Some(2), at(1)).expect("room");
    let joined: Vec<u64> = (1..crowd).map(|_| join_over_2()).collect();
    for worker in joined {
        assert!(next_slot(&mut queue, worker, at(1)).is_some());
    }
    queue.attach(workers[0], 2);
    queue.attach(workers[1], 2);
    queue.attach(workers[2], 2);
    let connection =
        |queue: &WorkQueue, idx: usize| queue.worker(workers[idx]).expect("known").connection;
    assert_eq!(connection(&queue, 0), Some(2), "it has delivered");
    assert_eq!(connection(&queue, 1), Some(2), "there is room for one");
    assert_eq!(connection(&queue, 2), None);
    assert_eq!(queue.submit(workers[1], 1, played(1), at(1)), Ok(true));
    queue.attach(workers[2], 2);
    assert_eq!(connection(&queue, 2), Some(2));
}

#[test]
fn a_report_that_arrives_twice_with_a_slot_is_new_once() {
    let (mut queue, a, b) = queue_of(2);
    for (worker, slot, is_new) in
        [(a, 0, true), (a, 0, false), (b, 0, true), (b, 0, false), (a, 1, true), (99, 0, false)]
    {
        assert_eq!(queue.is_new_report(worker, slot), is_new, "slot {slot} of worker {worker}");
    }
}
