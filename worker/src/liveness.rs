//! Liveness: whether the thread of a worker's rollout still makes progress.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// The time since which a worker's rollout has been computing. Clones share it.
#[derive(Debug, Clone, Default)]
pub struct Liveness(Arc<Mutex<Option<Duration>>>);

impl Liveness {
    /// Returns the time at which the rollout began the step that it is computing, by the clock of the worker's metrics.
    /// `None` between slots, and while the rollout waits for the teacher or for the server of the environments: a peer
    /// that is away does not make a worker hang.
    #[must_use]
    pub fn computing_since(&self) -> Option<Duration> {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Records that the rollout starts to compute at `now`, or has completed a step then and starts the next one.
    pub(crate) fn compute(&self, now: Duration) {
        self.set(Some(now));
    }

    /// Records that the rollout computes nothing.
    pub(crate) fn rest(&self) {
        self.set(None);
    }

    fn set(&self, since: Option<Duration>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = since;
    }
}
