//! The last look before anything moves: a motion is refused with the first time at which it breaks a limit.
//!
//! The motion is checked as it is handed to the arms ([`Motion`]), whoever made it: samples, and between
//! them the cubic through both. Nothing is looked at in samples only:
//!
//! - Angles, speeds and openings: the cubic's extremes.
//! - Accelerations: the least with which any motion could pass both samples; a jump of an angle needs a huge one.
//! - Tool speed, tilt, reach and gaps (`sweep.rs`): at the middle of an interval, together with a bound on how fast each
//!   can change. Where that does not settle it, the interval is halved, until what may hide between is
//!   smaller than a stated tolerance: 0.1 mm for gaps and reach, 0.1 degrees for tilt, 2 mm/s for the tool's speed. So
//!   the whole swept motion keeps its clearances but for these tolerances.
//!
//! What is wrong as a whole (numbers of arms and samples, length, start) comes first, then the earliest interval that
//! breaks a limit; within one interval (10 ms) numbers and grippers, then joints, then the arms' shape, each
//! arm by arm.
//!
//! Gaps between parts of one arm are those with the gripper open as the motion has it, the wider of an interval's ends. There
//! is no limit of the jerk: an acceleration may change from one sample to the next.

use tandem_core::ArmIndex;

use crate::joints::Joints;
use crate::limits::Limits;
use crate::model::{ArmModel, Joint};
use crate::motion::{ArmSample, Cubic, Motion};
use crate::refusal::{Excess, Reason, Refusal};
use crate::self_collision::SELF_GAP_M;
use crate::work_cell::WorkCell;

mod continuous;

use continuous::Sweep;

/// Slack for rounding: limits hold to one part in a billion.
const ROUNDING: f64 = 1e-9;
/// Rates below this are rest, radians per second.
const REST_RADPS: f64 = 1e-6;

/// What a motion has to keep.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CheckSettings {
    /// Speeds and accelerations. Those of the joints are the arm's own.
    pub limits: Limits,
    /// Largest angle between the way a gripper points and straight down, radians.
    pub tilt_rad: f64,
    /// Largest distance of the tool from the shoulder as a share of the arm's reach: near 1 the posture is singular.
    pub reach_share: f64,
    /// Smallest gap between an arm's parts, its base aside, and the table, metres.
    pub table_gap_m: f64,
    /// Smallest gap between the parts of two arms, metres.
    pub arms_gap_m: f64,
    /// Smallest gap between parts of one arm that can meet ([`SelfPair`](crate::self_collision::SelfPair)), metres.
    pub self_gap_m: f64,
    /// Largest difference between a joint's first angle and where it is, radians.
    pub start_rad: f64,
    /// Longest motion, seconds.
    pub duration_s: f64,
}

impl Default for CheckSettings {
    /// Tilt up to 25 degrees, reach up to 97 per cent, 2 mm above the table, 20 mm between arms, 5 mm between parts of one
    /// arm, a start within 1 degree, at most 10 minutes.
    fn default() -> Self {
        Self {
            limits: Limits::default(),
            tilt_rad: 25.0_f64.to_radians(),
            reach_share: 0.97,
            table_gap_m: 0.002,
            arms_gap_m: 0.020,
            self_gap_m: SELF_GAP_M,
            start_rad: 1.0_f64.to_radians(),
            duration_s: 600.0,
        }
    }
}

/// Passes a motion that keeps every limit from where the arms are: `at`, joint angles in radians, arm by arm.
///
/// # Errors
/// Names the first limit that is broken, and when.
pub fn check(
    cell: &WorkCell,
    motion: &Motion,
    at: &[Joints],
    settings: &CheckSettings,
) -> Result<(), Refusal> {
    check_settings(settings)?;
    check_shape(cell, motion, at, settings)?;
    for (arm, (samples, at)) in motion.arms.iter().zip(at).enumerate() {
        check_start(ArmIndex(arm), &samples[0], at, settings.start_rad)?;
        check_rest(ArmIndex(arm), 0.0, &samples[0])?;
    }
    let mut sweep = Sweep::new(cell, settings);
    let n_intervals = motion.arms[0].len() - 1;
    for interval in 0..n_intervals {
        let when_s = interval as f64 * motion.period_s;
        for (arm, placed) in cell.indexed() {
            let pair = Pair {
                from: &motion.arms[arm.0][interval],
                to: &motion.arms[arm.0][interval + 1],
                period_s: motion.period_s,
            };
            let cubics = pair.checked(placed.model, &settings.limits);
            let cubics = cubics.map_err(|(reason, since_s)| reason.of(arm, when_s + since_s))?;
            sweep.follow(arm, cubics, pair.from.gripper_opening.max(pair.to.gripper_opening));
        }
        sweep.check(when_s, motion.period_s)?;
    }
    let end_s = n_intervals as f64 * motion.period_s;
    for (arm, samples) in motion.arms.iter().enumerate() {
        check_rest(ArmIndex(arm), end_s, &samples[n_intervals])?;
    }
    Ok(())
}

/// Two samples of an arm, one after the other.
struct Pair<'a> {
    from: &'a ArmSample,
    to: &'a ArmSample,
    period_s: f64,
}

