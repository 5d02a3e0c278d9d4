//! Why a learner gives up.

use std::path::PathBuf;

use crate::checkpoint::CheckpointError;
use crate::teacher::TeacherError;
use tandem_rl::config::{ConfigError, INIT_TEACHER};
use tandem_rl::ddpg::DdpgError;

/// Why a learner gave up.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The run file cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The state could not be saved or restored.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// Something in the run directory could not be read or written.
    #[error("cannot {action} {path:?}")]
    RunDirectory {
        /// What was attempted.
        action: &'static str,
        /// On what.
        path: PathBuf,
        /// Why not.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The teacher declined, or its address is none.
    #[error(transparent)]
    Teacher(#[from] TeacherError),
    /// The run asks for advice and no teacher is named.
    #[error("strategy {0:?} needs a teacher: give its address")]
    NoTeacher(String),
    /// The run cannot start from the teacher that was given, or none was.
    #[error("strategy {INIT_TEACHER:?} {0}")]
    StartFrom(String),
    /// Learning diverged.
    #[error(transparent)]
    Diverged(#[from] DdpgError),
    /// The service cannot be offered.
    #[error(transparent)]
    Gate(#[from] tandem_net::ServerConfigError),
    /// A relay cannot call its learner.
    #[error(transparent)]
    Address(#[from] tandem_net::ClientConfigError),
    /// The network refused.
    #[error("cannot serve")]
    Serve(#[from] tonic::transport::Error),
    /// The thread that learns panicked: a bug.
    #[error("the learning thread panicked")]
    Panicked,
}
