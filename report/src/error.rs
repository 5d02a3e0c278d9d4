//! Errors of reports.

use std::path::PathBuf;

/// An error while making a report.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file operation failed.
    #[error("cannot {action} {path:?}")]
    Io {
        /// The operation: `read`, `write` or `remove`.
        action: &'static str,
        /// Path of the file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A directory contains neither runs nor trials.
    #[error(
        "no runs and no trials in {path:?}: expected a metrics.jsonl or a trials.jsonl in it or in a subdirectory"
    )]
    NoResults {
        /// The directory.
        path: PathBuf,
    },
    /// A trials file contains no trial.
    #[error("no trials in {path:?}: {problem}")]
    NoTrials {
        /// Path of the file.
        path: PathBuf,
        /// The actual content.
        problem: String,
    },
    /// A metrics file contains no row.
    #[error("no metrics rows in {path:?}: it is empty, or its first line is not one")]
    NoMetrics {
        /// Path of the file.
        path: PathBuf,
    },
    /// A file is not the result of an evaluation.
    #[error("{path:?} is not the output of `tandem eval --json`: {problem}")]
    InvalidEvaluation {
        /// Path of the file.
        path: PathBuf,
        /// The missing or invalid part.
        problem: String,
    },
    /// A `summary.json` is not the summary of a run.
    #[error("{path:?} is not the summary of a run: {problem}")]
    InvalidSummary {
        /// Path of the file.
        path: PathBuf,
        /// The missing or invalid part.
        problem: String,
    },
    /// A curve could not be drawn.
    #[error("cannot draw the curve {title:?}: {problem}")]
    Draw {
        /// Title of the curve.
        title: String,
        /// Message of the plotting library.
        problem: String,
    },
}
