//! Who plays what: hands slots to workers, takes episodes back once, covers for the silent and the slow.
//!
//! Pure: time comes in as an argument. Nothing here decides a result; a slot that two workers play gives the same
//! episodes twice and counts once.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use tandem_core::work::SlotOrder;
use tandem_core::{Episode, EpisodeKind};

/// A worker that has not been heard of for so long counts as dead.
pub const SILENT_AFTER: Duration = Duration::from_secs(15);
/// A slot that is out for so long is given to a second worker that has nothing else to do.
pub const COVER_AFTER: Duration = Duration::from_secs(3);

/// The slots of the open rounds and the workers that play them.
#[derive(Debug, Default)]
pub struct Board {
    next_slot: u64,
    next_worker: u64,
    waiting: VecDeque<SlotOrder>,
    out: BTreeMap<u64, Out>,
    finished: Vec<(SlotOrder, Vec<Episode>)>,
    workers: BTreeMap<u64, Worker>,
}

#[derive(Debug)]
struct Out {
    order: SlotOrder,
    worker: u64,
    since: Duration,
}

/// What is known of a worker.
#[derive(Debug, Clone)]
pub struct Worker {
    /// The label it gave itself.
    pub name: String,
    /// When it was last heard of.
    pub heard_at: Duration,
    /// Training and evaluation episodes it has delivered.
    pub n_episodes: u64,
    /// The slot it plays.
    pub slot: Option<u64>,
}

/// A worker that counts as dead.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Silent {
    /// Its number.
    pub worker_id: u64,
    /// Its label.
    pub name: String,
    /// How many of its slots are given to others.
    pub n_slots: usize,
}

/// Why a worker's episodes are not taken.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SubmitError {
    /// The worker must join first.
    #[error("worker {0} is unknown here: join first")]
    UnknownWorker(u64),
    /// Not the episodes that the slot consists of.
    #[error("slot {slot} consists of episodes {expected:?} of version {version}, {got:?} came")]
    WrongEpisodes {
        /// The slot.
        slot: u64,
        /// The version that should have acted.
        version: u64,
        /// The numbers ordered.
        expected: Vec<u64>,
        /// The numbers that came.
        got: Vec<u64>,
    },
}

impl Board {
    /// Takes in a worker and gives it a number.
    pub fn join(&mut self, name: String, now: Duration) -> u64 {
        self.next_worker += 1;
        self.workers
            .insert(self.next_worker, Worker { name, heard_at: now, n_episodes: 0, slot: None });
        self.next_worker
    }

    /// Numbers workers from `first` on.
    pub const fn start_workers_at(&mut self, first: u64) {
        self.next_worker = first;
    }

    /// Adds a slot at the end of the queue; its number is given here.
    pub fn add(&mut self, mut order: SlotOrder) {
        order.slot = self.next_slot;
        self.next_slot += 1;
        self.waiting.push_back(order);
    }

    /// The next slot for a worker, if there is one; `None` for a worker means it must wait.
    ///
    /// # Errors
    /// When the worker has not joined.
    pub fn next(
        &mut self,
        worker_id: u64,
        now: Duration,
    ) -> Result<Option<SlotOrder>, SubmitError> {
        let worker =
            self.workers.get_mut(&worker_id).ok_or(SubmitError::UnknownWorker(worker_id))?;
        worker.heard_at = now;
        worker.slot = None;
        let order = self.pop().or_else(|| self.to_cover(worker_id, now));
        if let Some(order) = &order {
            self.out
                .insert(order.slot, Out { order: order.clone(), worker: worker_id, since: now });
            if let Some(worker) = self.workers.get_mut(&worker_id) {
                worker.slot = Some(order.slot);
            }
        }
        Ok(order)
    }

    /// The next slot in the queue; training comes before evaluation, so that the learner never waits for its own test.
    fn pop(&mut self) -> Option<SlotOrder> {
        let training = self.waiting.iter().position(|order| order.kind == EpisodeKind::Training);
        self.waiting.remove(training.unwrap_or(0))
    }

