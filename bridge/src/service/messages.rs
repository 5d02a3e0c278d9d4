//! Conversions of the bridge's types to messages.

use tandem_core::ArmIndex;
use tandem_kinematics::plan::{MAX_STEP_M, MAX_WAYPOINTS};
use tandem_kinematics::{ForwardKinematics, Gaps, Joints, Motion, PlacedArm, WorkCell};
use tandem_proto::{DecodeError, pb};

use crate::cell_file::{Arm, ArmTiming};
use crate::driver::ArmReading;
use crate::executor::{CheckError, CheckedMotion, Checker, Phase, Stop, Token};
use crate::injection::{Fault, FaultKind};
use crate::service::Config;
use crate::service::execution::Outcome;
use crate::service::motion::MotionError;
use crate::service::reason_codes::{self, Values};
use crate::service::snapshot::Snapshot;

/// Hexadecimal digits of a token.
const TOKEN_DIGITS: usize = 32;

/// Encodes a token as text.
pub(super) fn token_text(token: Token) -> String {
    format!("{:032x}", token.0)
}

/// Decodes the token in field `field`.
pub(super) fn decode_token(field: &str, text: &str) -> Result<Token, DecodeError> {
    let is_token = text.len() == TOKEN_DIGITS && text.bytes().all(|b| b.is_ascii_hexdigit());
    match u128::from_str_radix(text, 16) {
        Ok(token) if is_token => Ok(Token(token)),
        // The error must not repeat a token, which is a secret.
        _ => {
            let got = format_args!("{} bytes", text.len()).to_string();
            Err(DecodeError::new(field, "the token that Acquire returned", got))
        }
    }
}

/// Describes the arms of `cell`, which are those of the cell file in `config`.
pub(super) fn describe_arms(cell: &WorkCell, config: &Config) -> Vec<pb::ArmDescription> {
    let arms = cell.arms.iter().zip(&config.cell.arms).zip(&config.timings);
    arms.map(|((placed, arm), timing)| describe_arm(placed, arm, timing)).collect()
}

fn describe_arm(placed: &PlacedArm, arm: &Arm, timing: &ArmTiming) -> pb::ArmDescription {
    let joint = |joint: &tandem_kinematics::model::Joint| pb::JointDescription {
        low_rad: joint.range_rad[0],
        high_rad: joint.range_rad[1],
        speed_radps: joint.speed_radps,
        continuous: joint.continuous,
    };
    pb::ArmDescription {
        model: placed.model.name.to_owned(),
        base_in_world_m: coordinates(placed.base_in_world_m.into()),
        yaw_rad: placed.yaw_rad,
        joints: placed.model.joints.iter().map(joint).collect(),
        name: arm.name.clone(),
        lag_s: timing.lag_s,
        reaction_s: timing.reaction_s,
        brake_s: timing.brake_s,
        is_measured: arm.is_measured(),
    }
}

pub(super) fn task_frame(cell: &WorkCell) -> pb::TaskFrameDescription {
    let frame = cell.task_frame;
    pb::TaskFrameDescription { scale: frame.scale, centre_m: frame.centre_m, lift_m: frame.lift_m }
}

/// The limits of the arms; `speed` is the upper bound of all motions.
pub(super) fn limits(checker: &Checker, speed: f64) -> pb::BridgeLimits {
    let settings = checker.settings();
    let check = &settings.check;
    pb::BridgeLimits {
        speed,
        tool_speed_mps: check.limits.tool_speed_mps,
        ramp_s: check.limits.ramp_s,
        opening_per_s: check.limits.gripper_opening_per_s,
        tilt_rad: check.tilt_rad,
        reach_share: check.reach_share,
        check_table_gap_m: check.table_gap_m,
        check_arms_gap_m: check.arms_gap_m,
        table_gap_m: settings.table_gap_m,
        arms_gap_m: settings.arms_gap_m,
        range_margin_rad: settings.range_margin_rad,
        start_rad: check.start_rad,
        duration_s: check.duration_s,
        tracking_rad: settings.tracking_rad,
        torque_nm: settings.torque_nm,
        owner_hold_s: settings.owner_hold_s,
        owner_stop_s: settings.owner_stop_s,
        lease_s: settings.lease_s,
        max_way_points: index(MAX_WAYPOINTS),
        max_step_m: MAX_STEP_M,
        check_self_gap_m: check.self_gap_m,
        self_gap_m: settings.self_gap_m,
        lag_s: settings.lag_s,
        reaction_s: settings.reaction_s,
        brake_s: settings.brake_s,
    }
}

