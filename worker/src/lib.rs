//! Plays the episodes that a learner orders: asks the learner for parameters and the teacher for advice, and sends
//! whole episodes back.
//!
//! A worker knows neither how learning is done nor what advice costs. It waits for whoever is away and asks again, for
//! ever: no step goes unadvised and no episode is lost because a peer was slow, so a result never depends on timing.
//!
//! Start at [`rollout`], the life of an episode. It talks to the world, the policy and the teacher through
//! [`ports`] and cannot tell a network from a test; [`run()`] is the shell of sockets round it.
#![warn(missing_docs)]

mod error;
mod evaluate;
pub mod explore;
#[cfg(test)]
mod fake;
mod grpc;
mod peers;
mod player;
pub mod ports;
pub mod record;
pub mod retry;
pub mod rollout;
mod run;

pub use error::Error;
pub use evaluate::{ComposedTeachers, evaluate};
pub use ports::{Act, Advisor};
pub use retry::Patience;
pub use run::{WorkerConfig, run, run_with};
