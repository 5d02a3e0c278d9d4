//! Turns a request into a checked motion.

use tandem_kinematics::plan::MAX_WAYPOINTS;
use tandem_kinematics::trajectory::DEFAULT_RATE_HZ;
use tandem_kinematics::{
    ArmSample, ArmWaypoint, ForwardKinematics, Joints, Motion, PlanError, PlanSettings, Waypoint,
    WorkCell, plan,
};
use tandem_proto::{DecodeError, pb};

use crate::driver::PairState;
use crate::executor::{CheckError, CheckedMotion, Checker};

/// The largest number of samples of a joint motion: ten minutes at 100 samples per second.
const MAX_SAMPLES: usize = 60_001;

/// The motion that a client requests.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct MotionSpec {
    pub(super) path: MotionPath,
    /// The share of the motion's own speed, in (0, 1].
    pub(super) speed: f64,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) enum MotionPath {
    /// Positions of the tools, to be planned.
    Waypoints { waypoints: Vec<Waypoint>, step_s: f64, from_here: bool },
    /// Samples of the joints' angles.
    JointSamples(Motion),
}

/// The reason why a motion is refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MotionError {
    /// No trajectory leads through the waypoints.
    #[error("{}{}", .0, cause_of(.0))]
    Plan(PlanError),
    /// The motion breaks a limit.
    #[error(transparent)]
    Check(#[from] CheckError),
}

/// The cause of a planning error, to be appended to its message.
fn cause_of(error: &PlanError) -> String {
    match error {
        PlanError::Unreachable { source, .. } => format!(": {source}"),
        _ => String::new(),
    }
}

impl MotionSpec {
    /// Decodes `request` for the arms of `cell`. Errors name fields relative to the motion.
    pub(super) fn decode(request: pb::MotionRequest, cell: &WorkCell) -> Result<Self, DecodeError> {
        use pb::motion_request::Motion as M;
        let speed = within("speed", request.speed, "more than 0 and at most 1", |speed| {
            speed > 0.0 && speed <= 1.0
        })?;
        let path = match request.motion {
            Some(M::WayPoints(message)) => {
                decode_waypoints(message, cell).map_err(|error| error.within("way_points"))?
            }
            Some(M::JointMotion(message)) => {
                decode_joint_samples(message, cell).map_err(|error| error.within("joint_motion"))?
            }
            None => return Err(DecodeError::new("motion", "way_points or joint_motion", "none")),
        };
        Ok(Self { path, speed })
    }

    /// Plans the motion from the position of the arms, if necessary, and checks it. `openings` are the commanded ones,
    /// arm by arm; `None` if the arms are stopped.
    pub(super) fn prepare(
        self,
        state: &PairState,
        openings: Option<&[f64]>,
        checker: &Checker,
    ) -> Result<CheckedMotion, MotionError> {
        let at: Vec<Joints> = state.arms.iter().map(|arm| arm.angles).collect();
        let motion = match self.path {
            MotionPath::JointSamples(motion) => motion,
            MotionPath::Waypoints { mut waypoints, step_s, from_here } => {
                if from_here {
                    waypoints.insert(0, tool_positions(state, openings, checker.cell()));
                }
                let limits = checker.settings().check.limits;
                let settings = PlanSettings { limits, step_s, ..PlanSettings::default() };
                let planned = plan(checker.cell(), &waypoints, &at, &settings);
                let planned =
                    planned.map_err(|error| MotionError::Plan(renumbered(error, from_here)))?;
                // The check will refuse a long motion: do not spend memory on its samples.
                let longest_s = checker.settings().check.duration_s;
                let rate_hz =
                    if planned.duration_s() > 2.0 * longest_s { 1.0 } else { DEFAULT_RATE_HZ };
                planned.sampled(rate_hz)
            }
        };
        Ok(checker.check(motion, &at)?)
    }
}

/// The present positions of the tools, with the commanded openings if there are any. A gripper that holds an object is
/// open wider than commanded, and would let go of it on the way from the measured opening. A reset takes over the
/// measured openings.
fn tool_positions(state: &PairState, openings: Option<&[f64]>, cell: &WorkCell) -> Waypoint {
    let waypoint = |(arm, placed): (usize, &tandem_kinematics::PlacedArm)| {
        let reading = &state.arms[arm];
        let tool = ForwardKinematics::new(placed.model, &reading.angles).tool_m();
        let opening = openings.map_or(reading.opening, |openings| openings[arm]);
        ArmWaypoint {
            tool_in_world_m: placed.world_from_base() * tool,
            gripper_opening: opening.clamp(0.0, 1.0),
        }
    };
    cell.arms.iter().enumerate().map(waypoint).collect()
}

/// Returns the error with waypoints counted as the client counts them.
fn renumbered(error: PlanError, from_here: bool) -> PlanError {
    let client = |waypoint: usize| waypoint.saturating_sub(usize::from(from_here));
    match error {
        PlanError::Step { waypoint, arm, step_m } => {
            PlanError::Step { waypoint: client(waypoint), arm, step_m }
        }
        PlanError::Unreachable { waypoint, arm, source } => {
            PlanError::Unreachable { waypoint: client(waypoint), arm, source }
        }
        PlanError::Jump { waypoint, arm, joint, jump_rad } => {
            PlanError::Jump { waypoint: client(waypoint), arm, joint, jump_rad }
        }
        other => other,
    }
}

