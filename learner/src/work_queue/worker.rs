//! The workers of a run, as the queue knows them.

use std::time::Duration;

use super::SILENT_AFTER;

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
    /// True from its report as silent until its next call.
    pub reported_silent: bool,
    /// The connection over which it joined or last asked for work, while that is open.
    pub connection: Option<u64>,
    /// The slot with which its latest report on environments arrived.
    pub reported_slot: Option<u64>,
}

impl Worker {
    /// Returns true if it counts as dead at `now`.
    #[must_use]
    pub fn is_silent(&self, now: Duration) -> bool {
        now.saturating_sub(self.last_seen) >= SILENT_AFTER
    }
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