/// Describes an accepted motion with the smallest gaps at its samples.
pub(super) fn accepted(checked: &CheckedMotion, cell: &WorkCell, speed: f64) -> pb::AcceptedMotion {
    let motion = checked.motion();
    let mut table_gap_m = vec![f64::INFINITY; cell.arms.len()];
    let mut arms_gap_m = f64::INFINITY;
    let mut self_gap_m = table_gap_m.clone();
    for sample in 0..motion.arms[0].len() {
        let gaps = gaps_at(motion, sample, cell);
        arms_gap_m = arms_gap_m.min(gaps.arms_m);
        for (least, gap) in table_gap_m.iter_mut().zip(gaps.table_m) {
            *least = least.min(gap);
        }
        for (least, gap) in self_gap_m.iter_mut().zip(gaps.self_m) {
            *least = least.min(gap);
        }
    }
    let duration_s = motion.duration_s();
    pb::AcceptedMotion { duration_s, speed, table_gap_m, arms_gap_m, self_gap_m }
}

fn gaps_at(motion: &Motion, sample: usize, cell: &WorkCell) -> Gaps {
    let samples = motion.arms.iter().map(|samples| &samples[sample]);
    let (angles, openings): (Vec<Joints>, Vec<f64>) =
        samples.map(|sample| (sample.angles, sample.gripper_opening)).unzip();
    cell.gaps_with(&angles, &openings)
}

/// Describes a refused motion.
pub(super) fn refusal(refused: &MotionError) -> pb::MotionRefusal {
    let (code, when_s, arm, waypoint) = match refused {
        MotionError::Plan(error) => {
            let (code, waypoint, arm) = reason_codes::of_plan(error);
            (code, None, arm, waypoint)
        }
        MotionError::Check(error) => {
            let (when_s, arm) = match error {
                CheckError::Refused(refusal) => (refusal.when_s, refusal.arm),
                CheckError::RangeMargin { when_s, arm, .. } => (*when_s, *arm),
            };
            (reason_codes::of_check(error), Some(when_s), Some(arm.0), None)
        }
    };
    pb::MotionRefusal {
        name: code.name.to_owned(),
        sentence: refused.to_string(),
        when_s,
        arm: arm.map(index),
        joint: code.joint.map(index),
        way_point: waypoint.map(index),
        got: code.values.map(|values| values.got),
        allowed: code.values.and_then(|values| values.allowed),
        unit: unit(code.values),
    }
}

pub(super) fn stop(stop: &Stop) -> pb::BridgeStop {
    let (name, values) = reason_codes::of_cause(&stop.cause);
    pb::BridgeStop {
        name: name.to_owned(),
        sentence: stop.to_string(),
        when_s: stop.when_s,
        arm: stop.arm.map(|arm| index(arm.0)),
        joint: stop.joint.map(index),
        got: values.map(|values| values.got),
        allowed: values.and_then(|values| values.allowed),
        unit: unit(values),
    }
}

pub(super) fn outcome(outcome: &Outcome) -> pb::MotionOutcome {
    use pb::motion_outcome::Outcome as O;
    let outcome = match outcome {
        Outcome::Done => O::Done(pb::MotionDone {}),
        Outcome::Stopped(why) => O::Stopped(stop(why)),
    };
    pb::MotionOutcome { outcome: Some(outcome) }
}

