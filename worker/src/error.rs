//! Why a worker gives up.

use std::path::PathBuf;

use tandem_sim::SimError;

use crate::rollout::RolloutError;

/// Why a worker gave up. None of it mends by waiting.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Not an address.
    #[error("the {role} cannot be called")]
    Address {
        /// Whose address.
        role: &'static str,
        /// What is wrong with it.
        source: tandem_net::DialError,
    },
    /// The place for logs cannot be made.
    #[error("cannot create the log directory {path:?}")]
    LogDir {
        /// As configured.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// A peer refuses or answers what cannot be understood.
    #[error("cannot {attempted}")]
    Protocol {
        /// What was attempted.
        attempted: &'static str,
        /// The peer's answer.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The run takes advice and the worker was given no teacher.
    #[error("the run takes advice on account {account:?}, but no teacher's address was given")]
    NoTeacher {
        /// The teacher's account.
        account: String,
    },
    /// The learner ordered advice in a run that has no account for it.
    #[error("slot {slot} is to be advised, but the run's terms name no account")]
    NoAccount {
        /// The slot's number.
        slot: u64,
    },
    /// The run's world cannot be built.
    #[error("the run's world cannot be built")]
    World(#[from] SimError),
    /// The parameters are no actor of the run's layout.
    #[error("parameters of version {version} cannot be used")]
    Parameters {
        /// Their version.
        version: u64,
        /// What is wrong with them.
        source: tandem_policy::Error,
    },
    /// A slot could not be played.
    #[error("cannot play slot {slot}")]
    Rollout {
        /// The slot's number.
        slot: u64,
        /// What went wrong.
        source: RolloutError,
    },
    /// The system gives no thread for a rollout.
    #[error("cannot start a thread for a rollout")]
    Thread(#[source] std::io::Error),
    /// A bug: the rollout's thread panicked.
    #[error("the rollout's thread panicked")]
    Panicked(#[from] tokio::sync::oneshot::error::RecvError),
}
