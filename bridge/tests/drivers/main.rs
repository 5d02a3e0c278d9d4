//! The drivers of real arms against stand-ins for the arms' side, over real sockets, with a simulated pair behind them.
#![expect(clippy::unwrap_used, clippy::panic, reason = "a test panics where it fails")]

mod kinova;
mod kinova_side;
mod quarc;
mod quarc_side;
mod rig;
