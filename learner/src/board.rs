//! Who plays what: hands slots to workers, takes episodes back once, covers for the silent and the slow.
//!
//! Pure: time comes in as an argument. Nothing here decides a result; a slot that two workers play gives the same
//! episodes twice and counts once.

mod check;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

use tandem_core::work::SlotOrder;
use tandem_core::{Episode, EpisodeKind};

pub use check::{SubmitError, check_count};
use check::{check, check_allowances};

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
/// Workers that have delivered nothing yet and may be known of one connection: as many as can ask over it at a time.
pub const MAX_UNPROVEN_PER_CONNECTION: usize = 1024;
/// A worker that has joined and has not asked for work for so long makes room for another when there is none.
pub const ASK_WITHIN: Duration = Duration::from_secs(1);

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
    /// The workers that joined over each connection that is open.
    connections: BTreeMap<u64, Connection>,
    /// Workers that have joined and have not asked for work yet.
    unasked: BTreeSet<u64>,
    /// Units of advice that open episodes can claim; those that are missing can claim a unit a step.
    allowances: BTreeMap<u64, u32>,
}

#[derive(Debug)]
struct Out {
    order: SlotOrder,
    worker: u64,
    since: Duration,
}

/// What is known of an open connection.
#[derive(Debug, Default)]
struct Connection {
    /// The workers that joined over it.
    workers: BTreeSet<u64>,
    /// How many of them have delivered nothing yet.
    n_unproven: usize,
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
    /// The connection over which it joined, while that is open.
    pub connection: Option<u64>,
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum JoinError {
    /// The run has [`MAX_WORKERS`], and none of them can make room.
    #[error("{MAX_WORKERS} workers are in the run, as many as there may be")]
    RunFull,
    /// The connection has [`MAX_UNPROVEN_PER_CONNECTION`] that play and have delivered nothing.
    #[error(
        "{MAX_UNPROVEN_PER_CONNECTION} workers of this connection have delivered nothing, as many as there may be"
    )]
    ConnectionFull,
}

impl Board {
    /// Takes in a worker that calls over `connection` and gives it a number.
    ///
    /// Workers that have joined and done nothing else make room for others: first those of the same connection, when it
    /// has too many, then those that do not ask for work, then those of the connection that has most of them.
    ///
    /// # Errors
    /// When there are too many workers and none of them can make room.
    pub fn join(
        &mut self,
        name: String,
        connection: Option<u64>,
        now: Duration,
    ) -> Result<u64, JoinError> {
        let n_unproven = connection.map_or(0, |connection| self.n_unproven(connection));
        if n_unproven >= MAX_UNPROVEN_PER_CONNECTION {
            let oldest = connection.and_then(|connection| self.oldest_idle(connection));
            self.forget(oldest.ok_or(JoinError::ConnectionFull)?);
        }
        if self.workers.len() >= MAX_WORKERS {
            let leaves = self.who_makes_room(n_unproven, now).ok_or(JoinError::RunFull)?;
            self.forget(leaves);
        }
        self.next_worker += 1;
        let worker =
            Worker { name, heard_at: now, n_episodes: 0, slot: None, silent: false, connection };
        self.workers.insert(self.next_worker, worker);
        self.unasked.insert(self.next_worker);
        if let Some(connection) = connection {
            let connection = self.connections.entry(connection).or_default();
            connection.workers.insert(self.next_worker);
            connection.n_unproven += 1;
        }
        Ok(self.next_worker)
    }

    /// Whom a full board forgets for a worker whose connection has `n_unproven` others that have delivered nothing.
    fn who_makes_room(&self, n_unproven: usize, now: Duration) -> Option<u64> {
        let does_not_ask = |id: &&u64| {
            self.worker(**id)
                .is_some_and(|worker| now.saturating_sub(worker.heard_at) >= ASK_WITHIN)
        };
        let longest_silent = || {
            let longest = self.workers.iter().min_by_key(|(_, worker)| worker.heard_at);
            longest.filter(|(_, worker)| is_silent(worker, now)).map(|(id, _)| *id)
        };
        let crowded = || {
            let counted = self.connections.iter().map(|(number, it)| (it.n_unproven, *number));
            counted.max().filter(|(n, _)| *n > n_unproven + 1).map(|(_, connection)| connection)
        };
        self.unasked
            .first()
            .filter(does_not_ask)
            .copied()
            .or_else(longest_silent)
            .or_else(|| self.oldest_idle(crowded()?))
    }

    fn n_unproven(&self, connection: u64) -> usize {
        self.connections.get(&connection).map_or(0, |connection| connection.n_unproven)
    }

