//! What can go wrong with the records of a run.

use std::path::{Path, PathBuf};

/// What can go wrong with the records of a run.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file operation failed.
    #[error("cannot {action} {path:?}")]
    Io {
        /// What was attempted: "create", "rename" and the like.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// Why it failed.
        source: std::io::Error,
    },
    /// An episode's log could not be written.
    #[error("cannot write the log {path:?}")]
    WriteLog {
        /// The log.
        path: PathBuf,
        /// Why it failed.
        source: mcap::McapError,
    },
    /// The file is no MCAP file, is cut short or damaged.
    #[error(
        "{path:?} is not a whole MCAP file; `tandem mcap recover` mends what a killed writer left"
    )]
    ReadLog {
        /// The log.
        path: PathBuf,
        /// What is wrong with it.
        source: mcap::McapError,
    },
    /// The file is an MCAP file, but not a log of an episode.
    #[error("{path:?} is no log of an episode: {problem}")]
    NotAnEpisode {
        /// The log.
        path: PathBuf,
        /// What is missing or wrong.
        problem: String,
    },
    /// A vector handed to the recorder does not fit the episode's layout.
    #[error("{field} has {got} numbers, the layout has {expected}")]
    Length {
        /// Which vector.
        field: &'static str,
        /// Its length.
        got: usize,
        /// The layout's.
        expected: usize,
    },
    /// A scene's time cannot stand in a log.
    #[error("simulated time {time_s} s is not a time since the episode's start")]
    Time {
        /// The time, seconds.
        time_s: f64,
    },
    /// A whole line of the metrics is no row.
    #[error("{path:?}, line {line}, is no metrics row")]
    MetricsRow {
        /// The metrics file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is wrong with it.
        source: serde_json::Error,
    },
    /// The log filter cannot be understood.
    #[error(
        "log filter {filter:?} is malformed: expected LEVEL or TARGET=LEVEL, separated by commas"
    )]
    LogFilter {
        /// The filter.
        filter: String,
        /// What is wrong with it, where it has the form of directives.
        source: Option<tracing_subscriber::filter::ParseError>,
    },
    /// Logging was set up twice in one process.
    #[error("logging is already set up")]
    LoggingTwice(#[from] tracing_subscriber::util::TryInitError),
}

impl Error {
    /// For `map_err` on file operations.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io { action, path: path.to_owned(), source }
    }

    /// For `map_err` on writing a log.
    pub(crate) fn write_log(path: &Path) -> impl FnOnce(mcap::McapError) -> Self {
        move |source| Self::WriteLog { path: path.to_owned(), source }
    }

    /// For `map_err` on reading a log.
    pub(crate) fn read_log(path: &Path) -> impl FnOnce(mcap::McapError) -> Self {
        move |source| Self::ReadLog { path: path.to_owned(), source }
    }
}
