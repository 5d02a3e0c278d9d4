//! Who plays what: hands slots to workers, takes episodes back once, covers for the silent and the slow.
//!
//! Pure: time comes in as an argument. Nothing here decides a result; a slot that two workers play gives the same
//! episodes twice and counts once.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

use tandem_core::work::{EpisodeOrder, SlotOrder};
use tandem_core::{Episode, EpisodeKind};

/// A worker that has not been heard of for so long counts as dead: its slots go back to the queue.
pub const SILENT_AFTER: Duration = Duration::from_secs(15);
/// A slot that is out for so long, and for twice as long as slots took of late, is given to a second worker that has
/// nothing else to do.
pub const COVER_AFTER: Duration = Duration::from_secs(3);
/// A worker that has not been heard of for so long is no longer known. Until then what it delivers counts: it may have
/// been slow and not dead.
pub const FORGET_AFTER: Duration = Duration::from_secs(600);
/// Workers that may be known at a time.
pub const MAX_WORKERS: usize = 10_000;

/// The slots of the open rounds and the workers that play them.
#[derive(Debug, Default)]
pub struct Board {
    next_slot: u64,
    next_worker: u64,
    waiting: VecDeque<SlotOrder>,
    out: BTreeMap<u64, Out>,
    /// Since when each slot is out, the longest first: every worker that waits asks for it.
    out_since: BTreeSet<(Duration, u64)>,
    /// How long slots took of late: an average that moves an eighth of the way with each.
    took: Option<Duration>,
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
    /// The slot it was given last, until it delivers it.
    pub slot: Option<u64>,
    /// Whether it counts as dead.
    pub silent: bool,
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

/// Why a worker is not taken in.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{MAX_WORKERS} workers are in the run, as many as there may be")]
pub struct TooManyWorkers;

/// Why a worker's episodes are not taken. Nothing of them is used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SubmitError {
    /// The worker must join first.
    #[error("worker {0} is unknown here: join first")]
    UnknownWorker(u64),
    /// Nobody was given such a slot.
    #[error("slot: expected one of the {n_slots} that were ordered, got {slot}")]
    UnknownSlot {
        /// What came.
        slot: u64,
        /// Slots ordered so far.
        n_slots: u64,
    },
    /// More or fewer episodes than the slot has.
    #[error("episodes: expected the {expected} of slot {slot}, got {got}")]
    WrongCount {
        /// The slot.
        slot: u64,
        /// Episodes ordered.
        expected: usize,
        /// Episodes that came.
        got: usize,
    },
    /// An episode that was not ordered so.
    #[error("episode {number}: {field}: expected {expected}, got {got}")]
    WrongEpisode {
        /// The episode's number as it came.
        number: u64,
        /// What of it was not ordered.
        field: &'static str,
        /// What was ordered.
        expected: String,
        /// What came.
        got: String,
    },
}

impl Board {
    /// Takes in a worker and gives it a number.
    ///
    /// # Errors
    /// When there are [`MAX_WORKERS`], none of them silent.
    pub fn join(&mut self, name: String, now: Duration) -> Result<u64, TooManyWorkers> {
        if self.workers.len() >= MAX_WORKERS {
            self.forget_the_longest_silent(now)?;
        }
        self.next_worker += 1;
        let worker = Worker { name, heard_at: now, n_episodes: 0, slot: None, silent: false };
        self.workers.insert(self.next_worker, worker);
        Ok(self.next_worker)
    }

