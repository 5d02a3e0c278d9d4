//! Worlds of the two case studies, push and pick and place, for one arm or two.
//!
//! An [`Env`] starts episodes, shows what the arms see, and lets a control step pass. Four environments share one code
//! path: [`tandem_core::Layout`] says which. The simulator knows nothing of policies, advice or rewards.
//!
//! The hand is simulated by forces (`hand`), in a rapier world set up for bodies of centimetres (`physics`, `world`);
//! the arm that carries it follows by inverse kinematics (`kinematics`, `arm`), and between two arms a velocity damper
//! keeps the links apart (`capsule`, `guard`). Episodes begin as `start` draws them, policies see and act in each arm's
//! own frame (`frame`, `observation`), pictures and logs show the world's (`scene`).
//!
//! The same draws and actions give the same bits: nothing here reads a clock, a thread's number or an address, and all
//! trigonometry is `libm`'s.
#![warn(missing_docs)]

mod arm;
mod capsule;
mod config;
mod env;
mod frame;
mod guard;
mod hand;
mod kinematics;
mod observation;
mod physics;
mod scene;
mod start;
mod world;

pub use config::{CONTROL_STEP_S, Friction, SimError, WorldConfig};
pub use env::Env;
