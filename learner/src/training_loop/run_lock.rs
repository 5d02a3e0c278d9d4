//! The locks that keep a second learner out of a run directory.

use std::path::{Path, PathBuf};
use std::time::Duration;

use tandem_system::{DirectoryLock, atomic_file};
use tokio_util::sync::CancellationToken;

use crate::error::Error;
use crate::shared::LearnerConfig;

/// Time that the previous learner may take to save and exit.
const LOCK_TIMEOUT: Duration = Duration::from_secs(30);
/// Pause between two attempts.
const LOCK_TICK: Duration = Duration::from_millis(50);

/// The locks of a run directory.
///
/// Two directories are locked: the run directory by the process in charge of the run, which is this learner or the
/// `tandem train` that started it, and the directory of checkpoints by the learner. So a learner that is still saving
/// is detected even if its `tandem train` is dead.
#[derive(Debug)]
pub(super) struct RunLock {
    out: Option<DirectoryLock>,
    /// `None` if a file is in its place: checkpoints then fail as on a full disk.
    checkpoints: Option<DirectoryLock>,
}

impl RunLock {
    /// Takes the locks, and waits for a learner that holds them to exit.
    ///
    /// # Errors
    /// When another learner still holds a lock after 30 s, or a directory cannot be locked.
    pub(super) fn take(
        config: &LearnerConfig,
        shutdown: &CancellationToken,
    ) -> Result<Self, Error> {
        let until = (config.clock)() + LOCK_TIMEOUT;
        let is_over = || (config.clock)() >= until || shutdown.is_cancelled();
        let out = match config.out_is_locked {
            true => None,
            false => Some(lock(&config.out, &is_over)?),
        };
        let checkpoints = config.out.join("checkpoint");
        let checkpoints = match checkpoints.exists() && !checkpoints.is_dir() {
            true => None,
            false => Some(lock(&checkpoints, &is_over)?),
        };
        Ok(Self { out, checkpoints })
    }

    /// Returns true if the paths still lead to the locked directories.
    pub(super) fn is_in_place(&self) -> bool {
        self.out.iter().chain(&self.checkpoints).all(DirectoryLock::is_in_place)
    }
}

/// Locks `directory`, creating it if necessary; retries until `is_over`.
fn lock(directory: &Path, is_over: &impl Fn() -> bool) -> Result<DirectoryLock, Error> {
    let refused = |source: Box<dyn std::error::Error + Send + Sync>| {
        let path: PathBuf = directory.to_owned();
        Error::RunDirectory { action: "lock", path, source }
    };
    atomic_file::create_directory(directory).map_err(|error| refused(error.into()))?;
    loop {
        match DirectoryLock::try_take(directory) {
            Ok(Some(lock)) => return Ok(lock),
            Ok(None) if is_over() => {
                return Err(refused("another learner is at work in this directory".into()));
            }
            Ok(None) => std::thread::sleep(LOCK_TICK),
            Err(error) => return Err(refused(error.into())),
        }
    }
}
