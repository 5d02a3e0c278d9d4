//! What became of trials on arms: one JSON object a line, one line a trial.

use std::fs::File;
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::error::Error;

/// The name of the file in a directory of trials.
pub const TRIALS_FILE: &str = "trials.jsonl";

/// One trial. Places are metres in the world's frame, arm by arm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrialRow {
    /// Whose trial it was: a policy's name.
    pub subject: String,
    /// `open-loop` or `closed-loop`.
    pub mode: String,
    /// `push` or `pick-and-place`.
    pub task: String,
    /// The trial's number; the same number of the same seed has the same start and goals for every subject and mode.
    pub trial: u64,
    /// Decides starts, goals and noise.
    pub seed: u64,
    /// Whether every object ended within the tolerance of its goal and nothing went wrong.
    pub success: bool,
    /// The name of what went wrong.
    pub cause: Option<String>,
    /// What there is to say about it.
    pub detail: Option<String>,
    /// How far each object ended from its goal, metres.
    pub goal_distances_m: Vec<f64>,
    /// How far each object was from its goal at the end of the rehearsal in the training world, metres; open loop only.
    pub rehearsed_m: Option<Vec<f64>>,
    /// How long the arms took, seconds.
    pub duration_s: f64,
    /// Steps that the policy was asked for.
    pub n_steps: u64,
    /// Steps that the check allowed in part or not at all.
    pub n_shortened: u64,
    /// The smallest gap between the arms, metres; `null` with one arm.
    pub arms_gap_m: Option<f64>,
    /// The smallest gap between an arm and the table, metres.
    pub table_gap_m: f64,
    /// Where the objects lay at first.
    pub starts: Vec<[f64; 3]>,
    /// Where they should go.
    pub goals: Vec<[f64; 3]>,
    /// Where they ended.
    pub ends: Vec<[f64; 3]>,
    /// The tools' way.
    pub path: Vec<ToolsAt>,
    /// The trial's log, relative to this file, when there is one.
    pub log: Option<String>,
}

/// Where the tools were at one time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ToolsAt {
    /// Seconds since the trial's start.
    pub time_s: f64,
    /// Where the motion had them; empty while there was none.
    pub planned: Vec<[f64; 3]>,
    /// Where they were.
    pub measured: Vec<[f64; 3]>,
}

/// The file of a directory of trials, open for writing.
#[derive(Debug)]
pub struct TrialsLog {
    path: PathBuf,
    file: File,
}

impl TrialsLog {
    /// Starts the file `path` anew.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn create(path: &Path) -> Result<Self, Error> {
        let file = File::create(path).map_err(Error::io("create", path))?;
        Ok(Self { path: path.to_owned(), file })
    }

    /// Adds a trial.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn append(&mut self, row: &TrialRow) -> Result<(), Error> {
        let write_error = |source| Error::io("append to", &self.path)(source);
        let mut line =
            serde_json::to_vec(row).map_err(std::io::Error::other).map_err(write_error)?;
        line.push(b'\n');
        self.file.write_all(&line).map_err(write_error)
    }
}

/// Every trial of the file `path`.
///
/// # Errors
/// When it cannot be read, or names the line that is no trial.
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
