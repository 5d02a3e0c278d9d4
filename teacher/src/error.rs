//! The errors of a teacher.

use std::path::PathBuf;
use std::time::Duration;

use tandem_core::task::InvalidTask;
use tandem_proto::DecodeError;

use crate::ledger::{LedgerError, OpenError};
use crate::remote_policy::RemoteError;
use crate::strategy::{Strategy, UnknownStrategy};

/// The reason why a teacher cannot start or cannot answer.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The policy cannot be loaded.
    #[error("cannot use the teacher's policy")]
    Policy(#[from] tandem_policy::Error),
    /// The policy is not for one arm.
    #[error("a teacher needs a policy that drives 1 arm, {policy} drives {n_arms}")]
    NotOneArm {
        /// The policy's file, or "this one".
        policy: String,
        /// The number of arms of the policy.
        n_arms: usize,
    },
    /// The task of the policy has numbers that belong to no arm.
    #[error("a teacher needs a policy of a task in which every number belongs to the arm")]
    NotAnArm(#[source] InvalidTask),
    /// The policy's critic has several values.
    #[error("a teacher needs a critic that returns 1 value, that of {policy} returns {n_values}")]
    NotOneValue {
        /// The policy's file, or "this one".
        policy: String,
        /// The number of values of its critic.
        n_values: usize,
    },
    /// An actor is given in place of its critic.
    #[error(
        "{path:?} is not a critic: it takes no action, as an actor does, and returns {n_outputs} numbers"
    )]
    NotACritic {
        /// The file.
        path: PathBuf,
        /// The number of its outputs.
        n_outputs: usize,
    },
    /// An ONNX model cannot be used as the teacher's policy.
    #[error("cannot use the teacher's policy")]
    Onnx(#[from] tandem_onnx::Error),
    /// The policy is in another process, which cannot be used.
    #[error(transparent)]
    RemotePolicy(#[from] RemoteError),
    /// A critic is given besides a policy file.
    #[error("a critic is given apart only for an ONNX model: a policy file contains its own")]
    SurplusCritic,
    /// A strategy compares values of actions, and the teacher's policy has none.
    #[error(
        "strategy {strategy} compares values of actions, and the teacher's policy has no critic: use {usable}, or a \
         teacher with a critic",
        usable = Strategy::names(false).join(", ")
    )]
    NoValues {
        /// The strategy.
        strategy: Strategy,
    },
    /// A request is invalid.
    #[error(transparent)]
    Request(#[from] DecodeError),
    /// A request has an unknown strategy.
    #[error("strategy: {0}")]
    Strategy(#[from] UnknownStrategy),
    /// The ledger refuses an operation or is unavailable.
    #[error(transparent)]
    Ledger(#[from] LedgerError),
    /// The ledger cannot be opened.
    #[error(transparent)]
    OpenLedger(#[from] OpenError),
    /// Only another process can charge the accounts of the ledger, and the service ends.
    #[error("a file beside the ledger was removed or replaced: start the teacher again")]
    LedgerNeedsRestart,
    /// The teacher's networks returned infinity or NaN.
    #[error(
        "the teacher's networks returned a number that is not finite for step {step} of episode {episode}"
    )]
    NotFinite {
        /// The episode of the query.
        episode: u64,
        /// The step of the query.
        step: u32,
    },
    /// The answer took too long: the ledger blocks, or there are too many requests.
    #[error("no answer within {0:?}: ask again")]
    Timeout(Duration),
    /// The thread that owns the networks and the ledger has panicked, and the service ends.
    #[error("the teacher has a bug and ends: see its log")]
    Panicked,
    /// The thread that owns the networks and the ledger cannot be started.
    #[error("cannot start a thread")]
    Thread(#[source] std::io::Error),
    /// The server cannot be configured.
    #[error(transparent)]
    ServerConfig(#[from] tandem_net::ServerConfigError),
    /// The server failed.
    #[error("cannot serve")]
    Transport(#[from] tonic::transport::Error),
}
