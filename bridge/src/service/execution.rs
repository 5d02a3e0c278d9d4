//! A motion that a client executes: what its stream tells the thread that ticks, and the other way round.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

use crate::executor::{Stop, Token};

/// How a motion ended.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Outcome {
    Done,
    Stopped(Stop),
}

/// What a stream and the thread that ticks share. Neither ever waits for the other.
#[derive(Debug)]
pub(super) struct Execution {
    pub(super) token: Token,
    /// Share of the motion's own speed, in (0, 1].
    pub(super) speed: f64,
    heard: AtomicBool,
    left: AtomicBool,
    outcome: OnceLock<Outcome>,
}

/// The stream's side: once it is dropped, the client has left.
#[derive(Debug)]
pub(super) struct Attended(pub(super) Arc<Execution>);

impl Execution {
    pub(super) fn new(token: Token, speed: f64) -> Self {
        let (heard, left) = (AtomicBool::new(false), AtomicBool::new(false));
        Self { token, speed, heard, left, outcome: OnceLock::new() }
    }

    /// The client gave a sign of life.
    pub(super) fn hear(&self) {
        self.heard.store(true, Ordering::Release);
    }

    /// Whether the client gave a sign of life since this was asked last.
    pub(super) fn was_heard(&self) -> bool {
        self.heard.swap(false, Ordering::AcqRel)
    }

    /// The client's stream has ended or is broken.
    pub(super) fn leave(&self) {
        self.left.store(true, Ordering::Release);
    }

    pub(super) fn is_left(&self) -> bool {
        self.left.load(Ordering::Acquire)
    }

    /// The first end stands.
    pub(super) fn end(&self, outcome: Outcome) {
        self.outcome.set(outcome).ok();
    }

    pub(super) fn outcome(&self) -> Option<&Outcome> {
        self.outcome.get()
    }
}

impl Drop for Attended {
    fn drop(&mut self) {
        self.0.leave();
    }
}
