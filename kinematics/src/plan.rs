//! The planner: from waypoints to a trajectory that the arms can follow.
//!
//! 1. Straight lines of the tool connect the waypoints and are cut into equal pieces of at most
//!    [`PlanSettings::piece_m`]. Inverse kinematics, seeded with the previous angles, gives the joint angles at every
//!    cut.
//! 2. These angles and the gripper openings are the control points of one cubic B-spline for all arms together. The
//!    tool deviates from the line at corners only: by at most a third of a piece in a full reversal, 2 mm with pieces
//!    of 6 mm, and less in smaller turns.
//! 3. The path is followed as fast as the limits allow, from rest to rest, with one time scaling for all arms and
//!    grippers, so that simultaneous waypoints stay simultaneous. The path is never followed faster than one waypoint
//!    per [`PlanSettings::step_s`]. [`PlanSettings::speed`] then scales the whole motion.
//!
//! The limits hold between samples too. Speeds and accelerations of the joints use bounds on the spline's derivatives;
//! the tool's speed uses values at nine points of each span and a bound on its change between them. The planner uses 98
//! per cent of every limit; the rest is left for sampling and its check.

mod error;

use nalgebra::Point3;
use tandem_core::ArmIndex;

pub use self::error::PlanError;
use crate::forward::ForwardKinematics;
use crate::inverse::MAX_CONTINUOUS_STEP_RAD;
use crate::joints::{Joints, MAX_JOINTS};
use crate::limits::Limits;
use crate::retime::{SpanBounds, fastest_rates};
use crate::spline::Spline;
use crate::trajectory::{Channels, Trajectory};
use crate::work_cell::{PlacedArm, WorkCell};

/// The share of every limit that a plan uses.
const USED_SHARE: f64 = 0.98;
/// The smallest number of pieces per line. A hand that waits for its gripper needs some too.
const MIN_PIECES: f64 = 8.0;
/// The number of intervals per span at whose ends the tool's speed is evaluated.
const SPEED_INTERVALS: u32 = 8;
/// The largest distance between consecutive waypoints, metres.
pub const MAX_STEP_M: f64 = 0.25;
/// The largest number of waypoints of a plan.
pub const MAX_WAYPOINTS: usize = 1000;

/// One arm's part of a waypoint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmWaypoint {
    /// Position of the tool's origin in the world, metres.
    pub tool_in_world_m: Point3<f64>,
    /// Opening of the gripper: 0 is closed, 1 open.
    pub gripper_opening: f64,
}

/// The simultaneous positions of all arms, in the order of the cell.
pub type Waypoint = Vec<ArmWaypoint>;

/// The settings of the planner.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlanSettings {
    /// Limits that the trajectory keeps.
    pub limits: Limits,
    /// Shortest time from one waypoint to the next, seconds, above 0: the control step of the training world, 0.04 in
    /// the classic one.
    pub step_s: f64,
    /// Share of the largest possible speed, in (0, 1].
    pub speed: f64,
    /// Longest piece of a line between control points, metres, in [0.001, 0.05].
    pub piece_m: f64,
}

impl Default for PlanSettings {
    fn default() -> Self {
        Self { limits: Limits::default(), step_s: 0.04, speed: 1.0, piece_m: 0.006 }
    }
}

/// Plans a trajectory of the arms of `cell` through `waypoints`. `start` gives joint angles (radians, arm by arm) near
/// those at the first waypoint and selects the branch of the inverse kinematics.
///
/// # Errors
/// Returns the first setting, number of arms or joints, or waypoint that is invalid; otherwise the first waypoint that
/// an arm cannot reach, or on the way to which a joint would jump.
pub fn plan(
    cell: &WorkCell,
    waypoints: &[Waypoint],
    start: &[Joints],
    settings: &PlanSettings,
) -> Result<Trajectory, PlanError> {
    check_settings(settings)?;
    check_start(cell, start)?;
    let n_pieces = n_pieces(longest_step_m(cell, waypoints)?, settings.piece_m);
    let channels = Channels::of(cell);
    let points = control_points(cell, waypoints, start, n_pieces)?;
    let path = Spline::following(channels.n_channels(), &points);
    let fastest = f64::from(n_pieces) / settings.step_s;
    let spans: Vec<SpanBounds> = (0..path.n_spans())
        .map(|span| span_bounds(cell, &channels, &path, span, &settings.limits))
        .map(|bounds| SpanBounds { x: bounds.x.min(fastest * fastest), ..bounds })
        .collect();
    let rates = fastest_rates(&spans).into_iter().map(|rate| rate * settings.speed).collect();
    Ok(Trajectory::new(channels, path, rates, n_pieces))
}

