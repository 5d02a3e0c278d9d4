//! Forward and inverse kinematics of Kinova's Jaco with six joints, with the gripper pointing down.
//!
//! All quantities are in the arm's base frame, whose axes are parallel to those of the arm frame. The module computes
//! in `f64` and sums in a fixed order, so joint angles have the same bits on every machine.

use std::f64::consts::{FRAC_PI_2, PI};

use rapier3d::glamx::{DMat3, DVec3};
use serde::Serialize;

/// Joint angles, radians, from base to wrist, by Kinova's convention (joints 2 and 3 are straight at π).
pub(crate) type JointAngles = [f64; 6];

/// Home posture: gripper pointing down, 0.40 m ahead of the base and 0.15 m above the table, elbow high. It is the best
/// of 60 solutions from random initial angles.
pub(crate) const HOME: JointAngles =
    [-0.208_556_86, 2.506_949_69, 5.075_284_33, 2.970_589_41, 0.665_106_14, -0.379_560_43];

/// Damping factor of the least squares, in mixed units of metres and radians.
pub(crate) const DAMPING: f64 = 0.03;
/// Largest change of an angle per iteration, radians.
pub(crate) const MAX_ANGLE_STEP_RAD: f64 = 0.3;
/// Sum of squared errors below which the iteration ends.
pub(crate) const SQUARED_ERROR_TOLERANCE: f64 = 1e-10;

/// A row of the Denavit–Hartenberg table. Twists are multiples of 30° and given by sine and cosine.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DhRow {
    /// Sine of the twist about the common normal.
    pub sin_twist: f64,
    /// Cosine of the twist.
    pub cos_twist: f64,
    /// Length of the common normal, metres.
    pub length_m: f64,
    /// Offset along the joint's axis, metres.
    pub offset_m: f64,
    /// The table's angle is `direction * joint angle + zero_rad`, radians.
    pub zero_rad: f64,
    /// 1, or −1 for a joint that turns the other way.
    pub direction: f64,
}

const SIN_60: f64 = 0.866_025_403_784_438_6;
/// Contribution of half a wrist bend to the link offsets: `sin 30° / sin 60°` times the wrist link of 0.0741 m.
const BEND_M: f64 = 0.0741 * 0.5 / SIN_60;

/// The Jaco with the 60° wrist: Kinova's classic parameters of the arm `j2n6s300`.
pub(crate) const DH_TABLE: [DhRow; 6] = [
    DhRow {
        sin_twist: 1.0,
        cos_twist: 0.0,
        length_m: 0.0,
        offset_m: 0.2755,
        zero_rad: 0.0,
        direction: -1.0,
    },
    DhRow {
        sin_twist: 0.0,
        cos_twist: -1.0,
        length_m: 0.41,
        offset_m: 0.0,
        zero_rad: -FRAC_PI_2,
        direction: 1.0,
    },
    DhRow {
        sin_twist: 1.0,
        cos_twist: 0.0,
        length_m: 0.0,
        offset_m: -0.0098,
        zero_rad: FRAC_PI_2,
        direction: 1.0,
    },
    DhRow {
        sin_twist: SIN_60,
        cos_twist: 0.5,
        length_m: 0.0,
        offset_m: -(0.2073 + BEND_M),
        zero_rad: 0.0,
        direction: 1.0,
    },
    DhRow {
        sin_twist: SIN_60,
        cos_twist: 0.5,
        length_m: 0.0,
        offset_m: -2.0 * BEND_M,
        zero_rad: -PI,
        direction: 1.0,
    },
    DhRow {
        sin_twist: 0.0,
        cos_twist: -1.0,
        length_m: 0.0,
        offset_m: -(0.16 + BEND_M),
        zero_rad: FRAC_PI_2,
        direction: 1.0,
    },
];

/// The pose of a link.
#[derive(Clone, Copy)]
struct LinkFrame {
    axes: DMat3,
    origin: DVec3,
}

/// The poses of all links for given joint angles.
pub(crate) struct ForwardKinematics {
    /// From base to tool; joint `i` rotates about the z axis of frame `i`.
    frames: [LinkFrame; 7],
}

impl ForwardKinematics {
    pub(crate) fn new(angles: &JointAngles) -> Self {
        let mut frames = [LinkFrame { axes: DMat3::IDENTITY, origin: DVec3::ZERO }; 7];
        for (idx, (row, angle)) in DH_TABLE.iter().zip(angles).enumerate() {
            frames[idx + 1] = frames[idx].next(row, *angle);
        }
        Self { frames }
    }

    /// Returns the origin of frame `idx`, metres: 0 is the base, 1 to 5 are the joints, 6 is the tool.
    pub(crate) fn point(&self, idx: usize) -> DVec3 {
        self.frames[idx].origin
    }

