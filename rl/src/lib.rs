//! The learning algorithm: DDPG with hindsight experience replay (HER), Polyak-averaged target networks and behaviour
//! cloning of advised actions.
//!
//! The crate is pure: it reads no clock and no file, knows no network protocol, and does not know how an episode is
//! simulated or who played it. A [`trainer::Trainer`] takes whole episodes and makes the updates of a round.
//!
//! Reading order: [`config`] (the run file), [`ddpg`] (the update, in the order of the paper), [`replay`] and [`her`]
//! (the replay buffer and how batches are drawn from it), [`trainer`] (a round).
#![warn(missing_docs)]

pub mod config;
pub mod ddpg;
pub mod her;
pub mod replay;
pub mod trainer;

pub use config::RunConfig;
