//! The bridge's service over real sockets, with a clock that the tests control.

mod calls;
mod clock;
mod drills;
mod grasp;
mod inputs;
mod rig;
mod stops;
