//! The queue of slots: assigns slots to workers, accepts each slot's episodes once, and reassigns the slots of silent
//! and slow workers.
//!
//! Pure: time is an argument. Assignments never affect a result: a slot that two workers play gives the same episodes
//! twice and counts once.

mod check;
mod connections;
mod worker;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

use tandem_core::work::SlotOrder;
use tandem_core::{AdviceUnit, Episode, EpisodeKind};

pub use check::{QueueError, check_count};
use check::{check, check_claims};
use connections::Connection;
pub use worker::{SilentWorker, Worker};

/// A worker that has not called for this time counts as dead: its slots return to the queue.
pub const SILENT_AFTER: Duration = Duration::from_secs(15);
/// A slot that has been assigned for this time, and for twice the recent mean but at most [`SILENT_AFTER`], gets a
/// backup, as in MapReduce: it is also assigned to an idle worker.
pub const BACKUP_AFTER: Duration = Duration::from_secs(3);
/// A worker that has not called for this time is removed. Its episodes still count if they arrive: it may have been
/// slow and not dead.
pub const FORGET_AFTER: Duration = Duration::from_secs(600);
/// Most workers in a run.
pub const MAX_WORKERS: usize = 10_000;
/// Most workers of one connection that have delivered no episodes: as many as can call over it at the same time.
pub const MAX_UNPROVEN_PER_CONNECTION: usize = 1024;
/// A worker that has not asked for work within this time after joining may be removed in favour of another.
pub const ASK_WITHIN: Duration = Duration::from_secs(1);

/// The slots of the open rounds and the workers that play them.
#[derive(Debug, Default)]
pub struct WorkQueue {
    next_slot: u64,
    /// Worker ids start after this number.
    first_worker: u64,
    /// The id of the latest worker.
    latest_worker: u64,
    waiting: VecDeque<SlotOrder>,
    assigned: BTreeMap<u64, Assignment>,
    /// Assigned slots by the time of their assignment: every idle worker asks for the first.
    assigned_since: BTreeSet<(Duration, u64)>,
    /// Moving average of the time that a slot takes, with weight 1/8 for the latest.
    mean_duration: Option<Duration>,
    finished: Vec<(SlotOrder, Vec<Episode>)>,
    workers: BTreeMap<u64, Worker>,
    /// The open connections, by number.
    connections: BTreeMap<u64, Connection>,
    /// Workers that have joined and not asked for work yet.
    newcomers: BTreeSet<u64>,
    /// Units of advice that open episodes can claim; an episode without an entry can claim a unit per step.
    claim_limits: BTreeMap<u64, u32>,
    /// The steps that a unit of advice pays for.
    advice_unit: AdviceUnit,
}

#[derive(Debug)]
struct Assignment {
    order: SlotOrder,
    worker: u64,
    since: Duration,
}

/// A refusal of a join.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum JoinError {
    /// The run has [`MAX_WORKERS`], and none of them can be removed.
    #[error("the run has {MAX_WORKERS} workers, the most that it can have")]
    RunFull,
    /// The connection has [`MAX_UNPROVEN_PER_CONNECTION`] workers that are playing and have delivered nothing.
    #[error(
        "{MAX_UNPROVEN_PER_CONNECTION} workers of this connection have delivered nothing, the most that it can have"
    )]
    ConnectionFull,
}

impl WorkQueue {
    /// Creates an empty queue whose worker ids start after `first_worker`.
    #[must_use]
    pub fn new(advice_unit: AdviceUnit, first_worker: u64) -> Self {
        Self { advice_unit, first_worker, latest_worker: first_worker, ..Self::default() }
    }

