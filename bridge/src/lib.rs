//! Moves a pair of robot arms along checked motions.
//!
//! [`driver`] is the contract between the executor and a pair of arms. [`executor`] plays a checked motion through a
//! driver and enforces the limits of every command. [`work_cell`] places the arms and defines the limits of their
//! motions, and [`cell_file`] reads both from a file. [`service`] offers the arms as `tandem.v1.Bridge`.
//!
//! The drivers of real arms are [`quarc`], for arms behind a Simulink model with QUARC, and [`kinova_ros`], for arms
//! behind Kinova's ROS driver. The crate knows neither policies nor a simulator; crate `tandem-trials` has a simulated
//! driver.
//!
//! The crate reads no clock: callers pass the time in seconds since an arbitrary start. Only the service and the
//! drivers of real arms know a wire format.
#![warn(missing_docs)]

pub mod calibration;
pub mod cell_file;
pub mod driver;
mod ending;
pub mod executor;
pub mod injection;
pub mod kinova_ros;
pub mod quarc;
pub mod service;
pub mod to_start;
pub mod work_cell;

pub use driver::{ArmCommand, ArmReading, Command, Driver, DriverError, Faults, Order, PairState};
pub use executor::{
    CheckError, CheckedMotion, Checker, Executor, LeaseError, Phase, Progress, ResetError,
    Settings, StartError, Stop, StopCause, Token,
};
