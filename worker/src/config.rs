//! The configuration of a worker.

use std::fmt::Debug;
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use tandem_net::{Backoff, ClientConfig, Pacing};

use crate::liveness::Liveness;

/// The configuration of a worker.
#[derive(Debug, Clone)]
pub struct WorkerConfig {
    /// The configuration of calls to the learner and the teacher.
    pub client: ClientConfig,
    /// The learner's address, `HOST:PORT` or a URI.
    pub learner: String,
    /// The teacher's address. Required if the run takes advice.
    pub teacher: Option<String>,
    /// The server of the environments; `None` simulates them in this process.
    pub environment: Option<EnvironmentConfig>,
    /// The worker's name in progress reports. Several workers may have the same name.
    pub name: String,
    /// The recording of episodes; `None` writes no logs.
    pub recording: Option<RecordingConfig>,
    /// The scheduling of sockets and rollouts.
    pub pacing: Pacing,
    /// Shows whether the worker's rollouts make progress.
    pub liveness: Liveness,
}

/// The recording of episodes in a directory.
#[derive(Debug, Clone)]
pub struct RecordingConfig {
    /// The directory for logs, created if it does not exist.
    pub directory: PathBuf,
    /// The episodes to record.
    pub episodes: RecordedEpisodes,
    /// The size that the logs in the directory may reach, bytes. Beyond it, the oldest ones are deleted.
    pub budget_bytes: u64,
}

/// The episodes that a worker records.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RecordedEpisodes {
    /// The evaluation episodes whose order asks for it.
    Evaluation,
    /// These, and every training episode.
    All,
}

/// The server of a worker's environments, and how it is called.
#[derive(Debug, Clone)]
pub struct EnvironmentConfig {
    /// The server.
    pub server: Arc<dyn EnvironmentServer>,
    /// The configuration of calls to the server.
    pub client: ClientConfig,
    /// The deadline of each reply.
    pub reply_timeout: Duration,
    /// The number of failures in a row after which the worker ends.
    pub max_attempts: u32,
}

impl EnvironmentConfig {
    /// The default deadline of a reply.
    pub const REPLY_TIMEOUT: Duration = Duration::from_secs(60);
    /// The default number of attempts: the pauses between them take about 23 seconds together.
    pub const MAX_ATTEMPTS: u32 = 10;
    /// The pauses between attempts.
    pub(crate) const BACKOFF: Backoff =
        Backoff { first_pause: Duration::from_millis(50), max_pause: Duration::from_secs(10) };
}

/// A server of environments, which may have to be started.
pub trait EnvironmentServer: Debug + Send + Sync {
    /// Returns the server's address, `HOST:PORT` or a URI. Starts the server first if it does not run and can be
    /// started.
    fn address(&self) -> ServerAddress<'_>;

    /// Returns the address of a server after a call of the previous one has failed. A server that can be restarted is
    /// restarted first.
    fn address_after_failure(&self) -> ServerAddress<'_> {
        self.address()
    }
}

/// The future of a server's address.
pub type ServerAddress<'a> =
    Pin<Box<dyn Future<Output = Result<String, ServerNotStarted>> + Send + 'a>>;

/// The reason why a server of environments could not be started, on one line.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct ServerNotStarted(pub String);

/// A server at a fixed address, which the worker does not start.
impl EnvironmentServer for String {
    fn address(&self) -> ServerAddress<'_> {
        Box::pin(std::future::ready(Ok(self.clone())))
    }
}

/// The deadlines of a worker's calls, and the pauses between their repetitions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timeouts {
    /// The pauses before a failed call is repeated.
    pub backoff: Backoff,
    /// The deadline of calls to the learner.
    pub call: Duration,
    /// The deadline of a request for work, which the learner holds for some seconds if it has none.
    pub work: Duration,
    /// The deadline of a request for advice. It takes milliseconds, and the episodes of a slot wait for it.
    pub advice: Duration,
    /// The time after a shutdown signal in which the current slot may be finished and delivered.
    pub drain: Duration,
}

impl Default for Timeouts {
    fn default() -> Self {
        Self {
            backoff: Backoff {
                first_pause: Duration::from_millis(50),
                max_pause: Duration::from_secs(1),
            },
            call: Duration::from_secs(20),
            work: Duration::from_secs(20),
            advice: Duration::from_secs(5),
            drain: Duration::from_secs(5),
        }
    }
}
