//! Waypoints become a trajectory that the arms can follow.
//!
//! 1. Waypoints are joined by straight lines of the tool, cut into equal pieces of at most
//!    [`PlanSettings::piece_m`]; inverse kinematics, each time near the angles before, gives joint angles for every cut.
//! 2. These angles and the openings are the control points of one cubic B-spline for all arms together. The tool leaves the
//!    line at corners only, by at most a third of a piece where it turns straight back, less where it turns less: 2 mm
//!    with pieces of 6 mm.
//! 3. The path is followed as fast as the limits allow, from rest to rest, with one time scaling for all arms and
//!    grippers: what was simultaneous stays so. It is never followed faster than the waypoints say. `speed` then
//!    slows all of it down.
//!
//! The limits hold between samples too: speeds and accelerations of the joints by bounds of the spline's
//! derivatives (see `retime.rs`), the tool's speed by values at nine points of each span and a bound on its change
//! between them. Two per cent are left for whatever comes after: sampling, and its check.

use glam::DVec3;
use tandem_core::ArmIndex;

use crate::forward::ForwardKinematics;
use crate::inverse::ReachError;
use crate::joints::Joints;
use crate::limits::Limits;
use crate::retime::{SpanBounds, fastest_rates};
use crate::spline::Spline;
use crate::trajectory::{Channels, Trajectory};
use crate::work_cell::{PlacedArm, WorkCell};

/// Share of every limit that a plan uses.
const USED_SHARE: f64 = 0.98;
/// Least pieces of a line between waypoints: a gripper that closes while the hand waits needs some too.
const LEAST_PIECES: f64 = 8.0;
/// Pieces of a span at whose ends the tool's speed is looked at.
const SPEED_PIECES: u32 = 8;
/// Largest change of a joint from one control point to the next, radians. More is another solution of the
/// inverse kinematics, or a place close to a singular posture.
const MAX_JUMP_RAD: f64 = crate::inverse::MOVES_ON_RAD;
/// Largest distance of consecutive waypoints, metres.
pub const MAX_STEP_M: f64 = 0.25;
/// Most waypoints of a plan.
pub const MAX_WAYPOINTS: usize = 1000;

/// Where one arm shall be at a waypoint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmWaypoint {
    /// The tool's origin in the world, metres.
    pub tool_in_world_m: DVec3,
    /// How far the gripper is open: 0 is shut, 1 open.
    pub gripper_opening: f64,
}

/// Where every arm shall be at one time, in the order of the cell's arms.
pub type Waypoint = Vec<ArmWaypoint>;

/// How waypoints become a trajectory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlanSettings {
    /// What the arms may do.
    pub limits: Limits,
    /// Time from one waypoint to the next as they were made, seconds: 0.04 in the training world.
    pub step_s: f64,
    /// Share of the fastest possible speed, in (0, 1].
    pub speed: f64,
    /// Longest piece of a straight line between control points, metres, in [0.001, 0.05].
    pub piece_m: f64,
}

impl Default for PlanSettings {
    fn default() -> Self {
        Self { limits: Limits::default(), step_s: 0.04, speed: 1.0, piece_m: 0.006 }
    }
}

/// Why waypoints cannot become a trajectory.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PlanError {
    /// A setting is out of its range.
    #[error("{name} is {value}, which is out of its range")]
    Setting {
        /// The setting.
        name: &'static str,
        /// Its value.
        value: f64,
    },
    /// Too few or too many waypoints.
    #[error("{got} waypoints, expected 2 to {MAX_WAYPOINTS}")]
    WaypointCount {
        /// How many there are.
        got: usize,
    },
    /// A waypoint, or the start, is not of as many arms and joints as the cell has.
    #[error("waypoint {waypoint} is of {got} arms, the cell has {expected}")]
    Arms {
        /// The waypoint, counted from 0.
        waypoint: usize,
        /// Its arms, or the start's.
        got: usize,
        /// The cell's.
        expected: usize,
    },
    /// An opening is not in [0, 1], or not a number.
    #[error("waypoint {waypoint} of arm {}: gripper opening {gripper_opening}, expected 0 to 1", arm.0)]
    GripperOpening {
        /// The waypoint, counted from 0.
        waypoint: usize,
        /// The arm.
        arm: ArmIndex,
        /// The opening.
        gripper_opening: f64,
    },
    /// Two waypoints are farther apart than [`MAX_STEP_M`], or one is not finite.
    #[error("waypoint {waypoint} of arm {} is {step_m:.3} m from the one before, at most {MAX_STEP_M} m", arm.0)]
    Step {
        /// The later waypoint, counted from 0.
        waypoint: usize,
        /// The arm.
        arm: ArmIndex,
        /// The distance, metres.
        step_m: f64,
    },
    /// The arm cannot be there, or on the way there from the waypoint before.
    #[error("arm {} cannot reach waypoint {waypoint} or the way there", arm.0)]
    Unreachable {
        /// The waypoint, counted from 0.
        waypoint: usize,
        /// The arm.
        arm: ArmIndex,
        /// Why not.
        source: ReachError,
    },
    /// The way passes a singular posture: a joint would have to jump.
    #[error("on the way to waypoint {waypoint} joint {} of arm {} jumps by {jump_rad:.2} rad", .joint + 1, arm.0)]
    Jump {
        /// The waypoint, counted from 0.
        waypoint: usize,
        /// The arm.
        arm: ArmIndex,
        /// The joint, counted from 0.
        joint: usize,
        /// By how much, radians.
        jump_rad: f64,
    },
}

