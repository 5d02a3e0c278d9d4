//! The executor on the simulated pair: tasks, ownership and faults.
#![expect(clippy::unwrap_used, clippy::panic, reason = "a test panics where it fails")]

mod calibration;
mod faults;
mod injection;
mod itself;
mod observer;
mod ownership;
mod rig;
mod tasks;
mod undisturbed;
