//! Planned motions of two arms keep all limits, and the check refuses motions that violate one.
#![expect(clippy::unwrap_used, clippy::panic, reason = "a test panics where it fails")]

mod collisions;
mod plans;
mod refusals;
mod walks;
