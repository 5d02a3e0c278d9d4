//! Workers that deliver after they were removed.

use super::*;

#[test]
fn a_slot_that_takes_longer_than_its_worker_is_remembered_counts_once() {
    for someone_else_plays_it in [false, true] {
        let (mut queue, slow, other) = queue_of(1);
        assert_eq!(next_slot(&mut queue, slow, at(0)), Some(0));
        queue.reclaim(at(20));
        queue.reclaim(FORGET_AFTER);
        assert_eq!(queue.workers.len(), 0);
        let now = FORGET_AFTER + at(1);
        assert_eq!(queue.next(slow, now), Err(QueueError::UnknownWorker(slow)));
        let third = join(&mut queue, now);
        if someone_else_plays_it {
            assert_eq!(next_slot(&mut queue, third, now), Some(0));
        }
        assert_eq!(queue.submit(slow, 0, played(0), now), Ok(true));
        assert!(queue.is_complete(EpisodeKind::Training, 0));
        assert_eq!(queue.submit(third, 0, played(0), now), Ok(false));
        assert_eq!(queue.submit(other, 0, played(0), now), Ok(false));
        assert_eq!(taken(&mut queue), [0]);
        assert_eq!(queue.workers.len(), 1, "a delivery is no new membership");
    }
}

#[test]
fn episodes_of_a_removed_worker_are_checked_like_those_of_others() {
    let (mut queue, slow, _) = queue_of(1);
    assert_eq!(next_slot(&mut queue, slow, at(0)), Some(0));
    queue.reclaim(at(20));
    queue.reclaim(FORGET_AFTER);
    let refused = queue.submit(slow, 0, played(5), FORGET_AFTER).expect_err("another episode");
    assert_eq!(refused.to_string(), "episode 5: number: expected 0, got 5");
    assert_eq!(queue.submit(slow, 0, played(0), FORGET_AFTER), Ok(true));
}
