//! Files of a run while it is trained: copies of the settings and of the teacher, and the address of the learner.
//!
//! A restarted process reads the same copies, even if `run.toml` or the teacher's file has changed since. `tandem status`
//! reads the address.

use std::path::{Path, PathBuf};

use tandem_system::atomic_file;

use super::plan::Plan;
use super::run_lock::RunLock;
use super::teacher_file::TeacherFile;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::run_directory::{in_use, learner_address};
use crate::run_file;

/// The files of one start, in the subdirectory `in-use`. Dropping this value removes them, unless another directory has
/// taken the place of the run's.
#[derive(Debug)]
pub(super) struct RunInputs<'a> {
    directory: PathBuf,
    lock: &'a RunLock,
}

impl<'a> RunInputs<'a> {
    /// Writes the copies to the run directory, which `lock` locks.
    pub(super) fn write(plan: &Plan, lock: &'a RunLock) -> Result<Self, Failed> {
        let inputs = Self { directory: in_use(&plan.out), lock };
        let failed = || format!("cannot write to {}", plan.out.display());
        let directory = || format!("cannot create {}", inputs.directory.display());
        std::fs::create_dir_all(&inputs.directory).or_cannot_write(directory)?;
        // An earlier start that was killed has left the address of its learner.
        drop(std::fs::remove_file(learner_address(&plan.out)));
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

/// Writes the address of the learner, which it keeps when it is restarted.
pub(super) fn write_learner_address(out: &Path, address: &str) -> Result<(), Failed> {
    let path = learner_address(out);
    let written = atomic_file::replace(&path, format!("{address}\n").as_bytes());
    written.or_cannot_write(|| format!("cannot write {}", path.display()))
}

/// Returns the path of the settings.
pub(super) fn settings(out: &Path) -> PathBuf {
    in_use(out).join("settings.toml")
}

/// Returns the path of the teacher's policy.
pub(super) fn teacher(out: &Path, teacher: &TeacherFile) -> PathBuf {
    teacher.copy_path(&in_use(out))
}

/// Returns the path of the teacher's critic, if it has a file of its own.
pub(super) fn teacher_critic(out: &Path, teacher: &TeacherFile) -> Option<PathBuf> {
    teacher.critic_copy_path(&in_use(out))
}
