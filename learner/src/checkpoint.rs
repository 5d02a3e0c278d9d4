//! Checkpoints: the whole learning state in one file, replaced atomically.
//!
//! A checkpoint is a safetensors file `checkpoint/{round}.safetensors` with a checksum (the seal). It contains every
//! tensor of the state, complete and pending evaluations, and metadata with the counters. A run resumed from it and its
//! run file continues with the same bits. The previous checkpoint stays until the new one is complete.

mod sealed;
mod state;

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use tandem_core::work::PublishedActor;
use tandem_rl::config::{ConfigError, RunConfig};
use tandem_rl::trainer::Trainer;
use tandem_system::atomic_file::{self, TEMPORARY_EXTENSION};

use crate::evaluation_store::{EvaluationHistory, PendingEvaluation};
use crate::settings::{self, ADVICE, Changed};
use sealed::{FORMAT, Refused, Tensor};

/// The contents of a checkpoint besides the trainer.
#[derive(Debug, Clone, PartialEq)]
pub struct Resumption {
    /// The parameters that play the round after the checkpoint.
    pub acting: PublishedActor,
    /// The results of complete evaluations.
    pub history: EvaluationHistory,
    /// Pending evaluations, oldest first.
    pub pending: Vec<PendingEvaluation>,
    /// Wall time of the run so far, seconds.
    pub wall_s: f64,
    /// The digest of the teacher's policy when the run began. `None` for a run without a teacher, and for one of an
    /// earlier version.
    pub teacher_policy: Option<String>,
    /// True if the teacher has also advised by another policy since. False for a run of an earlier version.
    pub had_other_policy: bool,
    /// The run's account at the teacher, unless it has the run's name.
    pub account: Option<RenamedAccount>,
}

/// An account that a run opened under another name than its own, because the ledger had lost charges to the former one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RenamedAccount {
    /// Its name.
    pub name: String,
    /// The budget with which it was opened first, units of advice.
    pub budget: u64,
}

impl Resumption {
    /// Returns the contents at the start of a run, whose first round `acting` plays.
    #[must_use]
    pub fn of_new_run(acting: PublishedActor) -> Self {
        Self {
            acting,
            history: EvaluationHistory::default(),
            pending: Vec::new(),
            wall_s: 0.0,
            teacher_policy: None,
            had_other_policy: false,
            account: None,
        }
    }
}

/// An error about a checkpoint.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The file system returned an error.
    #[error("cannot {action} checkpoint {path:?}")]
    Io {
        /// The attempted action.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// The file is truncated or altered.
    #[error("checkpoint {path:?} is damaged: {what}")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// The damage.
        what: String,
    },
    /// The file has the format of another version of the program.
    #[error("checkpoint {path:?} is of format {got:?}, this program reads {FORMAT:?}")]
    Format {
        /// The file.
        path: PathBuf,
        /// Its format.
        got: String,
    },
    /// The checkpoint is whole and does not fit the run.
    #[error("checkpoint {path:?} does not fit the run: {what}")]
    OtherRun {
        /// The file.
        path: PathBuf,
        /// The mismatch.
        what: String,
    },
    /// The run started with another value of a setting that must not change.
    #[error("{setting}'s checkpoint {path:?}: {ADVICE}")]
    OtherSettings {
        /// The file.
        path: PathBuf,
        /// The setting.
        setting: Changed,
    },
    /// A new run was to start in the directory of another.
    #[error("{0:?} holds a run already: resume it, or choose another directory")]
    RunExists(PathBuf),
    /// A setting of the run file cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
}

/// A saved checkpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Saved {
    /// Its path.
    pub path: PathBuf,
    /// SHA-256 over the file with zeros in place of the seal, hexadecimal.
    pub seal: String,
}

/// A restored checkpoint.
#[derive(Debug)]
pub struct Restored {
    /// Its path.
    pub path: PathBuf,
    /// The learning state.
    pub trainer: Trainer,
    /// The rest.
    pub resumption: Resumption,
}

/// Writes a checkpoint to `directory` and removes old ones, so that `keep` remain, including this one. A file that
/// cannot be removed stays, with a warning.
///
/// # Errors
/// When the file cannot be written; former checkpoints are unchanged then.
pub fn save(
    directory: &Path,
    trainer: &Trainer,
    resumption: &Resumption,
    keep: usize,
) -> Result<Saved, CheckpointError> {
    let path = directory.join(format!("{:08}.safetensors", trainer.counters().round));
    let owned = state::small_tensors(trainer, resumption);
    let mut tensors: Vec<Tensor<'_>> = owned
        .iter()
        .map(|(name, dtype, bytes)| Tensor {
            name: name.clone(),
            dtype: *dtype,
            bytes: bytes.into(),
        })
        .collect();
    tensors.extend(state::large_tensors(trainer));
    let metadata = state::metadata(trainer, resumption);
    let written = atomic_file::create_directory(directory).and_then(|()| {
        atomic_file::replace_with(&path, |file| sealed::write(file, &metadata, &tensors))
    });
    let seal = written.map_err(|source| CheckpointError::Io {
        action: "write",
        path: path.clone(),
        source,
    })?;
    prune(directory, &path, keep);
    Ok(Saved { path, seal })
}

