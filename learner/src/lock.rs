//! Locks on directories.
//!
//! What is locked is the directory itself and not a file beside the data: there is nothing that could be taken for
//! rubbish and removed. The system frees a lock however its process ends.

use std::fs::{File, TryLockError};
use std::io::{self, ErrorKind};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

/// How often a directory that is replaced at the very moment is opened again.
const MAX_TRIES: usize = 10;

/// Keeps others who ask for it out of a directory until it is dropped.
#[derive(Debug)]
pub struct DirectoryLock {
    path: PathBuf,
    directory: File,
}

impl DirectoryLock {
    /// Locks the directory `path`; `None` while somebody else holds its lock. Where the file system has no locks it
    /// says so in one warning and counts as locked.
    ///
    /// # Errors
    /// When `path` cannot be opened or is not a directory.
    pub fn try_take(path: &Path) -> io::Result<Option<Self>> {
        for _ in 0..MAX_TRIES {
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
                    "this file system has no locks: see to it that no second process works in the directory"
                ),
            }
            let lock = Self { path: path.to_owned(), directory };
            // Between the opening and the locking another directory may have taken its place.
            if lock.is_in_place() {
                return Ok(Some(lock));
            }
        }
        Err(io::Error::new(ErrorKind::NotFound, "it is replaced again and again"))
    }

    /// Whether the path still leads to the locked directory, which may have been moved, removed or replaced. Yes while
    /// that cannot be told.
    #[must_use]
    pub fn is_in_place(&self) -> bool {
        let identity = |metadata: std::fs::Metadata| (metadata.dev(), metadata.ino());
        match (std::fs::metadata(&self.path), self.directory.metadata()) {
            (Ok(there), Ok(held)) => identity(there) == identity(held),
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
            tracing::debug!(%error, path = ?self.path, "the lock on the directory is not released");
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
    fn one_at_a_time_holds_a_directory() {
        let keep = tempfile::tempdir().expect("a directory");
        let held = DirectoryLock::try_take(keep.path()).expect("a directory").expect("free");
        assert!(!is_free(keep.path()));
        let copy = held.directory.try_clone().expect("a copy, as a forked process has it");
        drop(held);
        assert!(is_free(keep.path()));
        drop(copy);
    }

    #[test]
    fn no_file_in_the_directory_is_the_lock() {
        let keep = tempfile::tempdir().expect("a directory");
        let held = DirectoryLock::try_take(keep.path()).expect("a directory").expect("free");
        assert_eq!(fs::read_dir(keep.path()).expect("readable").count(), 0);
        assert!(held.is_in_place());
    }

    #[test]
    fn a_directory_that_was_replaced_is_noticed() {
        let keep = tempfile::tempdir().expect("a directory");
        let path = keep.path().join("run");
        fs::create_dir(&path).expect("creates");
        let held = DirectoryLock::try_take(&path).expect("a directory").expect("free");
        fs::rename(&path, keep.path().join("moved")).expect("moves");
        assert!(!held.is_in_place(), "moved");
        fs::create_dir(&path).expect("creates");
        assert!(!held.is_in_place(), "another is in its place");
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
