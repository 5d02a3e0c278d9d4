//! Reasons why a measurement fails.

use tandem_net::{ClientConfigError, ServerConfigError};
use tandem_rl::config::ConfigError;
use tandem_sim::SimError;
use tonic::Status;

/// The reason why a measurement fails.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The simulated environment failed.
    #[error(transparent)]
    World(#[from] SimError),
    /// The settings of the measured networks are invalid.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The measured policy is invalid.
    #[error(transparent)]
    Policy(#[from] tandem_policy::Error),
    /// A socket, a thread or a runtime cannot be created.
    #[error("cannot start a service")]
    Start(#[source] std::io::Error),
    /// The address of a service cannot be called.
    #[error("cannot call the service")]
    Address(#[from] ClientConfigError),
    /// The teacher service failed.
    #[error(transparent)]
    Teacher(#[from] tandem_teacher::Error),
    /// The echo service cannot be configured.
    #[error(transparent)]
    EchoConfig(#[from] ServerConfigError),
    /// The echo service failed.
    #[error("the echo service failed")]
    Echo(#[from] tonic::transport::Error),
    /// A call failed.
    #[error("a call failed")]
    Call(#[from] Status),
    /// A stream of responses ended before its last response.
    #[error("the stream has ended")]
    StreamEnded,
    /// A thread or a task of the measurement panicked.
    #[error("a service or a client panicked")]
    Panicked,
    /// The learner rejects the idle workers.
    #[error("the learner rejects workers: {0}")]
    Rejected(String),
}
