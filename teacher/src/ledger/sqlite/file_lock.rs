//! Exclusive ownership of a ledger's file, and the check that the path still leads to it.

use std::collections::BTreeSet;
use std::fs::{File, Metadata};
use std::io::{self, ErrorKind};
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use nix::errno::Errno;
use nix::fcntl::{FcntlArg, fcntl};
use nix::libc;

use crate::ledger::OpenError;

/// The byte that the owner of a file locks. It lies beyond the data of any database and beyond the bytes that SQLite
/// locks, so that the locks do not conflict on systems such as NFS that do not distinguish their kinds.
const LOCKED_BYTE: i64 = 1 << 62;

/// The ledger files that this process has open.
///
/// SQLite's own locks are POSIX locks: the system releases them as soon as the process closes any descriptor of the
/// file. A second attempt to open a ledger in one process is therefore refused before it opens the file.
static HELD: Mutex<BTreeSet<FileId>> = Mutex::new(BTreeSet::new());

/// The identity of a file, independent of its names.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct FileId {
    device: u64,
    inode: u64,
}

/// Exclusive ownership of a ledger's file, under all its names and against all processes, until the value is dropped or
/// the process ends. The lock is on the file itself, so deleting other files does not release it.
#[derive(Debug)]
pub(super) struct FileLock {
    id: FileId,
    /// The given path, made absolute.
    path: PathBuf,
    /// The path without symbolic links. SQLite creates its own files in the same directory.
    resolved: PathBuf,
    /// SQLite's write-ahead log, once it exists.
    log: Option<FileId>,
    /// The open file that has the lock.
    file: File,
}

/// The reason why no further transaction is written to a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum Displaced {
    /// The path no longer leads to the file.
    #[error(
        "the file was deleted, moved or replaced while in use: put it back and restart the teacher"
    )]
    Database,
    /// The path of the write-ahead log no longer leads to the log.
    #[error("its -wal file was deleted, moved or replaced while in use: restart the teacher")]
    Log,
}

impl FileLock {
    /// Locks the file at `path`, which is created if it does not exist.
    pub(super) fn acquire(path: &Path) -> Result<Self, OpenError> {
        let failed = |source| open_failed(path, source);
        // A name such as ":memory:" is a file too.
        let absolute = std::path::absolute(path).map_err(failed)?;
        let mut held = HELD.lock().unwrap_or_else(PoisonError::into_inner);
        match std::fs::metadata(&absolute) {
            Ok(metadata) => check_free(&metadata, &held, path)?,
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            Err(error) => return Err(failed(error)),
        }
        let file = File::options()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .mode(0o644)
            .open(&absolute)
            .map_err(failed)?;
        lock(&file, path)?;
        let metadata = file.metadata().map_err(failed)?;
        check_free(&metadata, &held, path)?;
        check_names(&metadata, path)?;
        let resolved = std::fs::canonicalize(&absolute).map_err(failed)?;
        let id = FileId::of(&metadata);
        held.insert(id);
        Ok(Self { id, path: absolute, resolved, log: None, file })
    }

    /// Returns the path for SQLite.
    pub(super) fn resolved_path(&self) -> &Path {
        &self.resolved
    }

    /// Remembers the identity of the write-ahead log, which SQLite has created by now.
    pub(super) fn remember_log(&mut self) {
        self.log = FileId::at(&self.log_path());
    }

    /// Checks that the paths of the file and of its write-ahead log still lead to them.
    pub(super) fn check_in_place(&self) -> Result<(), Displaced> {
        if FileId::at(&self.path) != Some(self.id) {
            return Err(Displaced::Database);
        }
        if FileId::at(&self.log_path()) != self.log {
            return Err(Displaced::Log);
        }
        Ok(())
    }

    fn log_path(&self) -> PathBuf {
        let mut name = self.resolved.as_os_str().to_owned();
        name.push("-wal");
        name.into()
    }
}

impl Drop for FileLock {
    /// Releases the lock explicitly: closing the file does not release it while a forked process has a copy of it.
    fn drop(&mut self) {
        if let Err(error) = fcntl(&self.file, FcntlArg::F_OFD_SETLK(&byte_lock(libc::F_UNLCK))) {
            tracing::warn!(%error, path = ?self.path, "the lock on the ledger is not released");
        }
        HELD.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.id);
    }
}

