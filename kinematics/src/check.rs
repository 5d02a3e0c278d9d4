//! The check: accepts a motion or refuses it with the first time at which it violates a limit.
//!
//! The check examines the samples that the arms receive ([`Motion`]), regardless of their origin, and the cubics
//! between them. No limit is checked at samples only:
//!
//! - Angles, speeds and gripper openings: the extremes of the cubic.
//! - Accelerations: the smallest limit under which any motion connects the two samples. A jump of an angle needs a very
//!   large one.
//! - Tool speed, tilt, reach and gaps: a continuous check, which bounds how fast each quantity can change between the
//!   points at which it is evaluated. It bisects an interval until at most a stated tolerance is left: 0.1 mm for gaps
//!   and reach, 0.1 degrees for tilt, 2 mm/s for the tool's speed. Up to these tolerances the whole swept volume keeps
//!   its gaps.
//!
//! Violations of the motion as a whole (numbers of arms and samples, duration, start) are reported first, then the
//! earliest interval that violates a limit. Within one interval (10 ms) numbers and grippers come first, then joints,
//! then the arms' shape, each arm by arm.
//!
//! Gaps between parts of one arm use the wider gripper opening of an interval's two ends. The jerk is not limited: an
//! acceleration may change from one sample to the next.

mod continuous;
mod settings;

use tandem_core::ArmIndex;

use self::continuous::ContinuousCheck;
pub use self::settings::CheckSettings;
use crate::joints::Joints;
use crate::limits::Limits;
use crate::model::{ArmModel, Joint};
use crate::motion::{ArmSample, Cubic, Motion};
use crate::refusal::{Excess, Reason, Refusal};
use crate::work_cell::WorkCell;

/// The relative slack of limits for rounding.
const ROUNDING: f64 = 1e-9;
/// Velocities below this count as rest, radians per second.
const REST_RADPS: f64 = 1e-6;

/// Checks that `motion` keeps every limit. `at` gives the arms' present joint angles, radians, arm by arm: the motion
/// begins there, within [`CheckSettings::start_rad`]. It begins and ends at rest.
///
/// # Errors
/// Returns the first limit that the motion violates, and when. Settings that are out of range, and numbers of arms,
/// joints or samples that do not match, are refused too.
pub fn check(
    cell: &WorkCell,
    motion: &Motion,
    at: &[Joints],
    settings: &CheckSettings,
) -> Result<(), Refusal> {
    settings.validate()?;
    check_shape(cell, motion, at)?;
    check_duration(motion, settings.duration_s)?;
    for (arm, (samples, at)) in motion.arms.iter().zip(at).enumerate() {
        check_start(ArmIndex(arm), &samples[0], at, settings.start_rad)?;
        check_rest(ArmIndex(arm), 0.0, &samples[0])?;
    }
    let mut continuous = ContinuousCheck::new(cell, settings);
    let n_intervals = motion.arms[0].len() - 1;
    for interval in 0..n_intervals {
        let when_s = interval as f64 * motion.period_s;
        for (arm, placed) in cell.indexed() {
            let samples = &motion.arms[arm.0];
            let (from, to) = (&samples[interval], &samples[interval + 1]);
            let cubics = Interval { from, to, period_s: motion.period_s }
                .checked_cubics(placed.model, &settings.limits)
                .map_err(|(reason, since_s)| reason.at(arm, when_s + since_s))?;
            let gripper_opening = from.gripper_opening.max(to.gripper_opening);
            continuous.set_interval(arm, cubics, gripper_opening);
        }
        continuous.check(when_s, motion.period_s)?;
    }
    let end_s = n_intervals as f64 * motion.period_s;
    for (arm, samples) in motion.arms.iter().enumerate() {
        check_rest(ArmIndex(arm), end_s, &samples[n_intervals])?;
    }
    Ok(())
}

/// Two consecutive samples of an arm.
struct Interval<'a> {
    from: &'a ArmSample,
    to: &'a ArmSample,
    period_s: f64,
}

