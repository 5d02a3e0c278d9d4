//! What a run's processes read: the settings and the teacher of this start.
//!
//! A process that is started again reads what its predecessor read, whatever has become of `run.toml` and of the
//! teacher's file meanwhile.

use std::path::{Path, PathBuf};

use super::plan::Plan;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::run_file;

/// Files in the run directory that belong to one start; removed with this value.
#[derive(Debug)]
pub(super) struct InUse {
    directory: PathBuf,
}

impl InUse {
    /// Writes the files; the caller holds the run directory's lock.
    pub(super) fn write(plan: &Plan) -> Result<Self, Failed> {
        let in_use = Self { directory: directory(&plan.out) };
        let failed = || format!("cannot write to {}", plan.out.display());
        std::fs::create_dir_all(&in_use.directory).or_exit(Exit::TryAgain, failed)?;
        let text = run_file::to_text(&plan.config)?;
        std::fs::write(settings(&plan.out), text).or_exit(Exit::TryAgain, failed)?;
        if let Some(teacher) = &plan.teacher {
            let saved = teacher.policy.save(&self::teacher(&plan.out));
            saved.or_exit(Exit::TryAgain, failed)?;
        }
        Ok(in_use)
    }
}

impl Drop for InUse {
    fn drop(&mut self) {
        drop(std::fs::remove_dir_all(&self.directory));
    }
}

fn directory(out: &Path) -> PathBuf {
    out.join("in-use")
}

/// The run file of this start.
pub(super) fn settings(out: &Path) -> PathBuf {
    directory(out).join("settings.toml")
}

/// The teacher's policy of this start.
pub(super) fn teacher(out: &Path) -> PathBuf {
    directory(out).join("teacher.safetensors")
}
