//! The configuration of a worker.

use std::path::PathBuf;
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
    /// The worker's name in progress reports. Several workers may have the same name.
    pub name: String,
    /// The directory for logs of recorded episodes, created if it does not exist; without it no logs are written.
    pub log_dir: Option<PathBuf>,
    /// The scheduling of sockets and rollouts.
    pub pacing: Pacing,
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
