//! What moves a pair of arms: an executor that lets nothing but a checked motion through, and what stands behind it.
//!
//! [`driver`] is the contract between the executor and a pair of arms. [`executor`] plays a checked motion through a
//! driver and enforces the limits of every command. [`layout`] places the arms and defines what their motions have to
//! keep. [`service`] offers the arms as `tandem.v1.Bridge`.
//!
//! Drivers of real arms are [`quarc`], for arms that a Simulink model drives by way of QUARC, and [`kinova_ros`], for arms
//! behind Kinova's ROS driver.
//!
//! Nothing here reads a clock, and but for the service and the drivers of real arms nothing knows a wire: whoever ticks the
//! executor says what time it is, in seconds since a start of their own.
#![warn(missing_docs)]

pub mod driver;
pub mod executor;
pub mod kinova_ros;
pub mod layout;
pub mod quarc;
pub mod service;

pub use driver::{ArmCommand, ArmReading, Command, Driver, DriverError, Faults, Order, PairState};
pub use executor::{
    CheckError, CheckedMotion, Checker, Executor, LeaseError, Phase, Progress, ResetError,
    Settings, StartError, Stop, StopCause, Token,
};
