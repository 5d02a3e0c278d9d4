//! The workers of a run, as the queue knows them.

use std::time::Duration;

/// A worker that has joined the run.
#[derive(Debug, Clone)]
pub struct Worker {
    /// Its label, which it chose itself.
    pub name: String,
    /// Time of its latest call.
    pub last_seen: Duration,
    /// Training and evaluation episodes that it has delivered.
    pub n_episodes: u64,
    /// The slot assigned to it last, until it delivers the episodes. A disconnected worker may still be playing it.
    pub slot: Option<u64>,
    /// True if it counts as dead.
    pub silent: bool,
    /// The connection over which it joined, or asked for work since, while that is open.
    pub connection: Option<u64>,
    /// The slot with which its latest report on environments arrived.
    pub reported_slot: Option<u64>,
}

/// A worker that counts as dead.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SilentWorker {
    /// Its number.
    pub worker_id: u64,
    /// Its label.
    pub name: String,
    /// The number of its slots that have returned to the queue.
    pub n_slots: usize,
}
