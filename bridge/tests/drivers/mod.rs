//! The drivers of real arms against stand-ins for the arms' side, over real sockets, with a simulated pair behind them.

mod kinova;
mod kinova_faults;
mod kinova_side;
mod quarc;
mod quarc_c;
mod quarc_side;
mod quarc_vectors;
pub(crate) mod rig;
