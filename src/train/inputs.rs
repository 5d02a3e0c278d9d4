//! Files that the processes of a run read: copies of the settings and of the teacher.
//!
//! A restarted process reads the same copies, even if `run.toml` or the teacher's file has changed since.

use std::path::{Path, PathBuf};

use tandem_system::atomic_file;

use super::plan::Plan;
use super::run_lock::RunLock;
use super::teacher_file::TeacherFile;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::run_file;

/// The copies of one start, in the subdirectory `in-use`. Dropping this value removes them, unless another directory has
/// taken the place of the run's.
#[derive(Debug)]
pub(super) struct RunInputs<'a> {
    directory: PathBuf,
    lock: &'a RunLock,
}

impl<'a> RunInputs<'a> {
    /// Writes the copies to the run directory, which `lock` locks.
    pub(super) fn write(plan: &Plan, lock: &'a RunLock) -> Result<Self, Failed> {
        let inputs = Self { directory: directory(&plan.out), lock };
        let failed = || format!("cannot write to {}", plan.out.display());
        std::fs::create_dir_all(&inputs.directory).or_exit(Exit::TryAgain, failed)?;
        let text = run_file::to_text(&plan.config)?;
        atomic_file::replace(&settings(&plan.out), text.as_bytes())
            .or_exit(Exit::TryAgain, failed)?;
        if let Some(teacher) = &plan.teacher {
            let written = teacher.write_to(&inputs.directory);
            written.map_err(|failure| failure.context(failed()))?;
        }
        Ok(inputs)
    }
}

impl Drop for RunInputs<'_> {
    fn drop(&mut self) {
        if self.lock.is_in_place() {
            drop(std::fs::remove_dir_all(&self.directory));
        }
    }
}

fn directory(out: &Path) -> PathBuf {
    out.join("in-use")
}

/// Returns the path of the settings.
pub(super) fn settings(out: &Path) -> PathBuf {
    directory(out).join("settings.toml")
}

/// Returns the path of the teacher's policy.
pub(super) fn teacher(out: &Path, teacher: &TeacherFile) -> PathBuf {
    teacher.copy_path(&directory(out))
}

/// Returns the path of the teacher's critic, if it has a file of its own.
pub(super) fn teacher_critic(out: &Path, teacher: &TeacherFile) -> Option<PathBuf> {
    teacher.critic_copy_path(&directory(out))
}
