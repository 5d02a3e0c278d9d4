//! Trials of policies on simulated arms.
//!
//! [`simulated`] is a pair of Kinova Micos with its own physics, behind the bridge's driver contract
//! ([`tandem_bridge::Driver`]). It replaces real arms in trials, in tests of the executor, and behind `tandem bridge
//! --driver sim`. [`trial`] runs a policy on such a pair, through the executor and the envelope that real arms have,
//! and evaluates the final positions of the objects. [`series`] runs many trials in parallel and records them.
//!
//! No clock is read. The same configuration, seed and policy give the same bits.
#![warn(missing_docs)]

pub mod series;
pub mod simulated;
pub mod trial;

pub use series::{NamedPolicy, Series, SeriesError};
pub use simulated::{SimulatedConfig, SimulatedPair};
