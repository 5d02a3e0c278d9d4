//! Motions that have passed the check. The executor cannot wait for a check, so it receives motions that were checked
//! before.

use std::sync::Arc;

use tandem_core::ArmIndex;
use tandem_kinematics::{Excess, Joints, Motion, Reason, Refusal, WorkCell, check};

use crate::executor::settings::Settings;

/// Checks motions for one executor, on any thread. The check of a long motion takes far longer than a period.
#[derive(Debug, Clone)]
pub struct Checker(Arc<CheckerInner>);

#[derive(Debug)]
struct CheckerInner {
    cell: WorkCell,
    settings: Settings,
}

/// A motion that has passed the check of an executor's own [`Checker`], which is the only way to create one.
#[derive(Debug, Clone)]
pub struct CheckedMotion {
    motion: Motion,
    passed: Checker,
}

/// The fault of a motion.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CheckError {
    /// The motion breaks a limit.
    #[error(transparent)]
    Refused(#[from] Refusal),
    /// The motion comes too near to the end of a joint's range; radians.
    #[error("at {when_s:.3} s arm {}: joint {} comes within {:.2} degrees of the end of its range, at least {:.2}",
        .arm.0, .joint + 1, .excess.got.to_degrees(), .excess.allowed.to_degrees())]
    RangeMargin {
        /// The time since the start of the motion, seconds.
        when_s: f64,
        /// The arm.
        arm: ArmIndex,
        /// The joint, counted from 0.
        joint: usize,
        /// The distance to the end of the range, and the smallest allowed one.
        excess: Excess,
    },
}

impl Checker {
    pub(crate) fn new(cell: WorkCell, settings: Settings) -> Self {
        Self(Arc::new(CheckerInner { cell, settings }))
    }

    /// The arms that motions are checked for.
    #[must_use]
    pub fn cell(&self) -> &WorkCell {
        &self.0.cell
    }

    /// The limits that motions have to keep.
    #[must_use]
    pub fn settings(&self) -> &Settings {
        &self.0.settings
    }

    /// Accepts a motion that starts at the joint angles `at` (radians, arm by arm) and keeps every limit.
    ///
    /// # Errors
    /// Returns the first limit that the motion breaks.
    pub fn check(&self, motion: Motion, at: &[Joints]) -> Result<CheckedMotion, CheckError> {
        check(self.cell(), &motion, at, &self.settings().check)?;
        self.check_margins(&motion)?;
        Ok(CheckedMotion { motion, passed: self.clone() })
    }

    /// Checks that every sample keeps the margin to the ends of the joints' ranges.
    fn check_margins(&self, motion: &Motion) -> Result<(), CheckError> {
        let allowed = self.settings().range_margin_rad;
        for (arm, (samples, placed)) in motion.arms.iter().zip(&self.cell().arms).enumerate() {
            for (sample_idx, sample) in samples.iter().enumerate() {
                for (joint, limits) in placed.model.joints.iter().enumerate() {
                    let [low, high] = limits.range_rad;
                    let got = (sample.angles[joint] - low).min(high - sample.angles[joint]);
                    if got < allowed {
                        let when_s = sample_idx as f64 * motion.period_s;
                        let (arm, excess) = (ArmIndex(arm), Excess { got, allowed });
                        return Err(CheckError::RangeMargin { when_s, arm, joint, excess });
                    }
                }
            }
        }
        Ok(())
    }
}

impl CheckedMotion {
    /// The motion.
    #[must_use]
    pub fn motion(&self) -> &Motion {
        &self.motion
    }

    pub(crate) fn into_motion(self) -> Motion {
        self.motion
    }

    /// Returns true if the motion was checked for the executor that `checker` belongs to.
    pub(crate) fn passed(&self, checker: &Checker) -> bool {
        Arc::ptr_eq(&self.passed.0, &checker.0)
    }

    /// Checks that the motion begins at the joint angles `at`, radians, arm by arm.
    pub(crate) fn begins_at(&self, at: &[Joints]) -> Result<(), Refusal> {
        let allowed = self.passed.settings().check.start_rad;
        for (arm, (samples, at)) in self.motion.arms.iter().zip(at).enumerate() {
            for (joint, (begins, at)) in samples[0].angles.iter().zip(at.iter()).enumerate() {
                let got = (begins - at).abs();
                // NaN is no position.
                if got.is_nan() || got > allowed {
                    let reason = Reason::Start(joint, Excess { got, allowed });
                    return Err(Refusal { when_s: 0.0, arm: ArmIndex(arm), reason });
                }
            }
        }
        Ok(())
    }
}
