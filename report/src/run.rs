//! A run as reports see it: a name and its metrics.

use std::io::ErrorKind;
use std::path::Path;

use tandem_telemetry::{MetricsLog, MetricsRow};

use crate::error::Error;

/// A run as reports see it.
#[derive(Debug, Clone, PartialEq)]
pub struct Run {
    /// The name of its directory.
    pub name: String,
    /// One row an evaluation, in order.
    pub rows: Vec<MetricsRow>,
    /// Its resolved configuration as it stands in `run.toml`, when there is one.
    pub configuration: Option<String>,
}

impl Run {
    /// Reads the run directory `dir`.
    ///
    /// # Errors
    /// When it has no readable `metrics.jsonl`.
    pub fn load(dir: &Path) -> Result<Self, Error> {
        let rows = MetricsLog::read_all(&dir.join("metrics.jsonl"))?;
        let run_file = dir.join("run.toml");
        let configuration = match std::fs::read_to_string(&run_file) {
            Ok(text) => Some(text),
            Err(error) if error.kind() == ErrorKind::NotFound => None,
            Err(source) => return Err(Error::Io { action: "read", path: run_file, source }),
        };
        Ok(Self { name: directory_name(dir), rows, configuration })
    }

    /// The evaluation with the highest success; of equals the first.
    #[must_use]
    pub fn best(&self) -> Option<&MetricsRow> {
        self.rows.iter().rev().max_by(|a, b| a.success.total_cmp(&b.success))
    }

    /// The last evaluation.
    #[must_use]
    pub fn last(&self) -> Option<&MetricsRow> {
        self.rows.last()
    }
}

fn directory_name(dir: &Path) -> String {
    let absolute = dir.canonicalize().unwrap_or_else(|_| dir.to_owned());
    absolute.file_name().unwrap_or(dir.as_os_str()).to_string_lossy().into_owned()
}
