//! The errors of starts and resets.

use tandem_core::ArmIndex;
use tandem_kinematics::{Excess, Refusal};

use crate::driver::DriverError;
use crate::executor::checked::CheckError;
use crate::executor::lease::LeaseError;
use crate::executor::state::Phase;
use crate::executor::stop::StopCause;

/// The number of consecutive good states that a reset requires.
pub(crate) const GOOD_STATES: u32 = 10;

/// The reason why a motion was not started.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum StartError {
    /// The client does not own the arms.
    #[error(transparent)]
    Lease(#[from] LeaseError),
    /// The arms are not idle.
    #[error("the arms are not idle but {0:?}")]
    NotIdle(Phase),
    /// The speed is not in (0, 1].
    #[error("speed {0}, expected more than 0 and at most 1")]
    Speed(f64),
    /// There is no valid state, or it is too old.
    #[error("the position of the arms is not known")]
    NoState,
    /// The motion breaks a limit.
    #[error("the motion is refused")]
    Refused(#[from] Refusal),
    /// The motion comes too near to the end of a joint's range; radians.
    #[error("the motion is refused: at {when_s:.3} s arm {}: joint {} comes within {:.2} degrees of the end of its range, at least {:.2}",
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
    /// A joint still moves.
    #[error("the arms still move")]
    Moving,
    /// The motion was checked for other arms or settings.
    #[error("the motion was checked for another executor")]
    OtherChecker,
}

impl From<CheckError> for StartError {
    fn from(error: CheckError) -> Self {
        match error {
            CheckError::Refused(refusal) => Self::Refused(refusal),
            CheckError::RangeMargin { when_s, arm, joint, excess } => {
                Self::RangeMargin { when_s, arm, joint, excess }
            }
        }
    }
}

/// Returns the beginning of a message about an arm.
fn named(arm: Option<ArmIndex>) -> String {
    arm.map_or_else(String::new, |arm| format!("arm {}: ", arm.0))
}

/// Returns what a message says about the newest state.
fn advice(rejected: Option<&StopCause>) -> String {
    rejected
        .map_or_else(|| "try again".to_owned(), |cause| format!("the newest has a fault: {cause}"))
}

/// The reason why stopped arms were not reset.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ResetError {
    /// The client does not own the arms.
    #[error(transparent)]
    Lease(#[from] LeaseError),
    /// A motion is in progress.
    #[error("the arms are not stopped but {0:?}")]
    NotStopped(Phase),
    /// An arm reports a fault, or a torque beyond the limit.
    #[error("arm {}: {cause}", .arm.0)]
    Reported {
        /// The arm.
        arm: ArmIndex,
        /// The cause for which the arms would be stopped again.
        cause: StopCause,
    },
    /// There is no connection to the arms.
    #[error(transparent)]
    Driver(DriverError),
    /// An arm is beyond a limit at which it would be stopped again.
    #[error("{}{cause}: move the arm clear by hand, or correct the cell file", named(*.arm))]
    Limit {
        /// The arm, if the limit concerns one.
        arm: Option<ArmIndex>,
        /// The cause for which the arms would be stopped again.
        cause: StopCause,
    },
    /// There have been too few consecutive good states.
    #[error("{got} good states in a row, at least {GOOD_STATES} are needed: {}", advice(.rejected.as_ref()))]
    States {
        /// The number of consecutive good states.
        got: u32,
        /// The fault of the newest state, if it has one.
        rejected: Option<StopCause>,
    },
    /// The arms have not confirmed the last order to stop.
    #[error("the arms have not confirmed the last stop: try again")]
    Unconfirmed,
    /// A joint still moves.
    #[error("the arms still move")]
    Moving,
    /// The arms were stopped, or had a fault, after the call of the reset.
    #[error("stopped meanwhile ({cause}): inspect the arms and reset again")]
    StoppedMeanwhile {
        /// The cause of the newest stop.
        cause: StopCause,
    },
    /// The connection works and is not replaced.
    #[error("the arms are connected: reset them")]
    Connected,
}

impl ResetError {
    /// Returns true if a later reset may succeed by itself: the arms brake, or too few good states have arrived so far.
    pub(crate) fn may_pass(&self) -> bool {
        matches!(self, Self::States { rejected: None, .. } | Self::Unconfirmed | Self::Moving)
    }
}
