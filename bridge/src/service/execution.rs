//! The motion that a client executes: the state shared by its stream and the arms' thread.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

use crate::executor::{Stop, Token};
use crate::service::snapshot::MotionInfo;

/// The outcome of a motion.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Outcome {
    Done,
    Stopped(Stop),
}

/// The state shared by a stream and the arms' thread. Neither waits for the other.
#[derive(Debug)]
pub(super) struct Execution {
    pub(super) token: Token,
    pub(super) motion: Arc<MotionInfo>,
    alive: AtomicBool,
    abandoned: AtomicBool,
    outcome: OnceLock<Outcome>,
}

/// The stream's side: dropping it abandons the motion.
#[derive(Debug)]
pub(super) struct AbandonOnDrop(pub(super) Arc<Execution>);

impl Execution {
    pub(super) fn new(token: Token, motion: MotionInfo) -> Self {
        let (alive, abandoned) = (AtomicBool::new(false), AtomicBool::new(false));
        Self { token, motion: Arc::new(motion), alive, abandoned, outcome: OnceLock::new() }
    }

    /// Records a sign of life of the client.
    pub(super) fn mark_alive(&self) {
        self.alive.store(true, Ordering::Release);
    }

    /// Returns true if the client gave a sign of life since the last call.
    pub(super) fn take_alive(&self) -> bool {
        self.alive.swap(false, Ordering::AcqRel)
    }

    /// Records that the client's stream has ended or is broken.
    pub(super) fn abandon(&self) {
        self.abandoned.store(true, Ordering::Release);
    }

    pub(super) fn is_abandoned(&self) -> bool {
        self.abandoned.load(Ordering::Acquire)
    }

    /// Records the outcome. Later calls have no effect.
    pub(super) fn finish(&self, outcome: Outcome) {
        self.outcome.set(outcome).ok();
    }

    pub(super) fn outcome(&self) -> Option<&Outcome> {
        self.outcome.get()
    }
}

impl Drop for AbandonOnDrop {
    fn drop(&mut self) {
        self.0.abandon();
    }
}
