//! The mathematics that real arms need: where joints bring a tool and the other way round, motions within limits, and the
//! check before anything moves.
//!
//! From the bottom up: [`model`] has the arms' measures, [`forward`] says where everything is at given joint angles,
//! [`inverse`] which angles reach a place, [`work_cell`] how two arms stand and how the training world's frames map
//! onto them, [`mod@plan`] makes waypoints a [`trajectory`] of joint angles over time, and [`mod@check`] refuses a
//! [`motion`] that would break a limit.
//!
//! Lengths are metres, angles radians, times seconds, all `f64`; trigonometry is `libm`'s and sums have a fixed order, so
//! that the same waypoints give the same bits on every machine. There is no input or output here, no clock and no driver.
#![warn(missing_docs)]

pub mod check;
pub mod forward;
pub mod inverse;
pub mod joints;
pub mod limits;
pub mod model;
pub mod motion;
pub mod plan;
pub mod refusal;
pub mod self_collision;
pub mod trajectory;
pub mod work_cell;

mod capsule;
mod iterative;
mod manipulability;
mod retime;
mod spline;

pub use check::{CheckSettings, check};
pub use forward::ForwardKinematics;
pub use inverse::{ReachError, Solution, ToolTarget};
pub use joints::Joints;
pub use limits::Limits;
pub use model::{ArmModel, JACO_6, MICO_4, MICO_6};
pub use motion::{ArmSample, Motion};
pub use plan::{ArmWaypoint, PlanError, PlanSettings, Waypoint, plan};
pub use refusal::{Excess, Reason, Refusal};
pub use trajectory::{ArmState, Trajectory};
pub use work_cell::{Gaps, PlacedArm, TaskFrame, WorkCell};
