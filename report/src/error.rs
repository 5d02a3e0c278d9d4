//! What can go wrong while reporting.

use std::path::PathBuf;

/// What can go wrong while reporting.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file operation failed.
    #[error("cannot {action} {path:?}")]
    Io {
        /// What was attempted: "read", "write".
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// Why it failed.
        source: std::io::Error,
    },
    /// Nothing that a report could show.
    #[error(
        "{path:?} holds no run and no trials: expected a metrics.jsonl or a trials.jsonl in it or below"
    )]
    NoRun {
        /// Where one was looked for.
        path: PathBuf,
    },
    /// A file of trials without a single one.
    #[error("{path:?} holds no trial: {problem}")]
    NoTrial {
        /// The file.
        path: PathBuf,
        /// What stands there instead.
        problem: String,
    },
    /// A metrics file without a single row.
    #[error("{path:?} holds no metrics: its first line is no metrics row")]
    NoRow {
        /// The file.
        path: PathBuf,
    },
    /// A file is no result of an evaluation.
    #[error("{path:?} is no result of `tandem eval --json`: {problem}")]
    NoEvaluation {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// A curve could not be drawn.
    #[error("cannot draw the curve {title:?}: {problem}")]
    Draw {
        /// The curve's title.
        title: String,
        /// What the plotting library says.
        problem: String,
    },
}