/// The trajectory of `cell`'s arms through `waypoints`, the arms' angles near `start` (radians) at the first.
///
/// # Errors
/// Says which waypoint cannot be reached, or what else is wrong.
pub fn plan(
    cell: &WorkCell,
    waypoints: &[Waypoint],
    start: &[Joints],
    settings: &PlanSettings,
) -> Result<Trajectory, PlanError> {
    let n_pieces = checked_pieces(cell, waypoints, start, settings)?;
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

/// How many pieces each line between waypoints is cut into, when all that is given makes sense.
fn checked_pieces(
    cell: &WorkCell,
    waypoints: &[Waypoint],
    start: &[Joints],
    settings: &PlanSettings,
) -> Result<u32, PlanError> {
    check_settings(settings)?;
    if !(2..=MAX_WAYPOINTS).contains(&waypoints.len()) {
        return Err(PlanError::WaypointCount { got: waypoints.len() });
    }
    let expected = cell.arms.len();
    let fits = start.iter().zip(&cell.arms).all(|(q, arm)| q.len() == arm.model.n_joints());
    if start.len() != expected || !fits {
        return Err(PlanError::Arms { waypoint: 0, got: start.len(), expected });
    }
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
            let step_m = (at.tool_in_world_m - before.tool_in_world_m).length();
            if step_m.is_nan() || step_m > MAX_STEP_M {
                return Err(PlanError::Step { waypoint, arm, step_m });
            }
            longest_m = longest_m.max(step_m);
        }
    }
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "between 8 and 250 by the checks above"
    )]
    let n_pieces = (longest_m / settings.piece_m).ceil().max(LEAST_PIECES) as u32;
    Ok(n_pieces)
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

/// All channels at every cut of the lines between waypoints, shape `[n_points, n_channels]`.
fn control_points(
    cell: &WorkCell,
    waypoints: &[Waypoint],
    start: &[Joints],
    n_pieces: u32,
) -> Result<Vec<f64>, PlanError> {
    let mut near = start.to_vec();
    let mut points = Vec::new();
    for (waypoint, to) in waypoints.iter().enumerate() {
        let from = &waypoints[waypoint.saturating_sub(1)];
        let first = if waypoint == 0 { n_pieces } else { 1 };
        for piece in first..=n_pieces {
            let share = f64::from(piece) / f64::from(n_pieces);
            for (arm, placed) in cell.indexed() {
                let (from, to) = (&from[arm.0], &to[arm.0]);
                let tool_m = from.tool_in_world_m.lerp(to.tool_in_world_m, share);
                let solution = placed
                    .model
                    .nearest(&placed.target(tool_m), &near[arm.0])
                    .map_err(|source| PlanError::Unreachable { waypoint, arm, source })?;
                if waypoint > 0 {
                    check_jump(waypoint, arm, &near[arm.0], &solution.angles)?;
                }
                near[arm.0] = solution.angles;
                points.extend_from_slice(&solution.angles);
                points.push(
                    from.gripper_opening + share * (to.gripper_opening - from.gripper_opening),
                );
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
        if jump_rad.abs() > MAX_JUMP_RAD {
            return Err(PlanError::Jump { waypoint, arm, joint, jump_rad });
        }
    }
    Ok(())
}

/// What limits the path's rate in one span.
fn span_bounds(
    cell: &WorkCell,
    channels: &Channels,
    path: &Spline,
    span: usize,
    limits: &Limits,
) -> SpanBounds {
    let mut bounds = SpanBounds { x: f64::INFINITY, joints: Vec::new() };
    let mut rate_within = |largest: f64, per_span: f64| {
        let rate = USED_SHARE * largest / per_span;
        bounds.x = bounds.x.min(rate * rate);
    };
    for (arm, placed) in cell.indexed() {
        let mut per_span = [[0.0; 2]; crate::joints::MAX_JOINTS];
        for (joint, per_span) in per_span.iter_mut().enumerate().take(placed.model.n_joints()) {
            *per_span = path.bounds(span, channels.joint(arm, joint));
            rate_within(placed.model.joints[joint].speed_radps, per_span[0]);
        }
        rate_within(limits.gripper_opening_per_s, path.bounds(span, channels.gripper(arm))[0]);
        let per_span = &per_span[..placed.model.n_joints()];
        let tool_m = tool_per_span(placed, path, span, channels.joint(arm, 0), per_span);
        rate_within(limits.tool_speed_mps, tool_m);
        let accelerations =
            placed.model.joints.iter().map(|joint| joint.speed_radps / limits.ramp_s);
        let of_limit = per_span.iter().zip(accelerations);
        bounds.joints.extend(of_limit.map(|([first, second], limit)| {
            let limit = USED_SHARE * limit;
            [first / limit, second / limit]
        }));
    }
    bounds
}

/// A bound on the tool's way per unit of the path in one span, metres.
fn tool_per_span(
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
    let largest_seen_m = (0..=SPEED_PIECES)
        .map(|piece| {
            let t = f64::from(piece) / f64::from(SPEED_PIECES);
            let jets: [_; crate::joints::MAX_JOINTS] = std::array::from_fn(|joint| {
                path.at(span, t, first_channel + joint.min(n_joints - 1))
            });
            let angles = Joints::from_fn(n_joints, |joint| jets[joint].value);
            let rates = Joints::from_fn(n_joints, |joint| jets[joint].first);
            ForwardKinematics::new(placed.model, &angles).tool_velocity(&rates).length()
        })
        .fold(0.0, f64::max);
    largest_seen_m + change_m * 0.5 / f64::from(SPEED_PIECES)
}