impl FileId {
    fn of(metadata: &Metadata) -> Self {
        Self { device: metadata.dev(), inode: metadata.ino() }
    }

    /// Returns the file that `path` leads to, if any.
    fn at(path: &Path) -> Option<Self> {
        std::fs::metadata(path).ok().as_ref().map(Self::of)
    }
}

/// Refuses anything but a regular file, and a file that this process has open already.
fn check_free(metadata: &Metadata, held: &BTreeSet<FileId>, path: &Path) -> Result<(), OpenError> {
    let bad_path = |what: &str| OpenError::BadPath { path: path.into(), what: what.to_owned() };
    if metadata.is_dir() {
        return Err(bad_path("it is a directory"));
    }
    if !metadata.is_file() {
        return Err(bad_path("it is not a regular file"));
    }
    if held.contains(&FileId::of(metadata)) {
        return Err(OpenError::InUse(path.to_owned()));
    }
    Ok(())
}

/// Refuses a file with several names: SQLite names its log after one of them and does not find it under another.
fn check_names(metadata: &Metadata, path: &Path) -> Result<(), OpenError> {
    if metadata.nlink() <= 1 {
        return Ok(());
    }
    let what =
        format!("the file has {} names (hard links), keep only one of them", metadata.nlink());
    Err(OpenError::BadPath { path: path.to_owned(), what })
}

/// Locks one byte with a lock that belongs to `file` instead of the process.
fn lock(file: &File, path: &Path) -> Result<(), OpenError> {
    match fcntl(file, FcntlArg::F_OFD_SETLK(&byte_lock(libc::F_WRLCK))) {
        Ok(_) => Ok(()),
        Err(Errno::EAGAIN | Errno::EACCES) => Err(OpenError::InUse(path.to_owned())),
        Err(errno) => Err(OpenError::Io { path: path.to_owned(), source: errno.into() }),
    }
}

/// Describes a lock of `kind` on the locked byte.
fn byte_lock(kind: i32) -> libc::flock {
    libc::flock {
        l_type: i16::try_from(kind).expect("a small number"),
        l_whence: i16::try_from(libc::SEEK_SET).expect("a small number"),
        l_start: LOCKED_BYTE,
        l_len: 1,
        l_pid: 0,
    }
}

/// Maps an error of the system to the reason why the ledger at `path` cannot be opened.
fn open_failed(path: &Path, source: io::Error) -> OpenError {
    let path = path.to_owned();
    let what = match source.kind() {
        ErrorKind::NotFound | ErrorKind::NotADirectory => {
            match path.parent().filter(|parent| !parent.is_dir() && !parent.as_os_str().is_empty())
            {
                Some(directory) => format!("there is no directory {directory:?}"),
                None => source.to_string(),
            }
        }
        ErrorKind::InvalidFilename | ErrorKind::InvalidInput => source.to_string(),
        _ => return OpenError::Io { path, source },
    };
    OpenError::BadPath { path, what }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ledger_is_free_at_once_although_a_forked_process_has_a_copy_of_its_file() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("ledger.sqlite");
        let lock = FileLock::acquire(&path).expect("free");
        let copy = lock.file.try_clone().expect("a copy");
        assert!(matches!(FileLock::acquire(&path), Err(OpenError::InUse(_))));
        drop(lock);
        assert!(FileLock::acquire(&path).is_ok(), "free again");
        drop(copy);
    }

    /// Programs of all versions must lock the same byte, or two of them would own one ledger.
    #[test]
    fn a_ledger_is_in_use_while_another_program_locks_the_agreed_byte() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("ledger.sqlite");
        let other = File::create(&path).expect("a file");
        let agreed = libc::flock { l_start: 0x4000_0000_0000_0000, ..byte_lock(libc::F_WRLCK) };
        fcntl(&other, FcntlArg::F_OFD_SETLK(&agreed)).expect("locked");
        assert!(matches!(FileLock::acquire(&path), Err(OpenError::InUse(_))));
    }
}
