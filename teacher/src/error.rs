//! What can go wrong in a teacher.

use std::time::Duration;

use tandem_proto::DecodeError;

use crate::ledger::{LedgerError, OpenError};
use crate::strategy::UnknownStrategy;

/// Why a teacher cannot start or cannot answer.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The policy cannot be used.
    #[error("cannot use the teacher's policy")]
    Policy(#[from] tandem_policy::Error),
    /// The policy is a student's.
    #[error(
        "a teacher needs a policy for 1 arm with 1 value, this one is for {n_arms} with {n_values}"
    )]
    NotOneArm {
        /// Arms that the policy is for.
        n_arms: usize,
        /// Values that its critic gives.
        n_values: usize,
    },
    /// A request does not hold what it must.
    #[error(transparent)]
    Request(#[from] DecodeError),
    /// A request names no strategy.
    #[error("strategy: {0}")]
    Strategy(#[from] UnknownStrategy),
    /// The ledger declines or is away.
    #[error(transparent)]
    Ledger(#[from] LedgerError),
    /// The ledger cannot be opened.
    #[error(transparent)]
    OpenLedger(#[from] OpenError),
    /// The teacher's networks gave infinity or NaN.
    #[error(
        "the teacher's networks gave a number that is not finite for step {step} of episode {episode}"
    )]
    NotFinite {
        /// The episode asked about.
        episode: u64,
        /// Its step.
        step: u32,
    },
    /// Nobody answered in time: the ledger is stuck, or too many ask.
    #[error("no answer within {0:?}: ask again")]
    Overdue(Duration),
    /// The thread that owns the networks and the ledger has panicked, and the service ends.
    #[error("the teacher has a bug and ends: its log says more")]
    Panicked,
    /// The thread that owns the networks and the ledger cannot be started.
    #[error("cannot start a thread")]
    Thread(#[source] std::io::Error),
    /// The service cannot be offered.
    #[error(transparent)]
    Gate(#[from] tandem_net::ServerConfigError),
    /// The server stopped unasked.
    #[error("cannot serve")]
    Transport(#[from] tonic::transport::Error),
}
