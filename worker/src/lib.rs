//! The worker: plays the episodes that a learner orders, with a teacher's advice, and returns whole episodes.
//!
//! A worker knows neither how learning works nor what advice costs. It waits for a peer that is away and repeats its
//! calls, so no step goes unadvised and no episode is lost because a peer was slow: results do not depend on timing.
//!
//! Start at [`rollout`], the life of an episode. It uses the simulator, the policy and the teacher through [`ports`]
//! and cannot distinguish a network from a test. [`run()`] connects it to the learner and the teacher.
#![warn(missing_docs)]

mod config;
pub mod determinism;
mod environment;
mod error;
mod evaluate;
pub mod explore;
#[cfg(test)]
mod fakes;
mod learner;
mod liveness;
mod metrics;
mod perturbation;
mod player;
pub mod ports;
pub mod record;
mod recorder;
pub mod replay;
mod request_stream;
pub mod rollout;
mod run;
mod teacher;
pub mod trace;

pub use config::{
    EnvironmentConfig, EnvironmentServer, RecordedEpisodes, RecordingConfig, ServerAddress,
    ServerNotStarted, Timeouts, WorkerConfig,
};
pub use environment::{ServedTask, describe_environments};
pub use error::Error;
pub use evaluate::{ComposedTeachers, Evaluation, evaluate_served};
pub use liveness::Liveness;
pub use perturbation::{Perturbation, PerturbedActor};
pub use ports::{Act, Advisor};
pub use run::{run, run_with};
