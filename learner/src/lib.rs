//! The learner: the training loop over rounds, checkpoints, evaluations, and the `Learner` service.
//!
//! Start at [`serve`]: it runs a [`LearnerConfig`], a run file and the addresses of its peers, on a thread of its own,
//! serves its workers meanwhile and returns a [`RunOutcome`]. The learning algorithm is in `tandem-rl`. The crate does
//! not know how an episode is simulated, how many workers there are or how a teacher decides.
//!
//! Reading order: [`work_queue`] (the assignment of slots to workers), [`evaluation_store`] (results of evaluations),
//! [`checkpoint`], [`settings`] (settings that a resumed run keeps), [`service`] (the gRPC service, next to the
//! learning thread), [`relay`] (a proxy between a learner and many workers).
#![warn(missing_docs)]

mod advice_account;
pub mod checkpoint;
mod connections;
mod error;
pub mod evaluation_store;
mod metrics;
mod progress;
pub mod relay;
mod runtime;
pub mod service;
pub mod settings;
mod shared;
mod timings;
mod training_loop;
mod view;
mod warnings;
pub mod work_queue;

pub use error::Error;
pub use service::{LingerPolicy, ServeOptions, serve, serve_with};
pub use shared::{Clock, LearnerConfig};
pub use training_loop::{INTERRUPTED, RunOutcome};
