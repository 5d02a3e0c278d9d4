//! The bridge's own words as messages.

use tandem_kinematics::plan::{MAX_STEP_M, MAX_WAYPOINTS};
use tandem_kinematics::{ForwardKinematics, Gaps, Joints, Motion, PlacedArm, WorkCell};
use tandem_proto::{DecodeError, pb};

use crate::driver::ArmReading;
use crate::executor::{CheckError, CheckedMotion, Checker, Phase, Stop, Token};
use crate::service::execution::Outcome;
use crate::service::motion::Refused;
use crate::service::thread::Snapshot;
use crate::service::words::{self, Numbers};

/// Hexadecimal digits of a token.
const TOKEN_DIGITS: usize = 32;

/// A token as clients show it.
pub(super) fn token_text(token: Token) -> String {
    format!("{:032x}", token.0)
}

/// The token in field `field`.
pub(super) fn decode_token(field: &str, text: &str) -> Result<Token, DecodeError> {
    let is_token = text.len() == TOKEN_DIGITS && text.bytes().all(|b| b.is_ascii_hexdigit());
    match u128::from_str_radix(text, 16) {
        Ok(token) if is_token => Ok(Token(token)),
        // A token is a secret: what came instead is not repeated.
        _ => {
            let got = format_args!("{} bytes", text.len()).to_string();
            Err(DecodeError::new(field, "the token that Acquire gave", got))
        }
    }
}

pub(super) fn describe_arm(placed: &PlacedArm) -> pb::ArmDescription {
    let joint = |joint: &tandem_kinematics::model::Joint| pb::JointDescription {
        low_rad: joint.range_rad[0],
        high_rad: joint.range_rad[1],
        speed_radps: joint.speed_radps,
        continuous: joint.continuous,
    };
    pb::ArmDescription {
        model: placed.model.name.to_owned(),
        base_in_world_m: numbers_of(placed.base_in_world_m.into()),
        yaw_rad: placed.yaw_rad,
        joints: placed.model.joints.iter().map(joint).collect(),
    }
}

pub(super) fn task_frame(cell: &WorkCell) -> pb::TaskFrameDescription {
    let frame = cell.task_frame;
    pb::TaskFrameDescription { scale: frame.scale, centre_m: frame.centre_m, lift_m: frame.lift_m }
}

/// What the arms may do; `speed` is the bound of all motions.
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
    }
}

/// An accepted motion, with the smallest gaps at its samples.
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

/// A refused motion.
pub(super) fn refusal(refused: &Refused) -> pb::MotionRefusal {
    let (word, when_s, arm, way_point) = match refused {
        Refused::Plan(error) => {
            let (word, way_point, arm) = words::of_plan(error);
            (word, None, arm, way_point)
        }
        Refused::Check(error) => {
            let (when_s, arm) = match error {
                CheckError::Refused(refusal) => (refusal.when_s, refusal.arm),
                CheckError::RangeMargin { when_s, arm, .. } => (*when_s, *arm),
            };
            (words::of_check(error), Some(when_s), Some(arm.0), None)
        }
    };
    pb::MotionRefusal {
        name: word.name.to_owned(),
        sentence: refused.to_string(),
        when_s,
        arm: arm.map(index),
        joint: word.joint.map(index),
        way_point: way_point.map(index),
        got: word.numbers.map(|numbers| numbers.got),
        allowed: word.numbers.and_then(|numbers| numbers.allowed),
        unit: unit(word.numbers),
    }
}

pub(super) fn stop(stop: &Stop) -> pb::BridgeStop {
    let (name, numbers) = words::of_cause(&stop.cause);
    pb::BridgeStop {
        name: name.to_owned(),
        sentence: stop.to_string(),
        when_s: stop.when_s,
        arm: stop.arm.map(|arm| index(arm.0)),
        joint: stop.joint.map(index),
        got: numbers.map(|numbers| numbers.got),
        allowed: numbers.and_then(|numbers| numbers.allowed),
        unit: unit(numbers),
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

/// The arms as they were last seen; empty when their position is not known.
pub(super) fn arms(snapshot: &Snapshot, cell: &WorkCell) -> Vec<pb::ArmState> {
    let Some(state) = &snapshot.state else { return Vec::new() };
    let reference = |arm: usize| snapshot.reference.as_ref().map(|all| all[arm]);
    let arms = state.arms.iter().zip(&cell.arms).enumerate();
    arms.map(|(idx, (reading, placed))| arm_state(reading, placed, reference(idx))).collect()
}

fn arm_state(reading: &ArmReading, placed: &PlacedArm, reference: Option<Joints>) -> pb::ArmState {
    let tool = |angles: &Joints| {
        let tool_in_base_m = ForwardKinematics::new(placed.model, angles).tool_m();
        numbers_of((placed.world_from_base() * tool_in_base_m).into())
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

fn unit(numbers: Option<Numbers>) -> String {
    numbers.map_or_else(String::new, |numbers| numbers.unit.to_owned())
}

fn numbers_of(point: [f64; 3]) -> Vec<f64> {
    point.to_vec()
}

fn index(index: usize) -> u32 {
    u32::try_from(index).expect("arms, joints and way points are some thousand at most")
}