    /// The slot that has been out longest, when that is too long or its worker is gone or asks for more itself.
    fn to_cover(&self, worker_id: u64, now: Duration) -> Option<SlotOrder> {
        let oldest = self.out.values().min_by_key(|out| (out.since, out.order.slot))?;
        let overdue = now.saturating_sub(oldest.since) >= COVER_AFTER || oldest.worker == worker_id;
        overdue.then(|| oldest.order.clone())
    }

    /// Takes a slot's episodes; a slot that is in already changes nothing. Gives whether they are new.
    ///
    /// # Errors
    /// When the worker is unknown or the episodes are not the slot's.
    pub fn submit(
        &mut self,
        worker_id: u64,
        slot: u64,
        episodes: Vec<Episode>,
        now: Duration,
    ) -> Result<bool, SubmitError> {
        let worker =
            self.workers.get_mut(&worker_id).ok_or(SubmitError::UnknownWorker(worker_id))?;
        worker.heard_at = now;
        let Some(out) = self.out.get(&slot) else { return Ok(false) };
        let order = &out.order;
        let fits = episodes.len() == order.episodes.len()
            && episodes.iter().zip(&order.episodes).all(|(episode, ordered)| {
                episode.number == ordered.number
                    && episode.kind == order.kind
                    && episode.parameter_version == order.parameter_version
            });
        if !fits {
            return Err(SubmitError::WrongEpisodes {
                slot,
                version: order.parameter_version,
                expected: order.episodes.iter().map(|ordered| ordered.number).collect(),
                got: episodes.iter().map(|episode| episode.number).collect(),
            });
        }
        worker.n_episodes += episodes.len() as u64;
        worker.slot = None;
        if let Some(out) = self.out.remove(&slot) {
            self.finished.push((out.order, episodes));
        }
        Ok(true)
    }

    /// Puts the slots of silent workers back at the head of the queue; gives the workers that fell silent.
    pub fn reclaim(&mut self, now: Duration) -> Vec<Silent> {
        let is_silent = |worker: &Worker| now.saturating_sub(worker.heard_at) >= SILENT_AFTER;
        let silent: Vec<u64> = self
            .workers
            .iter()
            .filter(|(_, worker)| is_silent(worker))
            .map(|(id, _)| *id)
            .collect();
        let mut fell_silent = Vec::new();
        for id in &silent {
            let name = self.workers.remove(id).map(|worker| worker.name).unwrap_or_default();
            let theirs: Vec<u64> = self
                .out
                .iter()
                .filter(|(_, out)| out.worker == *id)
                .map(|(slot, _)| *slot)
                .collect();
            fell_silent.push(Silent { worker_id: *id, name, n_slots: theirs.len() });
            for slot in theirs {
                self.waiting.extend(self.out.remove(&slot).map(|out| out.order));
            }
        }
        self.waiting.make_contiguous().sort_by_key(|order| order.slot);
        fell_silent
    }

    /// Whether every slot of `kind` played with `version` is in.
    #[must_use]
    pub fn is_complete(&self, kind: EpisodeKind, version: u64) -> bool {
        let open = |order: &SlotOrder| order.kind == kind && order.parameter_version == version;
        !self.waiting.iter().any(open) && !self.out.values().any(|out| open(&out.order))
    }

    /// Takes out the finished episodes of `kind` played with `version`, in episode order.
    pub fn take(&mut self, kind: EpisodeKind, version: u64) -> Vec<Episode> {
        let taken = self
            .finished
            .extract_if(.., |(order, _)| order.kind == kind && order.parameter_version == version);
        let mut episodes: Vec<Episode> = taken.flat_map(|(_, episodes)| episodes).collect();
        episodes.sort_by_key(|episode| episode.number);
        episodes
    }

