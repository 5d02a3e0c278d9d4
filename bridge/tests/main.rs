//! The public interface of the bridge: drivers, executor and service.
#![expect(clippy::unwrap_used, clippy::panic, reason = "a test panics where it fails")]

mod drivers;
mod pair;
mod service;
#[path = "../../tests/services/skipped.rs"]
mod skipped;
