//! The whole learning state in one file, written whole or not at all.
//!
//! A checkpoint is a safetensors file `checkpoint/{round}.safetensors` under a seal: every tensor of the state, what
//! the evaluations have brought and those that are under way, and metadata with the counters. Together with the run
//! file it is all that a run needs to go on as if nothing had happened. The former one stays until the new one is whole.

mod sealed;
mod state;

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use tandem_core::work::PublishedActor;
use tandem_system::atomic_file::{self, TEMPORARY_EXTENSION};

use crate::records::{Judged, Pending};
use crate::settings::{self, ADVICE, Changed};
use sealed::{FORMAT, Refused, Tensor};
use tandem_rl::config::{ConfigError, RunConfig};
use tandem_rl::trainer::Trainer;

/// What a checkpoint holds beside the trainer.
#[derive(Debug, Clone, PartialEq)]
pub struct Resumption {
    /// The parameters with which the round after the checkpoint is played.
    pub acting: PublishedActor,
    /// What the evaluations have brought.
    pub judged: Judged,
    /// Evaluations whose episodes are not all in, oldest first.
    pub pending: Vec<Pending>,
    /// Seconds that the run has taken so far.
    pub wall_s: f64,
}

/// Why a checkpoint could not be written or read.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The file system refused.
    #[error("cannot {action} checkpoint {path:?}")]
    Io {
        /// What was attempted.
        action: &'static str,
        /// On which file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// Not a whole checkpoint.
    #[error("checkpoint {path:?} is damaged: {what}")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        what: String,
    },
    /// Written by another version of the program.
    #[error("checkpoint {path:?} is of format {got:?}, this program reads {FORMAT:?}")]
    Format {
        /// The file.
        path: PathBuf,
        /// Its format.
        got: String,
    },
    /// A whole checkpoint that the run cannot go on from.
    #[error("checkpoint {path:?} does not fit the run: {what}")]
    OtherRun {
        /// The file.
        path: PathBuf,
        /// What does not fit.
        what: String,
    },
    /// A whole checkpoint of a run that began with another value of a setting which it must keep.
    #[error("{setting}'s checkpoint {path:?}: {ADVICE}")]
    OtherSettings {
        /// The file.
        path: PathBuf,
        /// What differs.
        setting: Changed,
    },
    /// A run that is to start anew in a directory that holds one.
    #[error("{0:?} holds a run already: resume it, or choose another directory")]
    RunExists(PathBuf),
    /// The run file cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
}

/// A checkpoint as it was saved.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Saved {
    /// Where it is.
    pub path: PathBuf,
    /// SHA-256 over the file with zeros in its own place, hexadecimal.
    pub seal: String,
}

/// A checkpoint as it was restored.
#[derive(Debug)]
pub struct Restored {
    /// Where it is.
    pub path: PathBuf,
    /// The learning state.
    pub trainer: Trainer,
    /// The rest.
    pub resumption: Resumption,
}

/// Writes a checkpoint into `directory` and removes the oldest, so that `keep` stay, this one among them. What cannot
/// be removed is left, with a warning.
///
/// # Errors
/// When the file system refuses; former checkpoints are then untouched.
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
        .map(|(name, dtype, bytes)| Tensor { name: name.clone(), dtype: *dtype, bytes })
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

/// Removes all but the newest `keep` checkpoints, `newest` being the first of them.
fn prune(directory: &Path, newest: &Path, keep: usize) {
    let mut former = list(directory);
    former.retain(|path| path != newest);
    for old in former.iter().rev().skip(keep.saturating_sub(1)) {
        if let Err(error) = fs::remove_file(old) {
            tracing::warn!(path = ?old, %error, "old checkpoint cannot be removed");
        }
    }
}

/// The checkpoints in `directory`, oldest first; none when it cannot be read.
#[must_use]
pub fn list(directory: &Path) -> Vec<PathBuf> {
    files(directory, "safetensors").unwrap_or_default()
}

/// The files of `directory` that end so, by name; a directory that is not there has none.
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

/// Restores the newest checkpoint in `directory` of a run with `config`; `None` when there is none. Removes what a
/// killed writer left unfinished.
///
/// # Errors
/// When the directory cannot be read, or the newest is damaged or does not fit the run; the message names the file and
/// the former one.
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
    let mut paths = files(directory, "safetensors").map_err(unreadable)?;
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
/// When it cannot be read, is damaged, of another format, or does not fit the run.
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

/// The setting in which `config` differs from `began_with`; a text that cannot be read tells of none.
fn changed(config: &RunConfig, began_with: &str) -> Option<Changed> {
    settings::first_change(config, began_with).ok().flatten()
}

/// Refuses settings with which the run whose checkpoints are in `directory` cannot go on, as far as the newest one's
/// header tells; gives whether it does. Whether that checkpoint is sound is for [`load_newest`] to say.
///
/// # Errors
/// When a setting differs that a run must keep.
pub fn check_settings(directory: &Path, config: &RunConfig) -> Result<bool, CheckpointError> {
    let told = list(directory).pop().and_then(|path| Some((sealed::settings_of(&path)?, path)));
    let Some((began_with, path)) = told else { return Ok(false) };
    match changed(config, &began_with) {
        Some(setting) => Err(CheckpointError::OtherSettings { path, setting }),
        None => Ok(true),
    }
}

#[cfg(test)]
mod tests;
