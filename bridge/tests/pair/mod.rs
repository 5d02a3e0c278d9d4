//! The executor on the simulated pair: tasks, ownership and faults.

mod calibration;
mod faults;
mod grippers;
mod injection;
mod itself;
mod observer;
mod ownership;
mod rig;
mod tasks;
mod to_start;
mod undisturbed;