fn check_settings(settings: &PlanSettings) -> Result<(), PlanError> {
    let bad = |name, value| Err(PlanError::Setting { name, value });
    if let Some((name, value)) = settings.limits.bad_setting() {
        return bad(name, value);
    }
    if !(settings.speed > 0.0 && settings.speed <= 1.0) {
        return bad("speed", settings.speed);
    }
    if !(settings.step_s > 0.0 && settings.step_s.is_finite()) {
        return bad("step_s", settings.step_s);
    }
    if !(0.001..=0.05).contains(&settings.piece_m) {
        return bad("piece_m", settings.piece_m);
    }
    Ok(())
}

fn check_start(cell: &WorkCell, start: &[Joints]) -> Result<(), PlanError> {
    let expected = cell.arms.len();
    if start.len() != expected {
        return Err(PlanError::StartArms { got: start.len(), expected });
    }
    let lengths = start.iter().zip(&cell.arms).enumerate();
    let lengths = lengths.map(|(arm, (q, of))| (ArmIndex(arm), q.len(), of.model.n_joints()));
    match lengths.into_iter().find(|(_, got, expected)| got != expected) {
        Some((arm, got, expected)) => Err(PlanError::StartJoints { arm, got, expected }),
        None => Ok(()),
    }
}

/// Checks the waypoints and returns the largest distance between consecutive ones, metres.
fn longest_step_m(cell: &WorkCell, waypoints: &[Waypoint]) -> Result<f64, PlanError> {
    if !(2..=MAX_WAYPOINTS).contains(&waypoints.len()) {
        return Err(PlanError::WaypointCount { got: waypoints.len() });
    }
    let expected = cell.arms.len();
    let mut longest_m: f64 = 0.0;
    for (waypoint, at) in waypoints.iter().enumerate() {
        if at.len() != expected {
            return Err(PlanError::Arms { waypoint, got: at.len(), expected });
        }
        let before = &waypoints[waypoint.saturating_sub(1)];
        for (arm, (at, before)) in at.iter().zip(before).enumerate() {
            let (arm, gripper_opening) = (ArmIndex(arm), at.gripper_opening);
            if !(0.0..=1.0).contains(&gripper_opening) {
                return Err(PlanError::GripperOpening { waypoint, arm, gripper_opening });
            }
            let step_m = (at.tool_in_world_m - before.tool_in_world_m).norm();
            if step_m.is_nan() || step_m > MAX_STEP_M {
                return Err(PlanError::Step { waypoint, arm, step_m });
            }
            longest_m = longest_m.max(step_m);
        }
    }
    Ok(longest_m)
}

/// Returns the number of pieces per line.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "between 8 and 250, given a step of at most 0.25 m and pieces of at least 0.001 m"
)]
fn n_pieces(longest_m: f64, piece_m: f64) -> u32 {
    (longest_m / piece_m).ceil().max(MIN_PIECES) as u32
}