impl Interval<'_> {
    /// Returns the cubics of the joints, or the first violation of the arm alone and its time, seconds after the first
    /// sample.
    fn checked_cubics(
        &self,
        model: &ArmModel,
        limits: &Limits,
    ) -> Result<Vec<Cubic>, (Reason, f64)> {
        for (sample, since_s) in [(self.from, 0.0), (self.to, self.period_s)] {
            let is_finite = sample.angles.is_finite() && sample.velocities.is_finite();
            if !(is_finite && sample.gripper_opening.is_finite()) {
                return Err((Reason::NotFinite, since_s));
            }
            if !(0.0..=1.0).contains(&sample.gripper_opening) {
                return Err((Reason::GripperOpening(sample.gripper_opening), since_s));
            }
        }
        let opens_by = (self.to.gripper_opening - self.from.gripper_opening).abs();
        if let Some(excess) = excess(opens_by / self.period_s, limits.gripper_opening_per_s) {
            return Err((Reason::GripperSpeed(excess), 0.0));
        }
        let joints = model.joints.iter().enumerate();
        joints.map(|(idx, joint)| self.checked_cubic(idx, joint, limits)).collect()
    }

    fn checked_cubic(
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

fn excess(got: f64, allowed: f64) -> Option<Excess> {
    (got > allowed * (1.0 + ROUNDING)).then_some(Excess { got, allowed })
}

/// Checks that arms, samples and joints match the cell.
fn check_shape(cell: &WorkCell, motion: &Motion, at: &[Joints]) -> Result<(), Refusal> {
    let expected = cell.arms.len();
    for got in [motion.arms.len(), at.len()] {
        if got != expected || got == 0 {
            return Err(Reason::Arms { got, expected }.at(ArmIndex(0), 0.0));
        }
    }
    let n_samples = motion.arms[0].len().max(2);
    for (arm, placed) in cell.indexed() {
        let (samples, n_joints) = (&motion.arms[arm.0], placed.model.n_joints());
        if samples.len() != n_samples {
            let reason = Reason::Samples { got: samples.len(), expected: n_samples };
            return Err(reason.at(arm, 0.0));
        }
        let wrong = |got: usize, when_s: f64| {
            (got != n_joints).then(|| Reason::Joints { got, expected: n_joints }.at(arm, when_s))
        };
        let of_samples = samples.iter().enumerate().find_map(|(idx, sample)| {
            let when_s = idx as f64 * motion.period_s;
            wrong(sample.angles.len(), when_s).or_else(|| wrong(sample.velocities.len(), when_s))
        });
        if let Some(refusal) = wrong(at[arm.0].len(), 0.0).or(of_samples) {
            return Err(refusal);
        }
    }
    Ok(())
}

/// Checks that the duration is positive and at most `allowed`, seconds.
fn check_duration(motion: &Motion, allowed: f64) -> Result<(), Refusal> {
    let got = motion.duration_s();
    if got > 0.0 && got <= allowed {
        return Ok(());
    }
    Err(Reason::Duration(Excess { got, allowed }).at(ArmIndex(0), 0.0))
}

/// Checks that the arm is within `allowed` radians of the first sample.
fn check_start(arm: ArmIndex, first: &ArmSample, at: &Joints, allowed: f64) -> Result<(), Refusal> {
    if !(first.angles.is_finite() && at.is_finite()) {
        return Err(Reason::NotFinite.at(arm, 0.0));
    }
    for (joint, (first, at)) in first.angles.iter().zip(at.iter()).enumerate() {
        let got = (first - at).abs();
        if got > allowed {
            return Err(Reason::Start(joint, Excess { got, allowed }).at(arm, 0.0));
        }
    }
    Ok(())
}

fn check_rest(arm: ArmIndex, when_s: f64, sample: &ArmSample) -> Result<(), Refusal> {
    if !sample.velocities.is_finite() {
        return Err(Reason::NotFinite.at(arm, when_s));
    }
    for (joint, rate) in sample.velocities.iter().enumerate() {
        if rate.abs() > REST_RADPS {
            return Err(Reason::NotAtRest(joint, *rate).at(arm, when_s));
        }
    }
    Ok(())
}