pub(super) fn phase(phase: Phase) -> pb::BridgePhase {
    match phase {
        Phase::Stopped => pb::BridgePhase::Stopped,
        Phase::Idle => pb::BridgePhase::Idle,
        Phase::Moving => pb::BridgePhase::Moving,
        Phase::Holding => pb::BridgePhase::Holding,
        Phase::Settling => pb::BridgePhase::Settling,
    }
}

/// The newest states of the arms; empty if there is no valid one.
pub(super) fn arms(snapshot: &Snapshot, cell: &WorkCell) -> Vec<pb::ArmState> {
    let Some(state) = &snapshot.state else { return Vec::new() };
    let reference = |arm: usize| snapshot.reference.as_ref().map(|all| all[arm]);
    let arms = state.arms.iter().zip(&cell.arms).enumerate();
    arms.map(|(idx, (reading, placed))| arm_state(reading, placed, reference(idx))).collect()
}

fn arm_state(reading: &ArmReading, placed: &PlacedArm, reference: Option<Joints>) -> pb::ArmState {
    let tool = |angles: &Joints| {
        let tool_in_base_m = ForwardKinematics::new(placed.model, angles).tool_m();
        coordinates((placed.world_from_base() * tool_in_base_m).into())
    };
    pb::ArmState {
        angles_rad: reading.angles.to_vec(),
        velocities_radps: reading.velocities.to_vec(),
        tool_in_world_m: tool(&reading.angles),
        opening: reading.opening,
        reference_rad: reference.map_or_else(Vec::new, |joints| joints.to_vec()),
        reference_tool_in_world_m: reference.map_or_else(Vec::new, |joints| tool(&joints)),
        drive_fault: reading.faults.drive,
        contact: reading.faults.contact,
        emergency_stop: reading.faults.emergency_stop,
    }
}

/// Decodes a fault of the arms of `cell`.
pub(super) fn decode_fault(
    message: pb::FaultInjection,
    cell: &WorkCell,
) -> Result<Fault, DecodeError> {
    use pb::InjectedFault as F;
    let kind = match message.fault() {
        F::Unspecified => {
            return Err(DecodeError::new("fault", "an injected fault", message.fault));
        }
        F::EmergencyStop => FaultKind::EmergencyStop,
        F::DriveFault => FaultKind::DriveFault,
        F::Contact => FaultKind::Contact,
        F::BlockedJoint => FaultKind::BlockedJoint,
        F::Torque => FaultKind::Torque,
        F::Drift => FaultKind::Drift,
        F::LateStates => FaultKind::LateStates,
    };
    let in_range = |field: &str, got: u32, count: usize| match usize::try_from(got) {
        Ok(index) if index < count => Ok(index),
        _ => Err(DecodeError::new(field, format_args!("an index below {count}"), got)),
    };
    let arm = in_range("arm", message.arm, cell.arms.len())?;
    let joint = in_range("joint", message.joint, cell.arms[arm].model.n_joints())?;
    Ok(Fault { kind, arm: ArmIndex(arm), joint })
}

pub(super) fn fault(fault: Fault) -> pb::FaultInjection {
    use pb::InjectedFault as F;
    let kind = match fault.kind {
        FaultKind::EmergencyStop => F::EmergencyStop,
        FaultKind::DriveFault => F::DriveFault,
        FaultKind::Contact => F::Contact,
        FaultKind::BlockedJoint => F::BlockedJoint,
        FaultKind::Torque => F::Torque,
        FaultKind::Drift => F::Drift,
        FaultKind::LateStates => F::LateStates,
    };
    let (arm, joint) = (index(fault.arm.0), index(fault.joint));
    pb::FaultInjection { fault: kind.into(), arm, joint }
}

fn unit(values: Option<Values>) -> String {
    values.map_or_else(String::new, |values| values.unit.to_owned())
}

fn coordinates(point: [f64; 3]) -> Vec<f64> {
    point.to_vec()
}

fn index(index: usize) -> u32 {
    u32::try_from(index).expect("arms, joints and waypoints number a few thousand at most")
}
