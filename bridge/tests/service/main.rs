//! The bridge's service over real sockets, by a clock that the tests turn.
#![expect(clippy::unwrap_used, clippy::panic, reason = "a test panics where it fails")]

mod calls;
mod inputs;
mod rig;
mod stops;