    /// The oldest worker of a connection that has delivered nothing and plays nothing.
    fn oldest_idle(&self, connection: u64) -> Option<u64> {
        let is_idle = |worker: &Worker| worker.n_episodes == 0 && worker.slot.is_none();
        let theirs = &self.connections.get(&connection)?.workers;
        theirs.iter().find(|id| self.worker(**id).is_some_and(is_idle)).copied()
    }

    /// Forgets a worker; its slot goes back to the queue.
    fn forget(&mut self, worker_id: u64) {
        if !self.unasked.remove(&worker_id) {
            self.put_back_slots_of(worker_id);
        }
        let Some(Worker { connection: Some(number), n_episodes, .. }) =
            self.workers.remove(&worker_id)
        else {
            return;
        };
        if let Some(connection) = self.connections.get_mut(&number) {
            connection.workers.remove(&worker_id);
            connection.n_unproven -= usize::from(n_episodes == 0);
            if connection.workers.is_empty() {
                self.connections.remove(&number);
            }
        }
    }

    /// Notes what a worker has delivered.
    fn note_delivery(&mut self, worker_id: u64, slot: u64, n_new: usize) {
        self.unasked.remove(&worker_id);
        let Some(worker) = self.workers.get_mut(&worker_id) else { return };
        worker.slot = worker.slot.filter(|given| *given != slot);
        let was_unproven = worker.n_episodes == 0;
        worker.n_episodes += n_new as u64;
        let connection = worker.connection.filter(|_| was_unproven && n_new > 0);
        if let Some(connection) = connection.and_then(|it| self.connections.get_mut(&it)) {
            connection.n_unproven -= 1;
        }
    }

    /// Bounds the units of advice that episodes can claim.
    pub fn allow(&mut self, allowances: impl IntoIterator<Item = (u64, u32)>) {
        self.allowances.extend(allowances);
    }

    /// Lets open episodes claim a unit for each of their steps.
    pub fn lift_allowances(&mut self) {
        self.allowances.clear();
    }

    /// Gives workers the numbers after `first`.
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
        self.unasked.remove(&worker_id);
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
            let order = order.clone();
            check(&order, &episodes)?;
            check_allowances(&self.allowances, &order, &episodes)?;
        }
        self.note_delivery(worker_id, slot, if is_new { episodes.len() } else { 0 });
        self.note_how_long(slot, now);
        let out = self.take_back(slot);
        let waiting = self.waiting.iter().position(|order| order.slot == slot);
        let order = out.or_else(|| self.waiting.remove(waiting?));
        self.finished.extend(order.map(|order| (order, episodes)));
        Ok(is_new)
    }

    /// Puts the slots of silent workers back into the queue, in their order; gives the workers that fell silent. Those
    /// that never asked for work are forgotten.
    pub fn reclaim(&mut self, now: Duration) -> Vec<Silent> {
        let never_came = |id: &&u64| self.is_silent(**id, now);
        let never_came: Vec<u64> = self.unasked.iter().filter(never_came).copied().collect();
        never_came.into_iter().for_each(|id| self.forget(id));
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
        let is_gone = |worker: &Worker| now.saturating_sub(worker.heard_at) >= FORGET_AFTER;
        let gone: Vec<u64> =
            self.workers.iter().filter(|(_, worker)| is_gone(worker)).map(|(id, _)| *id).collect();
        gone.into_iter().for_each(|id| self.forget(id));
        fell_silent
    }

    /// Ends what depends on a connection that has ended; gives the workers whose slots go back to the queue. A worker
    /// that never asked for work is forgotten.
    pub fn connection_ended(&mut self, connection: u64) -> Vec<u64> {
        let theirs = self.connections.remove(&connection).unwrap_or_default();
        let mut gave_back = Vec::new();
        for worker_id in theirs.workers {
            if let Some(worker) = self.workers.get_mut(&worker_id) {
                worker.connection = None;
            }
            if self.unasked.contains(&worker_id) {
                self.forget(worker_id);
            } else if self.hung_up(worker_id) {
                gave_back.push(worker_id);
            }
        }
        gave_back
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
        let is_taken = |order: &SlotOrder| order.kind == kind && order.parameter_version == version;
        let taken = self.finished.extract_if(.., |(order, _)| is_taken(order));
        let mut episodes: Vec<Episode> = taken.flat_map(|(_, episodes)| episodes).collect();
        episodes.sort_by_key(|episode| episode.number);
        if kind == EpisodeKind::Training {
            for episode in &episodes {
                self.allowances.remove(&episode.number);
            }
        }
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

#[cfg(test)]
mod tests;
