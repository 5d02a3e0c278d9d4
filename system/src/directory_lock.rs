//! Locks on directories.
//!
//! The lock is on the directory itself, so there is no lock file that a cleanup could remove. The system releases a
//! lock however its process ends.

use std::fs::{File, TryLockError};
use std::io::{self, ErrorKind};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

/// Attempts to open a directory that is being replaced at the same time.
const MAX_ATTEMPTS: usize = 10;

/// An exclusive advisory lock on a directory. Dropping it releases the lock.
#[derive(Debug)]
pub struct DirectoryLock {
    path: PathBuf,
    directory: File,
}

impl DirectoryLock {
    /// Locks the directory `path`, or returns `None` if it is already locked. On a file system without locks, this logs
    /// a warning and returns a lock that excludes no other process.
    ///
    /// # Errors
    /// When `path` cannot be opened or is not a directory.
    pub fn try_take(path: &Path) -> io::Result<Option<Self>> {
        for _ in 0..MAX_ATTEMPTS {
            let directory = File::open(path)?;
            if !directory.metadata()?.is_dir() {
                return Err(ErrorKind::NotADirectory.into());
            }
            match directory.try_lock() {
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => return Ok(None),
                Err(TryLockError::Error(error)) => tracing::warn!(
                    %error,
                    ?path,
                    "this file system has no locks: make sure that no second process uses the directory"
                ),
            }
            let lock = Self { path: path.to_owned(), directory };
            // Another directory may have taken its place between opening and locking.
            if lock.is_in_place() {
                return Ok(Some(lock));
            }
        }
        Err(io::Error::new(ErrorKind::NotFound, "it is being replaced repeatedly"))
    }

    /// Returns whether the path still leads to the locked directory, which may have been moved, removed or replaced.
    /// Returns `true` while that cannot be determined.
    #[must_use]
    pub fn is_in_place(&self) -> bool {
        let identity = |metadata: std::fs::Metadata| (metadata.dev(), metadata.ino());
        match (std::fs::metadata(&self.path), self.directory.metadata()) {
            (Ok(current), Ok(locked)) => identity(current) == identity(locked),
            (Err(error), _) => {
                !matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory)
            }
            (Ok(_), Err(_)) => true,
        }
    }
}

impl Drop for DirectoryLock {
    /// Releases the lock. Closing the directory is not enough while a process that was just forked has a copy of it.
    fn drop(&mut self) {
        if let Err(error) = self.directory.unlock() {
            tracing::debug!(%error, path = ?self.path, "the lock on the directory cannot be released");
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn is_free(path: &Path) -> bool {
        DirectoryLock::try_take(path).expect("a directory").is_some()
    }

    #[test]
    fn a_directory_has_one_lock_at_a_time() {
        let keep = tempfile::tempdir().expect("a directory");
        let held = DirectoryLock::try_take(keep.path()).expect("a directory").expect("free");
        assert!(!is_free(keep.path()));
        let copy = held.directory.try_clone().expect("a copy, as a forked process has it");
        drop(held);
        assert!(is_free(keep.path()));
        drop(copy);
    }

    #[test]
    fn a_lock_creates_no_file() {
        let keep = tempfile::tempdir().expect("a directory");
        let held = DirectoryLock::try_take(keep.path()).expect("a directory").expect("free");
        assert_eq!(fs::read_dir(keep.path()).expect("readable").count(), 0);
        assert!(held.is_in_place());
    }

    #[test]
    fn a_replaced_directory_is_detected() {
        let keep = tempfile::tempdir().expect("a directory");
        let path = keep.path().join("run");
        fs::create_dir(&path).expect("creates");
        let held = DirectoryLock::try_take(&path).expect("a directory").expect("free");
        fs::rename(&path, keep.path().join("moved")).expect("moves");
        assert!(!held.is_in_place(), "moved");
        fs::create_dir(&path).expect("creates");
        assert!(!held.is_in_place(), "another directory is in its place");
        assert!(is_free(&path) && !is_free(&keep.path().join("moved")));
        fs::remove_dir(&path).expect("removes");
        fs::write(&path, "").expect("writes");
        assert!(!held.is_in_place(), "a file is in its place");
        let refused = DirectoryLock::try_take(&path).expect_err("a file");
        assert_eq!(refused.kind(), ErrorKind::NotADirectory);
        fs::remove_file(&path).expect("removes");
        fs::rename(keep.path().join("moved"), &path).expect("moves");
        assert!(held.is_in_place(), "moved back");
    }
}
