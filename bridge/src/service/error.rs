//! The errors of the service.

use std::time::Duration;

use tandem_proto::DecodeError;
use tonic::Status;

use crate::driver::DriverError;
use crate::executor::{CheckError, LeaseError, ResetError, StartError};
use crate::service::motion::MotionError;

/// The reason why a call failed or the service ended.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A request is malformed.
    #[error(transparent)]
    Request(#[from] DecodeError),
    /// The client does not own the arms.
    #[error(transparent)]
    Lease(#[from] LeaseError),
    /// The arms were not reset.
    #[error(transparent)]
    Reset(#[from] ResetError),
    /// A failed connection could not be replaced.
    #[error("{0}")]
    Reconnect(#[source] DriverError),
    /// The motion was not started.
    #[error(transparent)]
    Start(#[from] StartError),
    /// The motion is refused.
    #[error("the motion is refused: {0}")]
    Refused(#[from] MotionError),
    /// The position of the arms is not known, so no motion can be checked.
    #[error("the position of the arms is not known: see the status")]
    NoState,
    /// Faults cannot be injected into real arms.
    #[error("faults are injected into simulated arms only, and these are behind driver {driver:?}")]
    RealArms {
        /// The name of their driver.
        driver: String,
    },
    /// The drives could not be commanded to stop.
    #[error("the drives could NOT be commanded to stop, use the emergency stop: {0}")]
    StopFailed(#[source] DriverError),
    /// The arms have not confirmed the order to stop.
    #[error(
        "the order to stop was sent, but the arms have not confirmed it within {0:?}: use the emergency stop"
    )]
    StopUnconfirmed(Duration),
    /// The arms have confirmed the order to stop, but they move, or their states are not valid.
    #[error(
        "the arms have confirmed the stop but are not known to rest after {0:?}: use the emergency stop"
    )]
    NotAtRest(Duration),
    /// The thread that moves the arms has not answered.
    #[error("the thread that moves the arms has not answered within {0:?}: see the status")]
    Timeout(Duration),
    /// The stream of a motion ended before it began.
    #[error("the stream ended, or sent no start message, before the motion began")]
    StreamEnded,
    /// The stream of a motion broke before it began.
    #[error("the stream broke before the motion began: {}", .0.message())]
    StreamBroken(Status),
    /// Other motions are being checked.
    #[error("other motions are being checked: try again")]
    Busy,
    /// The service shuts down.
    #[error("the bridge is shutting down and has stopped the drives")]
    ShuttingDown,
    /// The thread that moves the arms has panicked, and the service ends.
    #[error("the bridge has a bug, has stopped the drives and shuts down: see its log")]
    Panicked,
    /// The thread that moves the arms did not end in time.
    #[error("the driver hangs: the service ended without stopping the drives")]
    DriverHung,
    /// The thread that moves the arms cannot be started.
    #[error("cannot start a thread")]
    Thread(#[source] std::io::Error),
    /// The service cannot be set up.
    #[error(transparent)]
    ServerConfig(#[from] tandem_net::ServerConfigError),
    /// The server failed.
    #[error("cannot serve")]
    Transport(#[from] tonic::transport::Error),
}

/// The status that clients receive.
impl From<Error> for Status {
    fn from(error: Error) -> Self {
        let message = error.to_string();
        match &error {
            Error::Request(_) => Self::invalid_argument(message),
            Error::Lease(error)
            | Error::Reset(ResetError::Lease(error))
            | Error::Start(StartError::Lease(error)) => match error {
                LeaseError::Held { .. } => Self::permission_denied(message),
                LeaseError::NotOwned => Self::failed_precondition(message),
            },
            Error::Start(StartError::Refused(refusal)) => {
                // The message does not contain the refusal, which is the error's source.
                Self::failed_precondition(format!("{message}: {refusal}"))
            }
            Error::Reset(_)
            | Error::Start(_)
            | Error::Refused(_)
            | Error::NoState
            | Error::RealArms { .. } => Self::failed_precondition(message),
            Error::StreamEnded => Self::cancelled(message),
            Error::StreamBroken(status) => Self::new(status.code(), message),
            Error::Busy => Self::resource_exhausted(message),
            Error::ShuttingDown | Error::Reconnect(_) => Self::unavailable(message),
            Error::Timeout(_)
            | Error::StopFailed(_)
            | Error::StopUnconfirmed(_)
            | Error::NotAtRest(_) => {
                tracing::error!(%error, "request failed");
                Self::unavailable(message)
            }
            Error::Panicked
            | Error::DriverHung
            | Error::Thread(_)
            | Error::ServerConfig(_)
            | Error::Transport(_) => {
                tracing::error!(%error, "request failed");
                Self::internal(message)
            }
        }
    }
}

impl From<CheckError> for Error {
    fn from(error: CheckError) -> Self {
        Self::Refused(error.into())
    }
}
