//! The learner: the training loop over rounds, checkpoints, evaluations, and the `Learner` service.
//!
//! The learning algorithm is in `tandem-rl`. The crate does not know how an episode is simulated, how many workers there
//! are or how a teacher decides.
//!
//! Reading order: [`board`] (the queue of work), [`records`] (results of evaluations), [`checkpoint`], [`settings`] (what
//! a resumed run must keep),
//! [`service`] (the gRPC shell and the thread that learns), [`relay`] (a proxy between a learner and many workers).

pub mod board;
pub mod checkpoint;
mod drive;
mod error;
mod metrics;
pub mod records;
pub mod relay;
mod runtime;
pub mod service;
pub mod settings;
mod shared;
mod teacher;
mod warnings;

pub use drive::Ended;
pub use error::Error;
pub use service::{AfterTheEnd, Beside, serve, serve_beside};
pub use shared::{Clock, LearnerConfig};
