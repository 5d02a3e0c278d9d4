//! Errors of the planner.

use tandem_core::ArmIndex;

use super::{MAX_STEP_M, MAX_WAYPOINTS};
use crate::inverse::ReachError;

/// The reason why waypoints cannot become a trajectory. Waypoints are counted from 0.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PlanError {
    /// A setting is out of its range.
    #[error("{name} is {value}, which is out of its range")]
    Setting {
        /// Name of the setting.
        name: &'static str,
        /// Its value.
        value: f64,
    },
    /// There are too few or too many waypoints.
    #[error("{got} waypoints, expected 2 to {MAX_WAYPOINTS}")]
    WaypointCount {
        /// The number of waypoints.
        got: usize,
    },
    /// The start has another number of arms than the cell.
    #[error("the start has {got} arms, the cell has {expected}")]
    StartArms {
        /// Arms of the start.
        got: usize,
        /// Arms of the cell.
        expected: usize,
    },
    /// The start has another number of joints than an arm of the cell.
    #[error("the start of arm {} has {got} joints, the arm has {expected}", arm.0)]
    StartJoints {
        /// The arm.
        arm: ArmIndex,
        /// Joints of the start.
        got: usize,
        /// Joints of the arm.
        expected: usize,
    },
    /// A waypoint has another number of arms than the cell.
    #[error("waypoint {waypoint} has {got} arms, the cell has {expected}")]
    Arms {
        /// The waypoint.
        waypoint: usize,
        /// Arms of the waypoint.
        got: usize,
        /// Arms of the cell.
        expected: usize,
    },
    /// A gripper opening is NaN or not in [0, 1].
    #[error("waypoint {waypoint} of arm {}: gripper opening {gripper_opening}, expected 0 to 1", arm.0)]
    GripperOpening {
        /// The waypoint.
        waypoint: usize,
        /// The arm.
        arm: ArmIndex,
        /// The opening.
        gripper_opening: f64,
    },
    /// Two waypoints are farther apart than [`MAX_STEP_M`], or one is not finite.
    #[error("waypoint {waypoint} of arm {} is {step_m:.3} m from the previous one, at most {MAX_STEP_M} m", arm.0)]
    Step {
        /// The later waypoint.
        waypoint: usize,
        /// The arm.
        arm: ArmIndex,
        /// The distance, metres.
        step_m: f64,
    },
    /// The arm cannot reach the waypoint, or a point between the previous waypoint and this one.
    #[error("arm {} cannot reach waypoint {waypoint} or the way there", arm.0)]
    Unreachable {
        /// The waypoint.
        waypoint: usize,
        /// The arm.
        arm: ArmIndex,
        /// The reason.
        source: ReachError,
    },
    /// The line passes a singular configuration, where a joint would have to jump.
    #[error("on the way to waypoint {waypoint} joint {} of arm {} jumps by {jump_rad:.2} rad", .joint + 1, arm.0)]
    Jump {
        /// The waypoint.
        waypoint: usize,
        /// The arm.
        arm: ArmIndex,
        /// The joint, counted from 0.
        joint: usize,
        /// The change of its angle, radians.
        jump_rad: f64,
    },
}