impl Pair<'_> {
    /// The joints' motion between the samples, or what is wrong with the arm alone and when, seconds after the first.
    fn checked(&self, model: &ArmModel, limits: &Limits) -> Result<Vec<Cubic>, (Reason, f64)> {
        for (sample, since_s) in [(self.from, 0.0), (self.to, self.period_s)] {
            if !(sample.angles.is_finite() && sample.velocities.is_finite()) {
                return Err((Reason::NotFinite, since_s));
            }
            if !sample.gripper_opening.is_finite() {
                return Err((Reason::NotFinite, since_s));
            }
            if !(0.0..=1.0).contains(&sample.gripper_opening) {
                return Err((Reason::GripperOpening(sample.gripper_opening), since_s));
            }
        }
        let gripper_opening_per_s =
            (self.to.gripper_opening - self.from.gripper_opening).abs() / self.period_s;
        if let Some(excess) = excess(gripper_opening_per_s, limits.gripper_opening_per_s) {
            return Err((Reason::GripperSpeed(excess), 0.0));
        }
        let joints = model.joints.iter().enumerate();
        joints.map(|(idx, joint)| self.checked_joint(idx, joint, limits)).collect()
    }

    fn checked_joint(
        &self,
        idx: usize,
        joint: &Joint,
        limits: &Limits,
    ) -> Result<Cubic, (Reason, f64)> {
        let cubic = Cubic::between(self.from, self.to, idx, self.period_s);
        let [low, high] = joint.range_rad;
        let [lowest, highest] = cubic.angle_bounds();
        if lowest < low - ROUNDING || highest > high + ROUNDING {
            let got_rad = if lowest < low { lowest } else { highest };
            return Err((Reason::JointRange(idx, got_rad, joint.range_rad), 0.0));
        }
        let allowed = joint.speed_radps / limits.ramp_s;
        if let Some(excess) = excess(cubic.least_acceleration(), allowed) {
            return Err((Reason::JointAcceleration(idx, excess), 0.0));
        }
        if let Some(excess) = excess(cubic.largest_rate(), joint.speed_radps) {
            return Err((Reason::JointSpeed(idx, excess), 0.0));
        }
        Ok(cubic)
    }
}

/// What is out of its limit, when it is.
fn excess(got: f64, allowed: f64) -> Option<Excess> {
    (got > allowed * (1.0 + ROUNDING)).then_some(Excess { got, allowed })
}

fn check_settings(settings: &CheckSettings) -> Result<(), Refusal> {
    let least_zero = [
        ("tilt_rad", settings.tilt_rad),
        ("reach_share", settings.reach_share),
        ("table_gap_m", settings.table_gap_m),
        ("arms_gap_m", settings.arms_gap_m),
        ("self_gap_m", settings.self_gap_m),
        ("start_rad", settings.start_rad),
        ("duration_s", settings.duration_s),
    ];
    let bad = least_zero.into_iter().find(|(_, value)| !(value.is_finite() && *value >= 0.0));
    match settings.limits.bad_setting().or(bad) {
        Some((name, value)) => Err(Reason::Setting(name, value).of(ArmIndex(0), 0.0)),
        None => Ok(()),
    }
}

/// Arms, samples and joints are as many as the cell has, and the motion is neither empty nor too long.
fn check_shape(
    cell: &WorkCell,
    motion: &Motion,
    at: &[Joints],
    settings: &CheckSettings,
) -> Result<(), Refusal> {
    let expected = cell.arms.len();
    for got in [motion.arms.len(), at.len()] {
        if got != expected || got == 0 {
            return Err(Reason::Arms { got, expected }.of(ArmIndex(0), 0.0));
        }
    }
    let n_samples = motion.arms[0].len().max(2);
    for (arm, placed) in cell.indexed() {
        let (samples, n_joints) = (&motion.arms[arm.0], placed.model.n_joints());
        if samples.len() != n_samples {
            let reason = Reason::Samples { got: samples.len(), expected: n_samples };
            return Err(reason.of(arm, 0.0));
        }
        let wrong = |got: usize, when_s: f64| {
            (got != n_joints).then(|| Reason::Joints { got, expected: n_joints }.of(arm, when_s))
        };
        let of_samples = samples.iter().enumerate().find_map(|(idx, sample)| {
            let when_s = idx as f64 * motion.period_s;
            wrong(sample.angles.len(), when_s).or_else(|| wrong(sample.velocities.len(), when_s))
        });
        if let Some(refusal) = wrong(at[arm.0].len(), 0.0).or(of_samples) {
            return Err(refusal);
        }
    }
    let (got, allowed) = ((n_samples - 1) as f64 * motion.period_s, settings.duration_s);
    if got > 0.0 && got <= allowed {
        Ok(())
    } else {
        Err(Reason::Duration(Excess { got, allowed }).of(ArmIndex(0), 0.0))
    }
}

/// The arm is where the motion begins; NaN is nowhere.
fn check_start(arm: ArmIndex, first: &ArmSample, at: &Joints, allowed: f64) -> Result<(), Refusal> {
    if !(first.angles.is_finite() && at.is_finite()) {
        return Err(Reason::NotFinite.of(arm, 0.0));
    }
    for (joint, (begins, at)) in first.angles.iter().zip(at.iter()).enumerate() {
        let got = (begins - at).abs();
        if got > allowed {
            return Err(Reason::Start(joint, Excess { got, allowed }).of(arm, 0.0));
        }
    }
    Ok(())
}

fn check_rest(arm: ArmIndex, when_s: f64, sample: &ArmSample) -> Result<(), Refusal> {
    if !sample.velocities.is_finite() {
        return Err(Reason::NotFinite.of(arm, when_s));
    }
    for (joint, rate) in sample.velocities.iter().enumerate() {
        if rate.abs() > REST_RADPS {
            return Err(Reason::NotAtRest(joint, *rate).of(arm, when_s));
        }
    }
    Ok(())
}