    /// Adds a worker that calls over `connection` and returns its number.
    ///
    /// A connection with too many workers that have delivered nothing loses the oldest of them that plays nothing. A
    /// full queue removes the oldest worker that has not asked for work within [`ASK_WITHIN`], otherwise the one that
    /// has been silent longest, otherwise one of the connection that has most workers without a delivery.
    ///
    /// # Errors
    /// When there are too many workers and none of them can be removed.
    pub fn join(
        &mut self,
        name: String,
        connection: Option<u64>,
        now: Duration,
    ) -> Result<u64, JoinError> {
        let n_unproven = connection.map_or(0, |connection| self.n_unproven(connection));
        if n_unproven >= MAX_UNPROVEN_PER_CONNECTION {
            let oldest = connection.and_then(|connection| self.oldest_idle(connection));
            self.remove_worker(oldest.ok_or(JoinError::ConnectionFull)?);
        }
        if self.workers.len() >= MAX_WORKERS {
            let removable = self.eviction_candidate(n_unproven, now);
            self.remove_worker(removable.ok_or(JoinError::RunFull)?);
        }
        self.latest_worker += 1;
        let worker = Worker {
            name,
            last_seen: now,
            n_episodes: 0,
            slot: None,
            reported_silent: false,
            connection: None,
            reported_slot: None,
        };
        self.workers.insert(self.latest_worker, worker);
        self.newcomers.insert(self.latest_worker);
        if let Some(connection) = connection {
            self.attach(self.latest_worker, connection);
        }
        Ok(self.latest_worker)
    }

    /// Removes a worker; its slot returns to the queue.
    fn remove_worker(&mut self, worker_id: u64) {
        if !self.newcomers.remove(&worker_id) {
            self.requeue_slots_of(worker_id);
        }
        self.detach(worker_id);
        self.workers.remove(&worker_id);
    }

    /// Records that a worker has delivered a slot, with `n_new` episodes that count.
    fn record_delivery(&mut self, worker_id: u64, slot: u64, n_new: usize) {
        self.newcomers.remove(&worker_id);
        let Some(worker) = self.workers.get_mut(&worker_id) else { return };
        worker.slot = worker.slot.filter(|given| *given != slot);
        let was_unproven = worker.n_episodes == 0;
        worker.n_episodes += n_new as u64;
        let connection = worker.connection.filter(|_| was_unproven && n_new > 0);
        if let Some(connection) = connection.and_then(|it| self.connections.get_mut(&it)) {
            connection.n_unproven -= 1;
        }
    }

    /// Returns true if a worker's report on environments that arrives with `slot` is new, and false if the call that
    /// brought it was repeated or the worker is not known any more.
    pub fn is_new_report(&mut self, worker_id: u64, slot: u64) -> bool {
        let worker = self.workers.get_mut(&worker_id);
        worker.is_some_and(|worker| worker.reported_slot.replace(slot) != Some(slot))
    }

    /// Limits the units of advice that episodes can claim, by episode number.
    pub fn limit_claims(&mut self, limits: impl IntoIterator<Item = (u64, u32)>) {
        self.claim_limits.extend(limits);
    }

    /// Lets open episodes claim a unit for each of their steps.
    pub fn lift_claim_limits(&mut self) {
        self.claim_limits.clear();
    }

    /// Adds a slot at the end of the queue and numbers it.
    pub fn push(&mut self, mut order: SlotOrder) {
        order.slot = self.next_slot;
        self.next_slot += 1;
        self.waiting.push_back(order);
    }

    /// Assigns the next slot to a worker; returns `None` if it has to wait.
    ///
    /// A worker that asks is not playing. It gets the slot again that it was assigned and did not deliver, with the
    /// former time of assignment, so a worker that never delivers holds a single slot.
    ///
    /// # Errors
    /// When the worker has not joined.
    pub fn next(&mut self, worker_id: u64, now: Duration) -> Result<Option<SlotOrder>, QueueError> {
        self.newcomers.remove(&worker_id);
        let own = self.touch(worker_id, now)?.slot.and_then(|slot| self.assigned.get(&slot));
        if let Some(own) = own.filter(|own| own.worker == worker_id) {
            return Ok(Some(own.order.clone()));
        }
        let order = self.pop().or_else(|| self.overdue_slot(now));
        if let Some(order) = &order {
            self.assign(order.clone(), worker_id, now);
        }
        if let Some(worker) = self.workers.get_mut(&worker_id) {
            worker.slot = order.as_ref().map(|order| order.slot);
        }
        Ok(order)
    }

    /// Records a call of a worker.
    fn touch(&mut self, worker_id: u64, now: Duration) -> Result<&Worker, QueueError> {
        let worker =
            self.workers.get_mut(&worker_id).ok_or(QueueError::UnknownWorker(worker_id))?;
        worker.last_seen = now;
        worker.reported_silent = false;
        Ok(worker)
    }

