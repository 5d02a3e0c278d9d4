//! Learns a policy from episodes that others play: replay, hindsight experience replay (HER), the DDPG update with
//! Polyak-averaged target networks, rounds, checkpoints, and the `Learner` service round them.
//!
//! It does not know how an episode is simulated, how many workers there are or how a teacher decides.
//!
//! Reading order: [`config`] (the run file), [`ddpg`] (the update), [`replay`] and [`her`] (what a batch is made of),
//! [`trainer`] (a round), [`board`] (who plays what), [`records`] (what evaluations bring), [`checkpoint`], [`settings`] (what a
//! run keeps when it goes on), [`lock`] (who works in a directory), [`atomic`] (files that are replaced as a whole), [`service`] (the gRPC shell and the thread that
//! learns), [`relay`] (what stands between a learner and many workers).

pub mod atomic;
pub mod board;
pub mod checkpoint;
pub mod config;
pub mod ddpg;
mod drive;
mod error;
pub mod her;
pub mod lock;
mod metrics;
pub mod records;
pub mod relay;
pub mod replay;
mod runtime;
pub mod service;
pub mod settings;
mod shared;
mod teacher;
pub mod trainer;
mod warnings;

pub use config::RunConfig;
pub use drive::Ended;
pub use error::Error;
pub use service::{AfterTheEnd, Beside, serve, serve_beside};
pub use shared::{Clock, LearnerConfig};