/// Removes all but the newest `keep` checkpoints, `newest` among them.
fn prune(directory: &Path, newest: &Path, keep: usize) {
    let mut former = list(directory);
    former.retain(|path| path != newest);
    for old in former.iter().rev().skip(keep.saturating_sub(1)) {
        if let Err(error) = fs::remove_file(old) {
            tracing::warn!(path = ?old, %error, "old checkpoint cannot be removed");
        }
    }
}

/// Returns the checkpoints in `directory`, oldest first; none if it cannot be read.
#[must_use]
pub fn list(directory: &Path) -> Vec<PathBuf> {
    by_round(directory).unwrap_or_default()
}

/// Returns the round of a checkpoint; `None` if the file has no name of a checkpoint.
#[must_use]
pub fn round_of(path: &Path) -> Option<u64> {
    let stem = path.file_stem()?.to_str()?;
    stem.bytes().all(|byte| byte.is_ascii_digit()).then(|| stem.parse().ok())?
}

/// Returns the checkpoints in `directory`, oldest first. Files with other names, such as a user's copies, are none.
fn by_round(directory: &Path) -> io::Result<Vec<PathBuf>> {
    let files = files(directory, "safetensors")?.into_iter();
    let mut checkpoints: Vec<(u64, PathBuf)> =
        files.filter_map(|path| Some((round_of(&path)?, path))).collect();
    checkpoints.sort();
    Ok(checkpoints.into_iter().map(|(_, path)| path).collect())
}

/// Returns the files of `directory` with this extension, by name; a missing directory has none.
fn files(directory: &Path, extension: &str) -> io::Result<Vec<PathBuf>> {
    let entries = match fs::read_dir(directory) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries?,
    };
    let mut paths = entries
        .map(|entry| entry.map(|entry| entry.path()))
        .filter(|path| {
            path.as_ref().is_ok_and(|path| path.extension().is_some_and(|e| e == extension))
                || path.is_err()
        })
        .collect::<io::Result<Vec<_>>>()?;
    paths.sort();
    Ok(paths)
}

/// Restores the newest checkpoint in `directory` of a run with `config`; returns `None` if there is none. Removes
/// unfinished files of a killed process.
///
/// # Errors
/// When the directory cannot be read, or the newest checkpoint is damaged or does not fit the run. The message names
/// the file and, if the file is damaged, the previous one.
pub fn load_newest(
    directory: &Path,
    config: &RunConfig,
) -> Result<Option<Restored>, CheckpointError> {
    let unreadable =
        |source| CheckpointError::Io { action: "look for a", path: directory.to_owned(), source };
    for unfinished in files(directory, TEMPORARY_EXTENSION).map_err(unreadable)? {
        tracing::info!(path = ?unfinished, "unfinished checkpoint removed");
        fs::remove_file(&unfinished).map_err(|source| CheckpointError::Io {
            action: "remove the unfinished",
            path: unfinished.clone(),
            source,
        })?;
    }
    let mut paths = by_round(directory).map_err(unreadable)?;
    let Some(newest) = paths.pop() else { return Ok(None) };
    load(&newest, config).map(Some).map_err(|error| match (error, paths.pop()) {
        (CheckpointError::Damaged { path, what }, Some(former)) => {
            let what = format!("{what}; remove it to continue from {former:?}");
            CheckpointError::Damaged { path, what }
        }
        (error, _) => error,
    })
}

/// Restores one checkpoint.
///
/// # Errors
/// When it cannot be read, is damaged, has another format, or does not fit the run.
pub fn load(path: &Path, config: &RunConfig) -> Result<Restored, CheckpointError> {
    let bytes = fs::read(path).map_err(|source| CheckpointError::Io {
        action: "read",
        path: path.to_owned(),
        source,
    })?;
    let path = path.to_owned();
    let contents = match sealed::open(&bytes) {
        Ok(contents) => contents,
        Err(Refused::Damaged(what)) => return Err(CheckpointError::Damaged { path, what }),
        Err(Refused::Format(got)) => return Err(CheckpointError::Format { path, got }),
    };
    let began_with = contents.metadata.get(sealed::SETTINGS);
    if let Some(setting) = began_with.and_then(|text| changed(config, text)) {
        return Err(CheckpointError::OtherSettings { path, setting });
    }
    let mut trainer = Trainer::new(config.clone())?;
    match (state::Reader { contents }).restore(&mut trainer) {
        Ok(resumption) => Ok(Restored { path, trainer, resumption }),
        Err(what) => Err(CheckpointError::OtherRun { path, what }),
    }
}

/// Returns the setting in which `config` differs from `began_with`; none if the text cannot be parsed.
fn changed(config: &RunConfig, began_with: &str) -> Option<Changed> {
    settings::first_change(config, began_with).ok().flatten()
}

/// Compares settings with the header of the newest checkpoint in `directory`, without verifying the checkpoint. Returns
/// false if there is none to compare with.
///
/// # Errors
/// When a setting differs that must not change.
pub fn check_settings(directory: &Path, config: &RunConfig) -> Result<bool, CheckpointError> {
    let newest = list(directory).pop().and_then(|path| Some((sealed::settings_of(&path)?, path)));
    let Some((began_with, path)) = newest else { return Ok(false) };
    match changed(config, &began_with) {
        Some(setting) => Err(CheckpointError::OtherSettings { path, setting }),
        None => Ok(true),
    }
}

#[cfg(test)]
mod tests;
