//! Errors of logs and metrics.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

/// An error while writing or reading logs and metrics, or while setting up logging.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file operation failed.
    #[error("cannot {action} {path:?}")]
    Io {
        /// The operation, such as `create` or `rename`.
        action: &'static str,
        /// Path of the file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A log could not be written.
    #[error("cannot write the log {path:?}")]
    WriteLog {
        /// Path of the log.
        path: PathBuf,
        /// The cause.
        source: mcap::McapError,
    },
    /// Another writer has the log.
    #[error("{path:?} is being written by another process")]
    LogInUse {
        /// Path of the log.
        path: PathBuf,
    },
    /// The file is not an MCAP file, or it is incomplete or damaged.
    #[error(
        "{path:?} is not a complete MCAP file; `tandem mcap recover` recovers the log of a killed writer"
    )]
    ReadLog {
        /// Path of the log.
        path: PathBuf,
        /// The cause.
        source: mcap::McapError,
    },
    /// The file does not start like an MCAP file.
    #[error("{path:?} is not an MCAP file: name a log, FILE.mcap or FILE.mcap.part")]
    NotMcap {
        /// Path of the file.
        path: PathBuf,
    },
    /// An MCAP file has no message before its end or its first damage.
    #[error("{path:?} has no message to recover")]
    NothingToRecover {
        /// Path of the file.
        path: PathBuf,
    },
    /// The file is an MCAP file, but not the log of an episode.
    #[error("{path:?} is not the log of an episode: {problem}")]
    NotAnEpisode {
        /// Path of the log.
        path: PathBuf,
        /// The missing or invalid part.
        problem: String,
    },
    /// The file is the log of a trial, which cannot be simulated again.
    #[error(
        "{path:?} is the log of a trial, not of an episode: open it in Foxglove, or see its directory with `tandem report`"
    )]
    TrialLog {
        /// Path of the log.
        path: PathBuf,
    },
    /// The file is the log of a bridge's motion, which cannot be simulated again.
    #[error("{path:?} is the log of a bridge's motion, not of an episode: open it in Foxglove")]
    MotionLog {
        /// Path of the log.
        path: PathBuf,
    },
    /// A vector does not fit the task of the episode or trial.
    #[error("{field} has {got} numbers, the task has {expected}")]
    Length {
        /// Name of the vector.
        field: &'static str,
        /// Length of the vector.
        got: usize,
        /// Length in that task.
        expected: usize,
    },
    /// A time is negative, not finite or too large for a log.
    #[error("invalid time in a log: {time_s} s since its start")]
    Time {
        /// The time, seconds.
        time_s: f64,
    },
    /// A complete line of a metrics file is not a row.
    #[error("{path:?}, line {line}, is not a metrics row")]
    MetricsRow {
        /// Path of the metrics file.
        path: PathBuf,
        /// Number of the line, from 1.
        line: usize,
        /// The cause.
        source: serde_json::Error,
    },
    /// Viewers cannot be served at an address.
    #[error("cannot listen on {address} for viewers: choose another address for --live")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// The cause.
        source: std::io::Error,
    },
    /// A channel of a log cannot be offered to viewers.
    #[error("cannot offer the channel {topic:?} to viewers: {problem}")]
    Channel {
        /// Topic of the channel.
        topic: String,
        /// The cause.
        problem: String,
    },
    /// The log filter is malformed.
    #[error(
        "log filter {filter:?} is malformed: expected LEVEL or TARGET=LEVEL, separated by commas"
    )]
    LogFilter {
        /// The filter.
        filter: String,
        /// The cause, if the filter has the form of directives.
        source: Option<tracing_subscriber::filter::ParseError>,
    },
    /// Logging was initialised twice in one process.
    #[error("logging is already initialised")]
    LoggingTwice(#[from] tracing_subscriber::util::TryInitError),
}

impl Error {
    /// Returns a function for `map_err` on file operations.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io { action, path: path.to_owned(), source }
    }

    /// Returns a function for `map_err` on writing a log.
    pub(crate) fn write_log(path: &Path) -> impl FnOnce(mcap::McapError) -> Self {
        move |source| Self::WriteLog { path: path.to_owned(), source }
    }

    /// Returns a function for `map_err` on reading a log.
    pub(crate) fn read_log(path: &Path) -> impl FnOnce(mcap::McapError) -> Self {
        move |source| Self::ReadLog { path: path.to_owned(), source }
    }
}
