//! Results of trials on arms: `trials.jsonl`, one JSON object per trial.

use std::fs::File;
use std::io::{BufRead as _, BufReader, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use tandem_core::TaskSpec;

use crate::error::Error;

/// Name of the results file in a directory of trials.
pub const TRIALS_FILE: &str = "trials.jsonl";

/// The result of one trial. Positions are in the world frame, metres, in arm order.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrialRow {
    /// Name of the policy; the JSON key is `subject`.
    #[serde(rename = "subject")]
    pub policy: String,
    /// `open-loop`, `twin` or `closed-loop`.
    pub mode: String,
    /// Name of the built-in task, such as `shared-push`.
    pub task: String,
    /// Number of the trial. Seed and number determine the starts and goals, for every policy and mode.
    pub trial: u64,
    /// Seed of starts, goals and noise.
    pub seed: u64,
    /// `true` if every object ended within the tolerance of its goal and nothing failed.
    pub success: bool,
    /// Cause of the failure; `None` for a success.
    pub cause: Option<String>,
    /// Details of the cause.
    pub detail: Option<String>,
    /// Final distance of each object from its goal, metres.
    pub goal_distances_m: Vec<f64>,
    /// Distance of each object from its goal at the end of the rehearsal, metres; modes without feedback only.
    pub rehearsed_m: Option<Vec<f64>>,
    /// Duration of the trial, seconds of simulated time.
    pub duration_s: f64,
    /// Number of steps of the policy.
    pub n_steps: u64,
    /// Number of steps that the check shortened or refused.
    pub n_shortened: u64,
    /// Smallest gap between the arms, metres, negative if they overlapped; `None` with one arm.
    pub arms_gap_m: Option<f64>,
    /// Smallest gap between an arm and the table, metres.
    pub table_gap_m: f64,
    /// Distance from a goal up to which it counts as achieved, metres; files of earlier versions do not have it.
    #[serde(default)]
    pub tolerance_m: Option<f64>,
    /// Initial positions of the objects.
    pub starts: Vec<[f64; 3]>,
    /// Goals of the objects.
    pub goals: Vec<[f64; 3]>,
    /// Final positions of the objects.
    pub ends: Vec<[f64; 3]>,
    /// Path of the tools.
    pub path: Vec<ToolPathPoint>,
    /// Path of the trial's log, relative to this file, if there is one.
    pub log: Option<String>,
}

impl TrialRow {
    /// Returns the distance from a goal up to which it counts as achieved, metres: that of the row, or else that of its
    /// task; `None` if this version does not have the task.
    #[must_use]
    pub fn goal_tolerance_m(&self) -> Option<f64> {
        let of_task = || Some(TaskSpec::built_in(self.task.parse().ok()?, 1).tolerance().into());
        self.tolerance_m.or_else(of_task)
    }
}

/// Positions of the tools at one time (world frame, metres), in arm order.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ToolPathPoint {
    /// Time since the start of the trial, seconds.
    pub time_s: f64,
    /// Planned positions; empty while no motion is executed.
    pub planned: Vec<[f64; 3]>,
    /// Measured positions.
    pub measured: Vec<[f64; 3]>,
}

/// A results file, open for writing.
#[derive(Debug)]
pub struct TrialsLog {
    path: PathBuf,
    file: File,
    /// Size of the trials appended so far, bytes.
    n_bytes: u64,
}

impl TrialsLog {
    /// Creates `path`. The first [`append`](Self::append) replaces the trials that it contains, if any.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn create(path: &Path) -> Result<Self, Error> {
        let file = File::options().write(true).create(true).truncate(false).open(path);
        let file = file.map_err(Error::io("create", path))?;
        Ok(Self { path: path.to_owned(), file, n_bytes: 0 })
    }

    /// Appends a trial.
    ///
    /// # Errors
    /// If the file cannot be written. It then ends with the trial before.
    pub fn append(&mut self, row: &TrialRow) -> Result<(), Error> {
        let write_error = |source| Error::io("append to", &self.path)(source);
        let mut line =
            serde_json::to_vec(row).map_err(std::io::Error::other).map_err(write_error)?;
        line.push(b'\n');
        if self.n_bytes == 0 {
            self.file.set_len(0).map_err(write_error)?;
        }
        if let Err(error) = self.file.write_all(&line) {
            // A part of the line may have been written.
            self.file.set_len(self.n_bytes).ok();
            self.file.seek(SeekFrom::Start(self.n_bytes)).ok();
            return Err(write_error(error));
        }
        self.n_bytes += line.len() as u64;
        Ok(())
    }
}

/// Reads all trials of the file `path`.
///
/// # Errors
/// If the file cannot be read or a line is not a trial.
pub fn read_trials(path: &Path) -> Result<Vec<TrialRow>, Error> {
    let file = File::open(path).map_err(Error::io("open", path))?;
    let mut rows = Vec::new();
    for (idx, line) in BufReader::new(file).lines().enumerate() {
        let line = line.map_err(Error::io("read", path))?;
        let row = serde_json::from_str(&line).map_err(|source| {
            let problem = format!("line {}: {source}", idx + 1);
            Error::io("read", path)(std::io::Error::new(std::io::ErrorKind::InvalidData, problem))
        })?;
        rows.push(row);
    }
    Ok(rows)
}