    fn forget_the_longest_silent(&mut self, now: Duration) -> Result<(), TooManyWorkers> {
        let longest = self.workers.iter().min_by_key(|(_, worker)| worker.heard_at);
        let (id, _) = longest.filter(|(_, worker)| is_silent(worker, now)).ok_or(TooManyWorkers)?;
        let id = *id;
        self.put_back_slots_of(id);
        self.workers.remove(&id);
        Ok(())
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
    /// A worker that asks plays nothing. What it was given before and did not deliver is given to it again, so that
    /// one that never delivers holds a single slot, and counts as out since it was first given.
    ///
    /// # Errors
    /// When the worker has not joined.
    pub fn next(
        &mut self,
        worker_id: u64,
        now: Duration,
    ) -> Result<Option<SlotOrder>, SubmitError> {
        let own = self.heard(worker_id, now)?.slot.and_then(|slot| self.out.get(&slot));
        if let Some(own) = own.filter(|out| out.worker == worker_id) {
            return Ok(Some(own.order.clone()));
        }
        let order = self.pop().or_else(|| self.to_cover(now));
        if let Some(order) = &order {
            self.hand_out(order.clone(), worker_id, now);
        }
        if let Some(worker) = self.workers.get_mut(&worker_id) {
            worker.slot = order.as_ref().map(|order| order.slot);
        }
        Ok(order)
    }

    /// Notes that a worker lives.
    fn heard(&mut self, worker_id: u64, now: Duration) -> Result<&Worker, SubmitError> {
        let worker =
            self.workers.get_mut(&worker_id).ok_or(SubmitError::UnknownWorker(worker_id))?;
        worker.heard_at = now;
        worker.silent = false;
        Ok(worker)
    }

    /// The next slot in the queue; training comes before evaluation, so that the learner never waits for its own test.
    fn pop(&mut self) -> Option<SlotOrder> {
        let training = self.waiting.iter().position(|order| order.kind == EpisodeKind::Training);
        self.waiting.remove(training.unwrap_or(0))
    }

    fn hand_out(&mut self, order: SlotOrder, worker: u64, now: Duration) {
        let slot = order.slot;
        if let Some(former) = self.out.insert(slot, Out { order, worker, since: now }) {
            self.out_since.remove(&(former.since, slot));
        }
        self.out_since.insert((now, slot));
    }

    fn note_how_long(&mut self, slot: u64, now: Duration) {
        if let Some(out) = self.out.get(&slot) {
            let took = now.saturating_sub(out.since);
            self.took = Some(self.took.map_or(took, |before| (7 * before + took) / 8));
        }
    }

    fn take_back(&mut self, slot: u64) -> Option<SlotOrder> {
        let out = self.out.remove(&slot)?;
        self.out_since.remove(&(out.since, slot));
        Some(out.order)
    }

    fn longest_out(&self) -> Option<&Out> {
        self.out_since.first().and_then(|(_, slot)| self.out.get(slot))
    }

    /// The slot that has been out longest, when that is too long.
    fn to_cover(&self, now: Duration) -> Option<SlotOrder> {
        let longest = self.longest_out()?;
        let overdue = now.saturating_sub(longest.since) >= self.cover_after();
        overdue.then(|| longest.order.clone())
    }

    /// In what time there is a slot to cover for, unless it is delivered before; `None` when no slot is out.
    #[must_use]
    pub fn cover_in(&self, now: Duration) -> Option<Duration> {
        self.longest_out().map(|out| (out.since + self.cover_after()).saturating_sub(now))
    }

    /// A worker that covers for one that is only as slow as all others would be missed in the next round.
    fn cover_after(&self) -> Duration {
        (2 * self.took.unwrap_or_default()).clamp(COVER_AFTER, SILENT_AFTER)
    }

    /// What `slot` consists of, for a worker that delivers it; `None` when it is in already.
    ///
    /// # Errors
    /// When the worker is unknown or there never was such a slot.
    pub fn ordered(
        &mut self,
        worker_id: u64,
        slot: u64,
        now: Duration,
    ) -> Result<Option<&SlotOrder>, SubmitError> {
        self.heard(worker_id, now)?;
        if slot >= self.next_slot {
            return Err(SubmitError::UnknownSlot { slot, n_slots: self.next_slot });
        }
        let waiting = || self.waiting.iter().find(|order| order.slot == slot);
        Ok(self.out.get(&slot).map(|out| &out.order).or_else(waiting))
    }

    /// Takes a slot's episodes; a slot that is in already changes nothing. Gives whether they are new.
    ///
    /// # Errors
    /// When the worker or the slot is unknown or the episodes are not the slot's.
    pub fn submit(
        &mut self,
        worker_id: u64,
        slot: u64,
        episodes: Vec<Episode>,
        now: Duration,
    ) -> Result<bool, SubmitError> {
        let ordered = self.ordered(worker_id, slot, now)?;
        let is_new = ordered.is_some();
        if let Some(order) = ordered {
            check(order, &episodes)?;
        }
        if let Some(worker) = self.workers.get_mut(&worker_id) {
            worker.slot = worker.slot.filter(|given| *given != slot);
            worker.n_episodes += if is_new { episodes.len() as u64 } else { 0 };
        }
        self.note_how_long(slot, now);
        let out = self.take_back(slot);
        let waiting = self.waiting.iter().position(|order| order.slot == slot);
        let order = out.or_else(|| self.waiting.remove(waiting?));
        self.finished.extend(order.map(|order| (order, episodes)));
        Ok(is_new)
    }

    /// Puts the slots of silent workers back into the queue, in their order; gives the workers that fell silent.
    pub fn reclaim(&mut self, now: Duration) -> Vec<Silent> {
        let newly = |worker: &Worker| !worker.silent && is_silent(worker, now);
        let silent: Vec<u64> =
            self.workers.iter().filter(|(_, worker)| newly(worker)).map(|(id, _)| *id).collect();
        let mut fell_silent = Vec::new();
        for worker_id in silent {
            let n_slots = self.put_back_slots_of(worker_id);
            if let Some(worker) = self.workers.get_mut(&worker_id) {
                worker.silent = true;
                worker.slot = None;
                fell_silent.push(Silent { worker_id, name: worker.name.clone(), n_slots });
            }
        }
        self.workers.retain(|_, worker| now.saturating_sub(worker.heard_at) < FORGET_AFTER);
        fell_silent
    }

    /// Puts the slot of a worker whose connection has ended back into the queue, in its place, and gives whether it had
    /// one. The worker stays known: it may call again, and what it delivers counts.
    pub fn hung_up(&mut self, worker_id: u64) -> bool {
        self.workers.get_mut(&worker_id).is_some_and(|worker| worker.slot.take().is_some())
            && self.put_back_slots_of(worker_id) > 0
    }

    fn put_back_slots_of(&mut self, worker_id: u64) -> usize {
        let theirs = self.out.iter().filter(|(_, out)| out.worker == worker_id);
        let slots: Vec<u64> = theirs.map(|(slot, _)| *slot).collect();
        let orders: Vec<SlotOrder> =
            slots.into_iter().filter_map(|slot| self.take_back(slot)).collect();
        let n_slots = orders.len();
        if n_slots > 0 {
            self.waiting.extend(orders);
            self.waiting.make_contiguous().sort_by_key(|order| order.slot);
        }
        n_slots
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

    /// What is known of a worker.
    #[must_use]
    pub fn worker(&self, worker_id: u64) -> Option<&Worker> {
        self.workers.get(&worker_id)
    }

    /// Whether a worker counts as dead; one that is not known does.
    #[must_use]
    pub fn is_silent(&self, worker_id: u64, now: Duration) -> bool {
        self.worker(worker_id).is_none_or(|worker| is_silent(worker, now))
    }

    /// Slots that wait for a worker.
    #[must_use]
    pub fn n_waiting(&self) -> usize {
        self.waiting.len()
    }

    /// Slots that a worker has and has not delivered.
    #[must_use]
    pub fn n_out(&self) -> usize {
        self.out.len()
    }

    /// Workers that do not count as dead.
    #[must_use]
    pub fn n_alive(&self, now: Duration) -> usize {
        self.workers.values().filter(|worker| !is_silent(worker, now)).count()
    }

    /// The workers that are known, by number.
    pub fn workers(&self) -> impl Iterator<Item = (u64, &Worker)> {
        self.workers.iter().map(|(id, worker)| (*id, worker))
    }
}

fn is_silent(worker: &Worker, now: Duration) -> bool {
    now.saturating_sub(worker.heard_at) >= SILENT_AFTER
}

/// Refuses a number of episodes that is not the slot's.
///
/// # Errors
/// When it is another.
pub fn check_count(order: &SlotOrder, got: usize) -> Result<(), SubmitError> {
    let expected = order.episodes.len();
    if got == expected {
        return Ok(());
    }
    Err(SubmitError::WrongCount { slot: order.slot, expected, got })
}

fn check(order: &SlotOrder, episodes: &[Episode]) -> Result<(), SubmitError> {
    check_count(order, episodes.len())?;
    episodes
        .iter()
        .zip(&order.episodes)
        .try_for_each(|(episode, ordered)| check_episode(order, ordered, episode))
}

fn check_episode(
    order: &SlotOrder,
    ordered: &EpisodeOrder,
    episode: &Episode,
) -> Result<(), SubmitError> {
    let refuse = |field, expected: String, got: String| {
        Err(SubmitError::WrongEpisode { number: episode.number, field, expected, got })
    };
    let (number, version) = (episode.number, episode.parameter_version);
    if number != ordered.number {
        return refuse("number", ordered.number.to_string(), number.to_string());
    }
    if episode.kind != order.kind {
        return refuse("kind", format!("{:?}", order.kind), format!("{:?}", episode.kind));
    }
    if version != order.parameter_version {
        let expected = order.parameter_version.to_string();
        return refuse("parameter_version", expected, version.to_string());
    }
    if !ordered.advised && episode.advice_charged > 0 {
        let expected = "0, as nobody was to be asked".to_owned();
        return refuse("advice_charged", expected, episode.advice_charged.to_string());
    }
    Ok(())
}

#[cfg(test)]
mod tests;