    /// The workers that are not silent, by number.
    pub fn workers(&self) -> impl Iterator<Item = (u64, &Worker)> {
        self.workers.iter().map(|(id, worker)| (*id, worker))
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::work::EpisodeOrder;
    use tandem_core::{Layout, Task};

    use super::*;
    use crate::replay::drifting_episode;

    const fn at(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    fn order(number: u64) -> SlotOrder {
        let episode =
            EpisodeOrder { number, seed: 1, advised: false, uniform: false, record: false };
        SlotOrder {
            slot: 0,
            parameter_version: 0,
            kind: EpisodeKind::Training,
            episodes: vec![episode],
        }
    }

    fn played(number: u64) -> Vec<Episode> {
        vec![drifting_episode(Layout::new(Task::Push, 1), number, 0.0)]
    }

    fn board_of(n_slots: u64) -> (Board, u64, u64) {
        let mut board = Board::default();
        (0..n_slots).for_each(|number| board.add(order(number)));
        let (a, b) = (board.join("a".into(), at(0)), board.join("b".into(), at(0)));
        (board, a, b)
    }

    #[test]
    fn episodes_come_back_in_order_whoever_was_first() {
        let (mut board, a, b) = board_of(2);
        let first = board.next(a, at(0)).expect("joined").expect("a slot").slot;
        let second = board.next(b, at(0)).expect("joined").expect("a slot").slot;
        assert_eq!(board.submit(b, second, played(1), at(1)), Ok(true));
        assert!(!board.is_complete(EpisodeKind::Training, 0));
        assert_eq!(board.submit(a, first, played(0), at(1)), Ok(true));
        assert!(board.is_complete(EpisodeKind::Training, 0));
        let numbers: Vec<u64> =
            board.take(EpisodeKind::Training, 0).iter().map(|e| e.number).collect();
        assert_eq!(numbers, [0, 1]);
    }

    #[test]
    fn a_slot_that_comes_twice_counts_once() {
        let (mut board, a, b) = board_of(1);
        let slot = board.next(a, at(0)).expect("joined").expect("a slot").slot;
        assert_eq!(board.next(b, at(1)), Ok(None), "too early to cover");
        assert_eq!(board.next(b, at(4)).expect("joined").expect("covers").slot, slot);
        assert_eq!(board.submit(b, slot, played(0), at(5)), Ok(true));
        assert_eq!(board.submit(a, slot, played(0), at(6)), Ok(false));
        assert_eq!(board.take(EpisodeKind::Training, 0).len(), 1);
    }

    #[test]
    fn a_silent_workers_slots_go_back_to_the_queue() {
        let (mut board, a, b) = board_of(1);
        let slot = board.next(a, at(0)).expect("joined").expect("a slot").slot;
        assert_eq!(board.next(b, at(14)).map(|order| order.is_some()), Ok(true), "covered before");
        let (mut board, a2, b2) = board_of(1);
        assert_eq!(board.next(a2, at(0)).expect("joined").expect("a slot").slot, slot);
        board.next(b2, at(2)).expect("joined");
        let silent = Silent { worker_id: a2, name: "a".into(), n_slots: 1 };
        assert_eq!(board.reclaim(at(16)), [silent]);
        assert_eq!(board.next(a2, at(16)), Err(SubmitError::UnknownWorker(a2)));
        assert_eq!(board.next(b2, at(16)).expect("joined").expect("the slot").slot, slot);
        assert_eq!(a, a2);
    }

    #[test]
    fn a_worker_that_asks_again_gets_its_own_lost_slot() {
        let (mut board, a, _) = board_of(1);
        let slot = board.next(a, at(0)).expect("joined").expect("a slot").slot;
        assert_eq!(board.next(a, at(0)).expect("joined").expect("the same").slot, slot);
    }

    #[test]
    fn other_episodes_than_ordered_are_refused() {
        let (mut board, a, _) = board_of(1);
        let slot = board.next(a, at(0)).expect("joined").expect("a slot").slot;
        assert!(matches!(
            board.submit(a, slot, played(5), at(0)),
            Err(SubmitError::WrongEpisodes { .. })
        ));
        assert!(!board.is_complete(EpisodeKind::Training, 0));
    }
}