    /// Returns the axis of joint `idx`, about which its angle counts positively.
    fn axis(&self, idx: usize) -> DVec3 {
        self.frames[idx].axes.z_axis * DH_TABLE[idx].direction
    }

    /// Returns the error of the tool's position (metres) with respect to `target` and of its orientation (rotation
    /// vector, radians) with respect to pointing down.
    fn tool_error(&self, target: DVec3) -> [f64; 6] {
        let tool = &self.frames[6];
        let position = target - tool.origin;
        let turn = 0.5
            * (tool.axes.x_axis.cross(DVec3::Y)
                + tool.axes.y_axis.cross(DVec3::X)
                + tool.axes.z_axis.cross(-DVec3::Z));
        [position.x, position.y, position.z, turn.x, turn.y, turn.z]
    }

    /// Returns the geometric Jacobian of the tool: rows are linear and angular velocity, columns are joints.
    fn jacobian(&self) -> [[f64; 6]; 6] {
        let mut jacobian = [[0.0; 6]; 6];
        for joint in 0..6 {
            let axis = self.axis(joint);
            let swing = axis.cross(self.point(6) - self.point(joint));
            let column = [swing.x, swing.y, swing.z, axis.x, axis.y, axis.z];
            for (row, value) in jacobian.iter_mut().zip(column) {
                row[joint] = value;
            }
        }
        jacobian
    }

    /// Returns, for the origin of each of `frames`, its Jacobian with respect to the tool's position while the gripper
    /// keeps pointing down. Column `c` belongs to a displacement of the tool along axis `c`.
    pub(crate) fn point_jacobians<const N: usize>(&self, frames: [usize; N]) -> [DMat3; N] {
        let mut displacements = [[0.0; 3]; 6];
        for (axis, row) in displacements.iter_mut().take(3).enumerate() {
            row[axis] = 1.0;
        }
        let rates = joint_changes(&self.jacobian(), displacements);
        frames.map(|frame| {
            let mut jacobian = [DVec3::ZERO; 3];
            for (joint, rate) in rates.iter().enumerate().take(frame) {
                let swing = self.axis(joint).cross(self.point(frame) - self.point(joint));
                for (column, rate) in jacobian.iter_mut().zip(rate) {
                    *column += swing * *rate;
                }
            }
            DMat3::from_cols(jacobian[0], jacobian[1], jacobian[2])
        })
    }
}

impl LinkFrame {
    fn next(&self, row: &DhRow, angle: f64) -> Self {
        let (sin, cos) = libm::sincos(row.direction * angle + row.zero_rad);
        let (sin_twist, cos_twist) = (row.sin_twist, row.cos_twist);
        let axes = DMat3::from_cols(
            DVec3::new(cos, sin, 0.0),
            DVec3::new(-sin * cos_twist, cos * cos_twist, sin_twist),
            DVec3::new(sin * sin_twist, -cos * sin_twist, cos_twist),
        );
        let step = DVec3::new(row.length_m * cos, row.length_m * sin, row.offset_m);
        Self { axes: self.axes * axes, origin: self.origin + self.axes * step }
    }
}

/// Returns joint angles near `start` that bring the tool to `target` (metres) with the gripper pointing down, by damped
/// least squares.
pub(crate) fn solve_inverse(start: JointAngles, target: DVec3, n_iterations: usize) -> JointAngles {
    let mut angles = start;
    for _ in 0..n_iterations {
        let forward = ForwardKinematics::new(&angles);
        let error = forward.tool_error(target);
        if error.iter().map(|e| e * e).sum::<f64>() < SQUARED_ERROR_TOLERANCE {
            break;
        }
        let changes = joint_changes(&forward.jacobian(), error.map(|e| [e]));
        for (angle, [change]) in angles.iter_mut().zip(changes) {
            *angle += change.clamp(-MAX_ANGLE_STEP_RAD, MAX_ANGLE_STEP_RAD);
        }
    }
    angles
}

/// Returns the joint changes for each column of tool displacements: `Jᵀ (J Jᵀ + damping²)⁻¹ displacements`.
fn joint_changes<const N: usize>(
    jacobian: &[[f64; 6]; 6],
    displacements: [[f64; N]; 6],
) -> [[f64; N]; 6] {
    let dot = |a: &[f64; 6], b: &[f64; 6]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let mut normal = jacobian.map(|row| jacobian.map(|other| dot(&row, &other)));
    for (idx, row) in normal.iter_mut().enumerate() {
        row[idx] += DAMPING * DAMPING;
    }
    let weights = solve_positive_definite(normal, displacements);
    std::array::from_fn(|joint| {
        std::array::from_fn(|column| {
            (0..6).map(|row| jacobian[row][joint] * weights[row][column]).sum()
        })
    })
}

