//! The inverse kinematics of the arms with six joints: damped least squares.

use glam::{DMat3, DVec3};

use crate::forward::ForwardKinematics;
use crate::inverse::ReachError;
use crate::joints::{Joints, MAX_JOINTS};
use crate::model::ArmModel;

/// Iterations from one start.
const ITERATIONS: usize = 60;
/// Largest change of an angle per iteration, radians.
const MAX_STEP_RAD: f64 = 0.3;
/// Squared error at which the iteration ends, in metres and radians: 1e-11 of either.
const SOLVED: f64 = 1e-22;
/// Squared error that still counts as solved when the iterations are used up.
const GOOD: f64 = 1e-18;
/// Damping as a share of the squared error, so that the last steps are Newton's, and the least.
const DAMPING_SHARE: f64 = 0.05;
const LEAST_DAMPING: f64 = 1e-10;
/// Starts that are tried where the angles of the arm lead nowhere.
const N_STARTS: u32 = 24;

type Vector6 = [f64; 6];

/// Angles that bring the tool to `at_m` with the axes `axes`, found from `start`; ranges are not looked at.
pub(crate) fn solve(
    model: &ArmModel,
    at_m: DVec3,
    axes: &DMat3,
    start: &Joints,
) -> Result<Joints, ReachError> {
    let mut angles = *start;
    let mut error = [0.0; 6];
    for _ in 0..ITERATIONS {
        let posture = ForwardKinematics::new(model, &angles);
        error = tool_error(&posture, at_m, axes);
        let squared = dot(&error, &error);
        if squared < SOLVED {
            break;
        }
        let change = step(&posture, &error, DAMPING_SHARE * squared + LEAST_DAMPING);
        for (angle, change) in angles.iter_mut().zip(change) {
            *angle += change.clamp(-MAX_STEP_RAD, MAX_STEP_RAD);
        }
    }
    if dot(&error, &error) < GOOD {
        return Ok(angles);
    }
    let [x, y, z, turn @ ..] = error;
    let (miss_m, turn_rad) = (DVec3::new(x, y, z).length(), DVec3::from(turn).length());
    Err(ReachError::Unsolved { miss_m, turn_rad })
}

/// Postures spread evenly over the joints' ranges, always the same.
pub(crate) fn starts(model: &ArmModel) -> impl Iterator<Item = Joints> {
    /// Powers of the inverse of the root of x⁷ = x + 1, which spread points evenly in six dimensions.
    const STEPS: [f64; MAX_JOINTS] = [
        0.898_653_712_628_699_2,
        0.807_578_495_221_344_7,
        0.725_733_412_969_759_7,
        0.652_183_025_943_971_5,
        0.586_086_697_577_969_3,
        0.526_688_986_700_735_7,
    ];
    (0..N_STARTS).map(|start| {
        Joints::from_fn(model.n_joints(), |joint| {
            let [low, high] = model.joints[joint].range_rad;
            // Joints that turn round and round need one turn only.
            let width = (high - low).min(std::f64::consts::TAU);
            let share = 0.5 + STEPS[joint] * f64::from(start);
            0.5 * (low + high) + width * (share - share.floor() - 0.5)
        })
    })
}

/// Place (metres) and turn (radians) by which the tool misses.
fn tool_error(posture: &ForwardKinematics, at_m: DVec3, axes: &DMat3) -> Vector6 {
    let tool = posture.tool();
    let miss = at_m - tool.origin_m;
    let sines = 0.5
        * (tool.axes.x_axis.cross(axes.x_axis)
            + tool.axes.y_axis.cross(axes.y_axis)
            + tool.axes.z_axis.cross(axes.z_axis));
    let cos = 0.5
        * (tool.axes.x_axis.dot(axes.x_axis)
            + tool.axes.y_axis.dot(axes.y_axis)
            + tool.axes.z_axis.dot(axes.z_axis)
            - 1.0);
    let sin = sines.length();
    let angle = libm::atan2(sin, cos);
    // Half a turn away the axis is unknown; any will do, the iteration then leaves that place.
    let turn = match (sin > 1e-9, cos > 0.0) {
        (true, _) => sines * (angle / sin),
        (false, true) => sines,
        (false, false) => tool.axes.x_axis * angle,
    };
    [miss.x, miss.y, miss.z, turn.x, turn.y, turn.z]
}

/// Joint changes for `error`: `Jᵀ (J Jᵀ + damping)⁻¹ error`.
fn step(posture: &ForwardKinematics, error: &Vector6, damping: f64) -> Vector6 {
    let columns: [Vector6; 6] = std::array::from_fn(|joint| {
        let (along, axis) = posture.tool_motion(joint);
        [along.x, along.y, along.z, axis.x, axis.y, axis.z]
    });
    let normal: [Vector6; 6] = std::array::from_fn(|row| {
        std::array::from_fn(|column| {
            let sum: f64 = columns.iter().map(|joint| joint[row] * joint[column]).sum();
            sum + damping * f64::from(u8::from(row == column))
        })
    });
    let weights = solve_positive_definite(normal, *error);
    columns.map(|column| dot(&column, &weights))
}

/// Solves `matrix · x = side` by elimination; a positive definite matrix needs no pivots.
fn solve_positive_definite(mut matrix: [Vector6; 6], mut side: Vector6) -> Vector6 {
    for pivot in 0..6 {
        for row in pivot + 1..6 {
            let factor = matrix[row][pivot] / matrix[pivot][pivot];
            let of_pivot = matrix[pivot];
            for (value, other) in matrix[row].iter_mut().zip(of_pivot) {
                *value -= factor * other;
            }
            side[row] -= factor * side[pivot];
        }
    }
    for row in (0..6).rev() {
        let known: f64 = (row + 1..6).map(|column| matrix[row][column] * side[column]).sum();
        side[row] = (side[row] - known) / matrix[row][row];
    }
    side
}

fn dot(a: &Vector6, b: &Vector6) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
