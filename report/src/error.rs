//! What can go wrong while reporting.

use std::path::PathBuf;

/// What can go wrong while reporting.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A run's records cannot be read.
    #[error("cannot read the metrics of a run")]
    Metrics(#[from] tandem_telemetry::Error),
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
    /// A curve could not be drawn.
    #[error("cannot draw the curve {title:?}: {problem}")]
    Draw {
        /// The curve's title.
        title: String,
        /// What the plotting library says.
        problem: String,
    },
}
