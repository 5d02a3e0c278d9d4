//! Errors of a learner.

use std::io;
use std::path::PathBuf;

use tandem_core::EpisodeKind;
use tandem_net::MAX_MESSAGE_BYTES;
use tandem_rl::config::{ConfigError, INIT_TEACHER};
use tandem_rl::ddpg::DdpgError;

use crate::advice_account::TeacherError;
use crate::checkpoint::CheckpointError;

/// An error that ends a learner.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A setting of the run file cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The state cannot be saved or restored.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// A file in the run directory cannot be read or written.
    #[error("cannot {action} {path:?}")]
    RunDirectory {
        /// The attempted action.
        action: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// The cause.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// Results of the run could not be written before its end.
    #[error("cannot write everything to {out:?}: {trouble}")]
    Unwritten {
        /// The run directory.
        out: PathBuf,
        /// The files and the causes.
        trouble: String,
    },
    /// The teacher refused, or its address is malformed.
    #[error(transparent)]
    Teacher(#[from] TeacherError),
    /// The run asks for advice and has no teacher.
    #[error("strategy {0:?} needs a teacher: give its address with --teacher")]
    NoTeacher(String),
    /// The run cannot start from the given teacher, or none was given.
    #[error("strategy {INIT_TEACHER:?} {0}")]
    StartFrom(String),
    /// Workers cannot be sent the networks.
    #[error(
        "the networks that workers act with are {} MiB large and a message at most {}: lower ddpg.n_hidden or \
         ddpg.n_hidden_layers",
        n_bytes.div_ceil(1 << 20),
        MAX_MESSAGE_BYTES >> 20
    )]
    NetworksTooLarge {
        /// Size of the message.
        n_bytes: usize,
    },
    /// Workers cannot send the episodes of a slot.
    #[error(
        "the episodes of a slot are up to {} MiB large and a message at most {}: lower {}",
        n_bytes.div_ceil(1 << 20),
        MAX_MESSAGE_BYTES >> 20,
        size_settings(*kind)
    )]
    SlotTooLarge {
        /// Largest size of the message.
        n_bytes: usize,
        /// The kind of the episodes.
        kind: EpisodeKind,
    },
    /// Learning diverged.
    #[error(transparent)]
    Diverged(#[from] DdpgError),
    /// The service cannot be configured.
    #[error(transparent)]
    ServerConfig(#[from] tandem_net::ServerConfigError),
    /// The address of a relay's learner is malformed.
    #[error(transparent)]
    Address(#[from] tandem_net::ClientConfigError),
    /// The server failed.
    #[error("cannot serve")]
    Serve(#[from] tonic::transport::Error),
    /// The learning thread cannot be spawned.
    #[error("cannot start the learning thread")]
    Thread(#[source] io::Error),
    /// The learning thread panicked, which is a bug.
    #[error("the learning thread panicked")]
    Panicked,
}

/// Names the settings that determine the size of a slot. Evaluation slots have a fixed number of episodes.
const fn size_settings(kind: EpisodeKind) -> &'static str {
    match kind {
        EpisodeKind::Training => {
            "rounds.rollouts, or episode_steps or n_observation of the task's description"
        }
        EpisodeKind::Evaluation => "episode_steps or n_observation of the task's description",
    }
}
