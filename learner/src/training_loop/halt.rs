//! The reasons for which the loop stops before the run has reached a limit.

use tandem_rl::ddpg::DdpgError;

use crate::advice_account::TeacherError;
use crate::error::Error;

/// The reason for which the loop stops before the run has reached a limit.
#[derive(Debug)]
pub(super) enum Halt {
    /// Shutdown was requested; the run can resume.
    Interrupted,
    /// An error.
    Failed(Error),
}

impl From<Error> for Halt {
    fn from(error: Error) -> Self {
        Self::Failed(error)
    }
}

impl From<DdpgError> for Halt {
    fn from(error: DdpgError) -> Self {
        Self::Failed(error.into())
    }
}

impl From<TeacherError> for Halt {
    fn from(error: TeacherError) -> Self {
        match error {
            TeacherError::Stopped => Self::Interrupted,
            error => Self::Failed(error.into()),
        }
    }
}
