//! The environment service: serves the built-in environments to workers and other programs.
//!
//! A client opens a stream, resets n environments and steps them in lock step. An episode has the same bits as one that
//! is simulated in the client's process. [`serve`] runs the service; `environment.proto` documents the calls.
#![warn(missing_docs)]

mod error;
mod metrics;
mod service;
mod session;

pub use error::Error;
pub use service::{Config, serve};