/// Solves `matrix · x = sides` for every column by Gaussian elimination. A positive definite matrix needs no pivoting.
fn solve_positive_definite<const N: usize>(
    mut matrix: [[f64; 6]; 6],
    mut sides: [[f64; N]; 6],
) -> [[f64; N]; 6] {
    for pivot in 0..6 {
        for row in pivot + 1..6 {
            let factor = matrix[row][pivot] / matrix[pivot][pivot];
            let (matrix_pivot, sides_pivot) = (matrix[pivot], sides[pivot]);
            subtract(&mut matrix[row], factor, &matrix_pivot);
            subtract(&mut sides[row], factor, &sides_pivot);
        }
    }
    for row in (0..6).rev() {
        for known in row + 1..6 {
            let solved = sides[known];
            subtract(&mut sides[row], matrix[row][known], &solved);
        }
        sides[row] = sides[row].map(|side| side / matrix[row][row]);
    }
    sides
}

fn subtract<const N: usize>(row: &mut [f64; N], factor: f64, other: &[f64; N]) {
    for (value, other) in row.iter_mut().zip(other) {
        *value -= factor * other;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_core::rng::uniform;
    use tandem_core::{Stream, episode_rng};

    /// The distance between the tool and `target`, metres.
    fn error_m(angles: &JointAngles, target: DVec3) -> f64 {
        (ForwardKinematics::new(angles).point(6) - target).length()
    }

    #[test]
    fn the_straight_arm_points_up() {
        let forward = ForwardKinematics::new(&[0.0, PI, PI, 0.0, PI, 0.0]);
        assert!((forward.point(2) - DVec3::new(0.0, 0.0, 0.2755 + 0.41)).length() < 1e-9);
        assert!((forward.point(4).z - (0.2755 + 0.41 + 0.2073 + BEND_M)).abs() < 1e-9);
    }

    #[test]
    fn at_home_the_gripper_points_down_and_the_elbow_is_high() {
        let target = DVec3::new(0.40, 0.0, 0.15);
        let error = ForwardKinematics::new(&HOME).tool_error(target);
        assert!(error.iter().all(|e| e.abs() < 1e-5), "{error:?}");
        assert!(ForwardKinematics::new(&HOME).point(2).z > 0.5);
    }

    #[test]
    fn the_jacobian_is_the_derivative_of_the_tool_position() {
        let jacobian = ForwardKinematics::new(&HOME).jacobian();
        let step = 1e-6;
        for joint in 0..6 {
            let mut turned = HOME;
            turned[joint] += step;
            let moved = (ForwardKinematics::new(&turned).point(6)
                - ForwardKinematics::new(&HOME).point(6))
                / step;
            for axis in 0..3 {
                assert!(
                    (moved[axis] - jacobian[axis][joint]).abs() < 1e-5,
                    "joint {joint}, axis {axis}"
                );
            }
        }
    }

    #[test]
    fn the_whole_workspace_is_reached_with_every_joint_high_above_the_table() {
        let mut rng = episode_rng(3, 0, Stream::Reset);
        for _ in 0..1000 {
            let mut between = |low, high| f64::from(uniform(&mut rng, low, high));
            let target =
                DVec3::new(0.40 + between(-0.20, 0.20), between(-0.25, 0.25), between(0.022, 0.35));
            let angles = solve_inverse(HOME, target, 100);
            assert!(
                error_m(&angles, target) < 1e-4,
                "{target}: error of {} m",
                error_m(&angles, target)
            );
            let forward = ForwardKinematics::new(&angles);
            let lowest_m = (1..6).map(|idx| forward.point(idx).z).fold(f64::INFINITY, f64::min);
            assert!(lowest_m > 0.2, "a joint at {lowest_m} m for {target}");
        }
    }

    #[test]
    fn link_frames_move_with_the_tool_as_their_jacobians_predict() {
        let (from, to) = (DVec3::new(0.40, 0.0, 0.15), DVec3::new(0.41, -0.01, 0.16));
        let (before, after) = (
            ForwardKinematics::new(&solve_inverse(HOME, from, 100)),
            ForwardKinematics::new(&solve_inverse(HOME, to, 100)),
        );
        let jacobians = before.point_jacobians([2, 4, 5]);
        for (jacobian, frame) in jacobians.into_iter().zip([2, 4, 5]) {
            let predicted = before.point(frame) + jacobian * (to - from);
            assert!((after.point(frame) - predicted).length() < 2e-3, "frame {frame}");
        }
    }
}
