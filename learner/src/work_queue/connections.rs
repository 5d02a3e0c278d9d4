//! The connections over which workers call: their limits, and the consequences of their ends.

use std::collections::BTreeSet;
use std::time::Duration;

use super::{ASK_WITHIN, MAX_UNPROVEN_PER_CONNECTION, WorkQueue, Worker};

/// An open connection.
#[derive(Debug, Default)]
pub(super) struct Connection {
    /// The workers that call over it.
    pub(super) workers: BTreeSet<u64>,
    /// The number of these that have delivered no episodes.
    pub(super) n_unproven: usize,
}

impl WorkQueue {
    /// Records that a worker calls over `connection`: one that joins, or that was cut off and calls again, perhaps
    /// before the learner notices the end of its former connection. A connection with [`MAX_UNPROVEN_PER_CONNECTION`]
    /// gets no further ones.
    pub fn attach(&mut self, worker_id: u64, connection: u64) {
        if self.worker(worker_id).is_some_and(|worker| worker.connection == Some(connection)) {
            return;
        }
        self.detach(worker_id);
        let is_full = self.n_unproven(connection) >= MAX_UNPROVEN_PER_CONNECTION;
        let Some(worker) = self.workers.get_mut(&worker_id) else { return };
        let is_unproven = worker.n_episodes == 0;
        if is_unproven && is_full {
            return;
        }
        worker.connection = Some(connection);
        let connection = self.connections.entry(connection).or_default();
        connection.workers.insert(worker_id);
        connection.n_unproven += usize::from(is_unproven);
    }

    /// Removes a worker from its connection, if it has one.
    pub(super) fn detach(&mut self, worker_id: u64) {
        let Some(worker) = self.workers.get_mut(&worker_id) else { return };
        let is_unproven = worker.n_episodes == 0;
        let Some(number) = worker.connection.take() else { return };
        let Some(connection) = self.connections.get_mut(&number) else { return };
        connection.workers.remove(&worker_id);
        connection.n_unproven -= usize::from(is_unproven);
        if connection.workers.is_empty() {
            self.connections.remove(&number);
        }
    }

    /// Returns the worker that a full queue removes for a worker whose connection has `n_unproven` others that have
    /// delivered nothing.
    pub(super) fn eviction_candidate(&self, n_unproven: usize, now: Duration) -> Option<u64> {
        let does_not_ask = |id: &&u64| {
            self.worker(**id)
                .is_some_and(|worker| now.saturating_sub(worker.last_seen) >= ASK_WITHIN)
        };
        let longest_silent = || {
            let longest = self.workers.iter().min_by_key(|(_, worker)| worker.last_seen);
            longest.filter(|(_, worker)| worker.is_silent(now)).map(|(id, _)| *id)
        };
        let crowded = || {
            let counted = self.connections.iter().map(|(number, it)| (it.n_unproven, *number));
            counted.max().filter(|(n, _)| *n > n_unproven + 1).map(|(_, connection)| connection)
        };
        self.newcomers
            .first()
            .filter(does_not_ask)
            .copied()
            .or_else(longest_silent)
            .or_else(|| self.oldest_idle(crowded()?))
    }

    pub(super) fn n_unproven(&self, connection: u64) -> usize {
        self.connections.get(&connection).map_or(0, |connection| connection.n_unproven)
    }

    /// Returns the oldest worker of a connection that has delivered nothing and plays nothing.
    pub(super) fn oldest_idle(&self, connection: u64) -> Option<u64> {
        let is_idle = |worker: &Worker| worker.n_episodes == 0 && worker.slot.is_none();
        let theirs = &self.connections.get(&connection)?.workers;
        theirs.iter().find(|id| self.worker(**id).is_some_and(is_idle)).copied()
    }

    /// Removes a closed connection, and its workers that never asked for work. Returns the workers whose slots have
    /// returned to the queue.
    pub fn remove_connection(&mut self, connection: u64) -> Vec<u64> {
        let theirs = self.connections.remove(&connection).unwrap_or_default();
        let mut requeued = Vec::new();
        for worker_id in theirs.workers {
            if let Some(worker) = self.workers.get_mut(&worker_id) {
                worker.connection = None;
            }
            if self.newcomers.contains(&worker_id) {
                self.remove_worker(worker_id);
            } else if self.release_slot(worker_id) {
                requeued.push(worker_id);
            }
        }
        requeued
    }

    /// Requeues the slot of a disconnected worker; returns true if it had one. The worker stays: it may call again, and
    /// the episodes that it delivers count.
    pub(super) fn release_slot(&mut self, worker_id: u64) -> bool {
        self.worker(worker_id).is_some_and(|worker| worker.slot.is_some())
            && self.requeue_slots_of(worker_id) > 0
    }
}