    /// Returns true if a worker has joined, even if it was removed since.
    fn has_joined(&self, worker_id: u64) -> bool {
        (self.first_worker + 1..=self.latest_worker).contains(&worker_id)
    }

    /// Removes the next slot from the queue. Training comes before evaluation, because the learner waits for it sooner.
    fn pop(&mut self) -> Option<SlotOrder> {
        let training = self.waiting.iter().position(|order| order.kind == EpisodeKind::Training);
        self.waiting.remove(training.unwrap_or(0))
    }

    fn assign(&mut self, order: SlotOrder, worker: u64, now: Duration) {
        let slot = order.slot;
        if let Some(former) = self.assigned.insert(slot, Assignment { order, worker, since: now }) {
            self.assigned_since.remove(&(former.since, slot));
        }
        self.assigned_since.insert((now, slot));
    }

    fn record_duration(&mut self, slot: u64, now: Duration) {
        if let Some(assignment) = self.assigned.get(&slot) {
            let duration = now.saturating_sub(assignment.since);
            let mean = self.mean_duration.map_or(duration, |mean| (7 * mean + duration) / 8);
            self.mean_duration = Some(mean);
        }
    }

    fn unassign(&mut self, slot: u64) -> Option<SlotOrder> {
        let assignment = self.assigned.remove(&slot)?;
        self.assigned_since.remove(&(assignment.since, slot));
        Some(assignment.order)
    }

    fn longest_assigned(&self) -> Option<&Assignment> {
        self.assigned_since.first().and_then(|(_, slot)| self.assigned.get(slot))
    }

    /// Returns the slot that has been assigned longest, if that is too long.
    fn overdue_slot(&self, now: Duration) -> Option<SlotOrder> {
        let longest = self.longest_assigned()?;
        let overdue = now.saturating_sub(longest.since) >= self.backup_after();
        overdue.then(|| longest.order.clone())
    }

    /// Returns the time until the next backup, unless the slot is delivered before; `None` if no slot is assigned.
    #[must_use]
    pub fn next_backup_in(&self, now: Duration) -> Option<Duration> {
        self.longest_assigned()
            .map(|longest| (longest.since + self.backup_after()).saturating_sub(now))
    }

    /// A worker that repeats the slot of one that is no slower than the others would be missing in the next round.
    fn backup_after(&self) -> Duration {
        (2 * self.mean_duration.unwrap_or_default()).clamp(BACKUP_AFTER, SILENT_AFTER)
    }

    /// Returns the order of `slot` for a worker that delivers it; `None` if it was delivered before. The worker may
    /// have been removed meanwhile.
    ///
    /// # Errors
    /// When the worker has never joined or there never was such a slot.
    pub fn order_of(
        &mut self,
        worker_id: u64,
        slot: u64,
        now: Duration,
    ) -> Result<Option<&SlotOrder>, QueueError> {
        if let Err(unknown) = self.touch(worker_id, now).map(drop)
            && !self.has_joined(worker_id)
        {
            return Err(unknown);
        }
        if slot >= self.next_slot {
            return Err(QueueError::UnknownSlot { slot, n_slots: self.next_slot });
        }
        let waiting = || self.waiting.iter().find(|order| order.slot == slot);
        Ok(self.assigned.get(&slot).map(|assignment| &assignment.order).or_else(waiting))
    }

    /// Accepts a slot's episodes and returns true if they are new; a slot that was delivered before changes nothing.
    ///
    /// # Errors
    /// When the worker has never joined, the slot is unknown, or the episodes do not match the order.
    pub fn submit(
        &mut self,
        worker_id: u64,
        slot: u64,
        episodes: Vec<Episode>,
        now: Duration,
    ) -> Result<bool, QueueError> {
        let ordered = self.order_of(worker_id, slot, now)?;
        let is_new = ordered.is_some();
        if let Some(order) = ordered {
            let order = order.clone();
            check(&order, self.advice_unit, &episodes)?;
            check_claims(&self.claim_limits, &order, &episodes)?;
        }
        self.record_delivery(worker_id, slot, if is_new { episodes.len() } else { 0 });
        self.record_duration(slot, now);
        let assigned = self.unassign(slot);
        let waiting = self.waiting.iter().position(|order| order.slot == slot);
        let order = assigned.or_else(|| self.waiting.remove(waiting?));
        self.finished.extend(order.map(|order| (order, episodes)));
        Ok(is_new)
    }