fn decode_waypoints(message: pb::WayPoints, cell: &WorkCell) -> Result<MotionPath, DecodeError> {
    let (from_here, got) = (message.from_here, message.way_points.len());
    let (least, most) = if from_here { (1, MAX_WAYPOINTS - 1) } else { (2, MAX_WAYPOINTS) };
    if !(least..=most).contains(&got) {
        return Err(DecodeError::new("way_points", format_args!("{least} to {most}"), got));
    }
    let step_s =
        within("step_s", message.step_s, "a number of seconds in [0.001, 10]", |step_s| {
            (0.001..=10.0).contains(&step_s)
        })?;
    let decode_indexed = |(idx, waypoint)| {
        decode_waypoint(waypoint, cell)
            .map_err(|error| error.within(format_args!("way_points[{idx}]")))
    };
    let waypoints = message.way_points.into_iter().enumerate().map(decode_indexed);
    Ok(MotionPath::Waypoints { waypoints: waypoints.collect::<Result<_, _>>()?, step_s, from_here })
}

fn decode_waypoint(message: pb::BridgeWayPoint, cell: &WorkCell) -> Result<Waypoint, DecodeError> {
    check_arms(message.arms.len(), cell)?;
    let decode_indexed = |(idx, arm): (usize, pb::ArmWayPoint)| {
        decode_arm(&arm).map_err(|error| error.within(format_args!("arms[{idx}]")))
    };
    message.arms.into_iter().enumerate().map(decode_indexed).collect()
}

fn decode_arm(message: &pb::ArmWayPoint) -> Result<ArmWaypoint, DecodeError> {
    let field = "tool_in_world_m";
    let numbers = &message.tool_in_world_m;
    let [x, y, z] = numbers[..] else {
        return Err(DecodeError::new(
            field,
            "3 numbers",
            format_args!("{} numbers", numbers.len()),
        ));
    };
    check_finite(field, numbers)?;
    Ok(ArmWaypoint {
        tool_in_world_m: [x, y, z].into(),
        gripper_opening: decode_opening(message.opening)?,
    })
}

fn decode_joint_samples(
    message: pb::JointMotion,
    cell: &WorkCell,
) -> Result<MotionPath, DecodeError> {
    let expected = "a number of seconds in [0.001, 0.1]";
    let period_s = within("period_s", message.period_s, expected, |period_s| {
        (0.001..=0.1).contains(&period_s)
    })?;
    check_arms(message.arms.len(), cell)?;
    let n_samples = message.arms[0].samples.len();
    let mut arms = Vec::with_capacity(message.arms.len());
    for (arm, (message, placed)) in message.arms.into_iter().zip(&cell.arms).enumerate() {
        let field = format!("arms[{arm}].samples");
        let got = message.samples.len();
        if !(2..=MAX_SAMPLES).contains(&got) {
            return Err(DecodeError::new(field, format_args!("2 to {MAX_SAMPLES}"), got));
        }
        if got != n_samples {
            let expected = format_args!("{n_samples}, as the first arm has").to_string();
            return Err(DecodeError::new(field, expected, got));
        }
        let decode_indexed = |(idx, sample): (usize, pb::JointSample)| {
            decode_sample(&sample, placed.model.n_joints())
                .map_err(|error| error.within(format_args!("arms[{arm}].samples[{idx}]")))
        };
        let samples = message.samples.into_iter().enumerate().map(decode_indexed);
        arms.push(samples.collect::<Result<_, _>>()?);
    }
    Ok(MotionPath::JointSamples(Motion { period_s, arms }))
}

fn decode_sample(message: &pb::JointSample, n_joints: usize) -> Result<ArmSample, DecodeError> {
    let joints = |field: &str, numbers: &[f64]| {
        if numbers.len() != n_joints {
            let got = format_args!("{} numbers", numbers.len()).to_string();
            return Err(DecodeError::new(field, format_args!("{n_joints} numbers"), got));
        }
        check_finite(field, numbers)?;
        Ok(Joints::new(numbers))
    };
    Ok(ArmSample {
        angles: joints("angles_rad", &message.angles_rad)?,
        velocities: joints("velocities_radps", &message.velocities_radps)?,
        gripper_opening: decode_opening(message.opening)?,
    })
}

fn check_arms(got: usize, cell: &WorkCell) -> Result<(), DecodeError> {
    let expected = cell.arms.len();
    if got == expected {
        return Ok(());
    }
    Err(DecodeError::new("arms", format_args!("{expected} arms"), format_args!("{got} arms")))
}

fn check_finite(field: &str, numbers: &[f64]) -> Result<(), DecodeError> {
    match numbers.iter().position(|number| !number.is_finite()) {
        None => Ok(()),
        Some(bad) => {
            Err(DecodeError::new(format!("{field}[{bad}]"), "a finite number", numbers[bad]))
        }
    }
}

fn decode_opening(opening: f64) -> Result<f64, DecodeError> {
    within("opening", opening, "a number in [0, 1]", |opening| (0.0..=1.0).contains(&opening))
}

/// Returns `value` if it `fits`. NaN fits no range.
fn within(
    field: &str,
    value: f64,
    expected: &str,
    fits: impl Fn(f64) -> bool,
) -> Result<f64, DecodeError> {
    if fits(value) { Ok(value) } else { Err(DecodeError::new(field, expected, value)) }
}
