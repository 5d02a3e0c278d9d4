//! The bridge's service over real sockets, with a clock that the tests control.
#![expect(clippy::unwrap_used, clippy::panic, reason = "a test panics where it fails")]

mod calls;
mod drills;
mod inputs;
mod rig;
mod stops;