    /// Requeues the slots of silent workers and returns those workers. Removes silent workers that never asked for work,
    /// and workers that have been silent for [`FORGET_AFTER`].
    pub fn reclaim(&mut self, now: Duration) -> Vec<SilentWorker> {
        let never_came = |id: &&u64| self.is_silent(**id, now);
        let never_came: Vec<u64> = self.newcomers.iter().filter(never_came).copied().collect();
        never_came.into_iter().for_each(|id| self.remove_worker(id));
        let newly = |worker: &Worker| !worker.reported_silent && worker.is_silent(now);
        let silent: Vec<u64> =
            self.workers.iter().filter(|(_, worker)| newly(worker)).map(|(id, _)| *id).collect();
        let mut fell_silent = Vec::new();
        for worker_id in silent {
            let n_slots = self.requeue_slots_of(worker_id);
            if let Some(worker) = self.workers.get_mut(&worker_id) {
                worker.reported_silent = true;
                worker.slot = None;
                fell_silent.push(SilentWorker { worker_id, name: worker.name.clone(), n_slots });
            }
        }
        let is_gone = |worker: &Worker| now.saturating_sub(worker.last_seen) >= FORGET_AFTER;
        let gone: Vec<u64> =
            self.workers.iter().filter(|(_, worker)| is_gone(worker)).map(|(id, _)| *id).collect();
        gone.into_iter().for_each(|id| self.remove_worker(id));
        fell_silent
    }

    fn requeue_slots_of(&mut self, worker_id: u64) -> usize {
        let theirs = self.assigned.iter().filter(|(_, it)| it.worker == worker_id);
        let slots: Vec<u64> = theirs.map(|(slot, _)| *slot).collect();
        let orders: Vec<SlotOrder> =
            slots.into_iter().filter_map(|slot| self.unassign(slot)).collect();
        let n_slots = orders.len();
        if n_slots > 0 {
            self.waiting.extend(orders);
            self.waiting.make_contiguous().sort_by_key(|order| order.slot);
        }
        n_slots
    }

    /// Returns true if all slots of `kind` with parameter version `version` are delivered.
    #[must_use]
    pub fn is_complete(&self, kind: EpisodeKind, version: u64) -> bool {
        let open = |order: &SlotOrder| order.kind == kind && order.parameter_version == version;
        !self.waiting.iter().any(open)
            && !self.assigned.values().any(|assignment| open(&assignment.order))
    }

    /// Removes and returns the delivered episodes of `kind` with parameter version `version`, in episode order.
    pub fn take(&mut self, kind: EpisodeKind, version: u64) -> Vec<Episode> {
        let is_taken = |order: &SlotOrder| order.kind == kind && order.parameter_version == version;
        let taken = self.finished.extract_if(.., |(order, _)| is_taken(order));
        let mut episodes: Vec<Episode> = taken.flat_map(|(_, episodes)| episodes).collect();
        episodes.sort_by_key(|episode| episode.number);
        if kind == EpisodeKind::Training {
            for episode in &episodes {
                self.claim_limits.remove(&episode.number);
            }
        }
        episodes
    }

    /// Returns a worker.
    #[must_use]
    pub fn worker(&self, worker_id: u64) -> Option<&Worker> {
        self.workers.get(&worker_id)
    }

    /// Returns true if a worker counts as dead; an unknown one does.
    #[must_use]
    pub fn is_silent(&self, worker_id: u64, now: Duration) -> bool {
        self.worker(worker_id).is_none_or(|worker| worker.is_silent(now))
    }

    /// Returns the number of slots that wait for a worker.
    #[must_use]
    pub fn n_waiting(&self) -> usize {
        self.waiting.len()
    }

    /// Returns the number of assigned slots.
    #[must_use]
    pub fn n_assigned(&self) -> usize {
        self.assigned.len()
    }

    /// Returns the number of workers that do not count as dead.
    #[must_use]
    pub fn n_alive(&self, now: Duration) -> usize {
        self.workers.values().filter(|worker| !worker.is_silent(now)).count()
    }

    /// Returns the workers in the order of their numbers.
    pub fn workers(&self) -> impl Iterator<Item = (u64, &Worker)> {
        self.workers.iter().map(|(id, worker)| (*id, worker))
    }
}

#[cfg(test)]
mod tests;