/// Returns all channels at every cut of the lines between waypoints, shape `[n_points, n_channels]`.
fn control_points(
    cell: &WorkCell,
    waypoints: &[Waypoint],
    start: &[Joints],
    n_pieces: u32,
) -> Result<Vec<f64>, PlanError> {
    let mut seeds = start.to_vec();
    let mut points = Vec::new();
    for (waypoint, to) in waypoints.iter().enumerate() {
        let from = &waypoints[waypoint.saturating_sub(1)];
        let first = if waypoint == 0 { n_pieces } else { 1 };
        for piece in first..=n_pieces {
            let share = f64::from(piece) / f64::from(n_pieces);
            for (arm, placed) in cell.indexed() {
                let (from, to) = (&from[arm.0], &to[arm.0]);
                let tool_m = from.tool_in_world_m.lerp(&to.tool_in_world_m, share);
                let solution = placed
                    .model
                    .inverse_kinematics(&placed.target(&tool_m), &seeds[arm.0])
                    .map_err(|source| PlanError::Unreachable { waypoint, arm, source })?;
                if waypoint > 0 {
                    check_jump(waypoint, arm, &seeds[arm.0], &solution.angles)?;
                }
                seeds[arm.0] = solution.angles;
                points.extend_from_slice(&solution.angles);
                let opens_by = to.gripper_opening - from.gripper_opening;
                points.push(from.gripper_opening + share * opens_by);
            }
        }
    }
    Ok(points)
}

fn check_jump(
    waypoint: usize,
    arm: ArmIndex,
    before: &Joints,
    after: &Joints,
) -> Result<(), PlanError> {
    for (joint, (before, after)) in before.iter().zip(after.iter()).enumerate() {
        let jump_rad = after - before;
        if jump_rad.abs() > MAX_CONTINUOUS_STEP_RAD {
            return Err(PlanError::Jump { waypoint, arm, joint, jump_rad });
        }
    }
    Ok(())
}

/// Returns the bounds on the path's rate in one span.
fn span_bounds(
    cell: &WorkCell,
    channels: &Channels,
    path: &Spline,
    span: usize,
    limits: &Limits,
) -> SpanBounds {
    let mut bounds = SpanBounds { x: f64::INFINITY, joints: Vec::new() };
    let mut limit_rate = |largest: f64, per_span: f64| {
        let rate = USED_SHARE * largest / per_span;
        bounds.x = bounds.x.min(rate * rate);
    };
    for (arm, placed) in cell.indexed() {
        let joints = &placed.model.joints;
        let per_span: Vec<[f64; 2]> =
            (0..joints.len()).map(|joint| path.bounds(span, channels.joint(arm, joint))).collect();
        for (joint, [first, _]) in joints.iter().zip(&per_span) {
            limit_rate(joint.speed_radps, *first);
        }
        limit_rate(limits.gripper_opening_per_s, path.bounds(span, channels.gripper(arm))[0]);
        let tool_m = tool_per_span_m(placed, path, span, channels.joint(arm, 0), &per_span);
        limit_rate(limits.tool_speed_mps, tool_m);
        bounds.joints.extend(joints.iter().zip(per_span).map(|(joint, [first, second])| {
            let limit = USED_SHARE * (joint.speed_radps / limits.ramp_s);
            [first / limit, second / limit]
        }));
    }
    bounds
}

/// Returns an upper bound on the distance that the tool covers per unit of the path in one span, metres. `per_span`
/// bounds the first and second derivative of each joint.
fn tool_per_span_m(
    placed: &PlacedArm,
    path: &Spline,
    span: usize,
    first_channel: usize,
    per_span: &[[f64; 2]],
) -> f64 {
    let levers = placed.model.tool_levers_m();
    let n_joints = levers.len();
    let mut change_m = 0.0;
    for (joint, [first, second]) in per_span.iter().enumerate() {
        change_m += levers[joint] * second;
        for (other, [other_first, _]) in per_span.iter().enumerate() {
            change_m += levers[joint.max(other)] * first * other_first;
        }
    }
    let speed_m = |interval: u32| {
        let t = f64::from(interval) / f64::from(SPEED_INTERVALS);
        let jets: [_; MAX_JOINTS] =
            std::array::from_fn(|joint| path.at(span, t, first_channel + joint.min(n_joints - 1)));
        let angles = Joints::from_fn(n_joints, |joint| jets[joint].value);
        let rates = Joints::from_fn(n_joints, |joint| jets[joint].first);
        ForwardKinematics::new(placed.model, &angles).tool_velocity(&rates).norm()
    };
    let largest_seen_m = (0..=SPEED_INTERVALS).map(speed_m).fold(0.0, f64::max);
    largest_seen_m + change_m * 0.5 / f64::from(SPEED_INTERVALS)
}
