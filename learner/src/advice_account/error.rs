//! The error of a failed call to the teacher.

use tandem_core::task::TaskDifference;
use tandem_net::ClientConfigError;
use tandem_proto::DecodeError;
use tonic::{Code, Status};

/// A failed call to the teacher.
#[derive(Debug, thiserror::Error)]
pub enum TeacherError {
    /// The address is malformed.
    #[error("the teacher cannot be called")]
    Address(#[from] ClientConfigError),
    /// The teacher refused; a retry would not help.
    #[error("the teacher refuses to {what}: {reason}")]
    Refused {
        /// The request.
        what: &'static str,
        /// The reason that it gave.
        reason: String,
    },
    /// The teacher's response cannot be decoded.
    #[error("the teacher's task cannot be read")]
    Malformed(#[from] DecodeError),
    /// The teacher advises on another task.
    #[error(
        "the teacher is for another task than one arm of the run's: {} is {} in the run and {} at the teacher",
        .0.field, .0.first, .0.second
    )]
    OtherTask(TaskDifference),
    /// The teacher does not know the account.
    #[error("the teacher does not know the account: {0}")]
    UnknownAccount(String),
    /// The run was stopped while the teacher was unreachable.
    #[error("stopped while waiting for the teacher")]
    Stopped,
}

impl TeacherError {
    /// Returns the error for a status that a retry would not cure.
    pub(super) fn of(what: &'static str, status: &Status) -> Self {
        let reason = status.message().to_owned();
        match status.code() {
            Code::NotFound => Self::UnknownAccount(reason),
            _ => Self::Refused { what, reason },
        }
    }
}
