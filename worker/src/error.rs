//! Errors of a worker.

use tandem_core::task::TaskDifference;
use tandem_net::Operation;
use tandem_proto::DecodeError;
use tandem_sim::SimError;
use tonic::Status;

use crate::rollout::RolloutError;

/// The most episodes of a slot of a run's evaluation.
const EVALUATION_EPISODES: usize = 8;

/// An error that ends a worker. Waiting does not cure any of them.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// An address cannot be called.
    #[error("the {role} cannot be called")]
    Address {
        /// The peer with this address.
        role: &'static str,
        /// The cause.
        source: tandem_net::ClientConfigError,
    },
    /// A peer rejected a call, or its response cannot be used.
    #[error("cannot {attempted}")]
    Protocol {
        /// The purpose of the call.
        attempted: &'static str,
        /// The cause.
        source: CallError,
    },
    /// The run takes advice, but the worker has no teacher.
    #[error("the run takes advice on account {account:?}, but no teacher's address was given")]
    NoTeacher {
        /// The teacher's account.
        account: String,
    },
    /// The learner ordered advice in a run without an account.
    #[error("slot {slot} is to be advised, but the run's terms name no account")]
    NoAccount {
        /// The slot's number.
        slot: u64,
    },
    /// The server of the environments could not be started.
    #[error(transparent)]
    NoEnvironment(#[from] crate::config::ServerNotStarted),
    /// No simulator in this program has the run's task.
    #[error(
        "task {task:?} is not built-in, so its environments need a server: give the worker its address by --env"
    )]
    NotBuiltIn {
        /// The task's name.
        task: String,
    },
    /// The server serves another task than the run's.
    #[error(
        "the environment server {server} serves another task than the run's: {} is {} in the run and {} at the server",
        difference.field, difference.first, difference.second
    )]
    OtherTask {
        /// Address and program of the server.
        server: String,
        /// The first field that differs.
        difference: TaskDifference,
    },
    /// The server serves fewer environments than a slot has episodes.
    #[error(
        "the environment server {server} serves {max} environments per stream, a slot has {needed} episodes: serve at least {} (`n` of tandem.serve, --max-environments of tandem env)",
        EVALUATION_EPISODES.max(*needed)
    )]
    TooFewEnvironments {
        /// Address and program of the server.
        server: String,
        /// The server's limit.
        max: usize,
        /// The number of episodes of the slot.
        needed: usize,
    },
    /// The environment server refused a request.
    #[error("the environment server {server} refused a request: {}", status.message())]
    EnvironmentRefused {
        /// Address and program of the server.
        server: String,
        /// The cause.
        status: Status,
    },
    /// The environment server answered with values that no environment of the task has.
    #[error("the environment server {server} sent an invalid reply to {reply}")]
    InvalidReply {
        /// Address and program of the server.
        server: String,
        /// The request: the episodes by environment, and the step.
        reply: String,
        /// The field and its value.
        source: DecodeError,
    },
    /// The environment server ended an episode that would fail again, as after a number that is not finite.
    #[error(
        "the environment server {server} sent an invalid reply to {reply}: {}",
        status.message()
    )]
    EpisodeLost {
        /// Address and program of the server.
        server: String,
        /// The request: the episodes by environment, and the step.
        reply: String,
        /// The cause, in the words of the server.
        status: Status,
    },
    /// A bug: a slot was to be played on a server, but the worker has none.
    #[error("the worker has no environment server")]
    NoServer,
    /// The environment server keeps failing.
    #[error(
        "gave up the environment server {server} after {n_failures} failures in a row: {}",
        status.message()
    )]
    EnvironmentFailed {
        /// Address and program of the server.
        server: String,
        /// The number of failures.
        n_failures: u32,
        /// The latest cause.
        status: Status,
    },
    /// The run's simulator cannot be built.
    #[error("the run's world cannot be built")]
    World(#[from] SimError),
    /// The published parameters do not fit the run's task.
    #[error("parameters of version {version} cannot be used")]
    Parameters {
        /// The version of the parameters.
        version: u64,
        /// The cause.
        source: tandem_policy::Error,
    },
    /// A slot could not be played.
    #[error("cannot play slot {slot}")]
    Rollout {
        /// The slot's number.
        slot: u64,
        /// The cause.
        source: RolloutError,
    },
    /// The system cannot start a thread for a rollout.
    #[error("cannot start a thread for a rollout")]
    Thread(#[source] std::io::Error),
    /// A bug: the rollout's thread panicked.
    #[error("the rollout's thread panicked")]
    Panicked(#[from] tokio::sync::oneshot::error::RecvError),
}

impl Error {
    pub(crate) fn protocol(operation: Operation, source: impl Into<CallError>) -> Self {
        Self::Protocol { attempted: operation.purpose, source: source.into() }
    }
}

/// A failure of a call that repetition does not cure.
#[derive(Debug, thiserror::Error)]
pub enum CallError {
    /// The peer rejected the call.
    #[error("refused")]
    Refused(#[from] Status),
    /// The response cannot be decoded.
    #[error("the response cannot be read")]
    Malformed(#[from] DecodeError),
    /// The response is to another request.
    #[error("the response does not fit the request: expected {expected}, got {got}")]
    Mismatch {
        /// The requested subject.
        expected: String,
        /// The subject of the response.
        got: String,
    },
}

/// Checks that a response is about `expected`, a number of `what`.
pub(crate) fn expect_same(what: &str, expected: u64, got: u64) -> Result<(), CallError> {
    if expected == got {
        return Ok(());
    }
    Err(CallError::Mismatch { expected: format!("{what} {expected}"), got: got.to_string() })
}
