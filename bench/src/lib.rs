//! Measurements of the parts of Tandem on this machine, for `tandem bench`.
//!
//! [`rates`] measures simulation, inference, updates and replay, and [`teacher`] the teacher service. [`IdleWorkers`]
//! are the load of `tandem bench scale`. The crate parses no command line, starts no process and prints nothing.
//!
//! Measured loops and clients are compiled here, because the binary is compiled without optimizations. A function that
//! measures therefore takes no generic parameters.
#![warn(missing_docs)]

mod error;
mod figure;
mod idle;
pub mod rates;
pub mod teacher;

use std::sync::Arc;
use std::time::Duration;

pub use error::Error;
pub use figure::Figure;
pub use idle::{Calls, IdleWorkers, LoadTimings, Percentiles, quantile};

/// A clock that counts from any moment.
pub type Clock = Arc<dyn Fn() -> Duration + Send + Sync>;
