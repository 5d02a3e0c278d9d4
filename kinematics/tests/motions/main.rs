//! Waypoints of two arms become motions within all limits, and what breaks one is refused.
#![expect(clippy::unwrap_used, clippy::panic, reason = "a test panics where it fails")]

mod led;
mod plans;
mod refusals;
mod walks;
