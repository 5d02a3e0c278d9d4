//! The configuration of a worker.

use std::fmt::Debug;
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use tandem_net::{Backoff, ClientConfig, Pacing};

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
    /// The directory for logs of recorded episodes, created if it does not exist; without it no logs are written.
    pub log_dir: Option<PathBuf>,
    /// The scheduling of sockets and rollouts.
    pub pacing: Pacing,
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
    /// The default number of attempts: with the default pauses between them, about 30 seconds.
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
