//! Worlds of the two case studies, push and pick and place, for one arm or two.
#![warn(missing_docs)]

mod config;
mod env;

pub use config::{SimError, Starts, WorldConfig};
pub use env::Env;
