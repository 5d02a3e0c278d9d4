//! Kinematics of real arms: forward and inverse kinematics, motion planning within limits, and the check that every
//! motion must pass before an arm moves.
//!
//! ```
//! use nalgebra::Point3;
//! use tandem_core::ArmIndex;
//! use tandem_kinematics::{
//!     ArmWaypoint, CheckSettings, ForwardKinematics, Joints, MICO_4, PlanSettings, WorkCell, check, plan,
//! };
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // Forward kinematics: joint angles (radians) to the pose of the tool (metres).
//! let elbow_up = Joints::new(MICO_4.elbow_up_rad);
//! let tool_m = ForwardKinematics::new(&MICO_4, &elbow_up).tool_m();
//! assert!(tool_m.x > 0.2 && tool_m.z.abs() < 0.1);
//!
//! // A work cell of two such arms. `ready` holds each tool above the centre of its workspace.
//! let cell = WorkCell::mico_pair();
//! let start = cell.ready(0.15)?;
//!
//! // Inverse kinematics: the solution for a point of the world nearest to the present angles.
//! let arm = &cell.arms[0];
//! let target_m = cell.world_from_arm(ArmIndex(0), &Point3::new(0.0, 0.1, 0.15));
//! let solution = arm.model.inverse_kinematics(&arm.target(&target_m), &start[0])?;
//! assert!(solution.tilt_rad < 0.4);
//!
//! // A plan: both tools rise by 5 cm while the grippers close.
//! let at = |z_m: f64, gripper_opening: f64| {
//!     [0, 1].map(|arm| ArmWaypoint {
//!         tool_in_world_m: cell.world_from_arm(ArmIndex(arm), &Point3::new(0.0, 0.0, z_m)),
//!         gripper_opening,
//!     })
//! };
//! let waypoints = [at(0.15, 1.0).to_vec(), at(0.25, 0.2).to_vec()];
//! let trajectory = plan(&cell, &waypoints, &start, &PlanSettings::default())?;
//!
//! // The check: the samples that the arms receive keep every limit.
//! let motion = trajectory.sampled(100.0);
//! check(&cell, &motion, &start, &CheckSettings::default())?;
//! # Ok(())
//! # }
//! ```
//!
//! | module | contents |
//! |---|---|
//! | [`joints`], [`model`] | values per joint; the geometry of an arm |
//! | [`forward`], [`inverse`] | joint angles to frames, and back |
//! | [`self_collision`] | gaps between the parts of one arm |
//! | [`task_frame`], [`work_cell`] | the training world's frames; arms and table |
//! | [`limits`], [`mod@plan`], [`trajectory`], [`motion`] | from waypoints to sampled motions |
//! | [`mod@check`], [`refusal`] | accepts or refuses a motion |
//!
//! Lengths are metres, angles radians, times seconds, all `f64`. Transforms are nalgebra's and named `a_from_b`; points
//! convert from and to glam's vectors with `From`. Trigonometry is `libm`'s and all matrices have static sizes, so the
//! same input gives the same bits on every machine. The crate does no input or output, reads no clock and knows no
//! driver.
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
pub mod task_frame;
pub mod trajectory;
pub mod work_cell;

mod capsule;
mod manipulability;
mod retime;
mod scene;
mod spline;

pub use check::{CheckSettings, check};
pub use forward::ForwardKinematics;
pub use inverse::{ReachError, Solution, ToolTarget};
pub use joints::Joints;
pub use limits::Limits;
pub use model::{ArmModel, MICO_4, PADS_AHEAD_M};
pub use motion::{ArmSample, Motion};
pub use plan::{ArmWaypoint, PlanError, PlanSettings, Waypoint, plan};
pub use refusal::{Excess, Reason, Refusal};
pub use task_frame::TaskFrame;
pub use trajectory::{ArmState, Trajectory};
pub use work_cell::{Gaps, PlacedArm, WorkCell};
