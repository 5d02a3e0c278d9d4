//! What can go wrong with the service.

use std::time::Duration;

use tandem_proto::DecodeError;
use tonic::Status;

use crate::driver::DriverError;
use crate::executor::{CheckError, LeaseError, ResetError, StartError};
use crate::service::motion::Refused;

/// Why a call was not done, or the service ended.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A request does not hold what it must.
    #[error(transparent)]
    Request(#[from] DecodeError),
    /// Whoever asks does not own the arms.
    #[error(transparent)]
    Lease(#[from] LeaseError),
    /// The arms were not let go.
    #[error(transparent)]
    Reset(#[from] ResetError),
    /// No new connection could be made in the place of one that has failed.
    #[error("{0}")]
    Dial(#[source] DriverError),
    /// The motion was not started.
    #[error(transparent)]
    Start(#[from] StartError),
    /// The motion is refused.
    #[error("the motion is refused: {0}")]
    Refused(#[from] Refused),
    /// The position of the arms is not known, so no motion can be checked.
    #[error("the position of the arms is not known: see the status")]
    NoState,
    /// The drives could not be told to stop.
    #[error("the drives could NOT be commanded to stop, use the emergency stop: {0}")]
    Untold(#[source] DriverError),
    /// The thread that moves the arms has not answered.
    #[error("the thread that moves the arms has not answered within {0:?}: see the status")]
    Overdue(Duration),
    /// The stream of a motion ended before it began.
    #[error("the stream ended, or said nothing of use, before the motion began")]
    Left,
    /// The stream of a motion broke before it began.
    #[error("the stream broke before the motion began: {}", .0.message())]
    Broken(Status),
    /// The check of another motion takes its time.
    #[error("other motions are being checked: try again")]
    Busy,
    /// The thread that moves the arms has ended, and with it the service.
    #[error("the bridge ends and has stopped the drives")]
    Ended,
    /// The thread that moves the arms has panicked, and the service ends.
    #[error("the bridge has a bug, has stopped the drives and ends: its log says more")]
    Panicked,
    /// The thread that moves the arms did not end in time.
    #[error("the driver did not come back: the drives were not told to stop by the service's end")]
    Stuck,
    /// The thread that moves the arms cannot be started.
    #[error("cannot start a thread")]
    Thread(#[source] std::io::Error),
    /// The service cannot be offered.
    #[error(transparent)]
    Gate(#[from] tandem_net::ServerConfigError),
    /// The server stopped unasked.
    #[error("cannot serve")]
    Transport(#[from] tonic::transport::Error),
}

/// What a client is told of an error.
pub(super) fn status(error: &Error) -> Status {
    let message = error.to_string();
    match error {
        Error::Request(_) => Status::invalid_argument(message),
        Error::Lease(error)
        | Error::Reset(ResetError::Lease(error))
        | Error::Start(StartError::Lease(error)) => match error {
            LeaseError::Held { .. } => Status::permission_denied(message),
            LeaseError::Nobody => Status::failed_precondition(message),
        },
        Error::Start(StartError::Refused(refusal)) => {
            // The refusal itself stands in the error's source.
            Status::failed_precondition(format!("{message}: {refusal}"))
        }
        Error::Reset(_) | Error::Start(_) | Error::Refused(_) | Error::NoState => {
            Status::failed_precondition(message)
        }
        Error::Left => Status::cancelled(message),
        Error::Broken(status) => Status::new(status.code(), message),
        Error::Busy => Status::resource_exhausted(message),
        Error::Ended | Error::Dial(_) => Status::unavailable(message),
        Error::Overdue(_) | Error::Untold(_) => {
            tracing::error!(%error, "request failed");
            Status::unavailable(message)
        }
        Error::Panicked
        | Error::Stuck
        | Error::Thread(_)
        | Error::Gate(_)
        | Error::Transport(_) => {
            tracing::error!(%error, "request failed");
            Status::internal(message)
        }
    }
}

impl From<CheckError> for Error {
    fn from(error: CheckError) -> Self {
        Self::Refused(error.into())
    }
}
