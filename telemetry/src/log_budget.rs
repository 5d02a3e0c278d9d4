//! A size limit on the logs in a directory.

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};

use crate::error::Error;
use crate::log_name::LogName;

/// Share of the limit that remains occupied after logs were deleted, in eighths.
const KEPT_EIGHTHS: u64 = 7;
/// Number of processes that can write to one directory at once without exceeding the limit by more than a log each.
const MAX_WRITERS: u64 = 16;

/// Keeps the logs of episodes and motions in a directory below a size by deleting the oldest ones, until seven eighths
/// of it are left.
///
/// Logs of training episodes are deleted first, those of evaluations only when no others are left; within a kind, the
/// lowest parameter version and then the lowest episode number is the oldest, and for motions the date and the number.
/// Incomplete logs (`NAME.mcap.part`) count as well, but those that are being written are not deleted. Files with other
/// names are neither counted nor deleted.
///
/// Several processes may write to the directory, each with its own value of this type.
#[derive(Debug)]
pub struct LogBudget {
    directory: PathBuf,
    limit_bytes: u64,
    /// Bytes that may be written before the directory must be read again.
    allowance_bytes: u64,
}

impl LogBudget {
    /// Creates the limit of `limit_bytes` for the logs in `directory`.
    #[must_use]
    pub const fn new(directory: PathBuf, limit_bytes: u64) -> Self {
        Self { directory, limit_bytes, allowance_bytes: 0 }
    }

    /// Accounts for the new log `path` of `n_bytes` in the directory, and returns the number of logs deleted, which are
    /// others.
    ///
    /// # Errors
    /// If the directory cannot be read or a log cannot be deleted.
    pub fn add(&mut self, path: &Path, n_bytes: u64) -> Result<usize, Error> {
        match self.allowance_bytes.checked_sub(n_bytes) {
            Some(left) => {
                self.allowance_bytes = left;
                Ok(0)
            }
            None => self.enforce_except(Some(path)),
        }
    }

    /// Reads the directory and deletes the oldest logs if it exceeds the limit, except the newest log, which may alone
    /// exceed it. Returns the number of logs deleted.
    ///
    /// # Errors
    /// If the directory cannot be read or a log cannot be deleted.
    pub fn enforce_but_newest(&mut self) -> Result<usize, Error> {
        let newest = read_logs(&self.directory)?.into_iter().max();
        self.enforce_except(newest.as_ref().map(|log| &*log.path))
    }

    fn enforce_except(&mut self, newest: Option<&Path>) -> Result<usize, Error> {
        let mut logs = read_logs(&self.directory)?;
        logs.sort_unstable();
        let mut occupied: u64 = logs.iter().map(|log| log.n_bytes).sum();
        let mut n_deleted = 0;
        if occupied > self.limit_bytes {
            let kept = self.limit_bytes / 8 * KEPT_EIGHTHS;
            for log in logs {
                if occupied <= kept {
                    break;
                }
                if newest == Some(&*log.path) || is_being_written(&log.path) {
                    continue;
                }
                delete(&log.path)?;
                occupied -= log.n_bytes;
                n_deleted += 1;
            }
        }
        self.allowance_bytes = self.limit_bytes.saturating_sub(occupied) / MAX_WRITERS;
        Ok(n_deleted)
    }
}

/// A log in the directory. The order is that in which logs are deleted.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct LogEntry {
    name: LogName,
    path: PathBuf,
    n_bytes: u64,
}

fn read_logs(directory: &Path) -> Result<Vec<LogEntry>, Error> {
    let entries = std::fs::read_dir(directory).map_err(Error::io("read", directory))?;
    let mut logs = Vec::new();
    for entry in entries {
        let entry = entry.map_err(Error::io("read", directory))?;
        let path = entry.path();
        let Some(name) = name_of(&path) else { continue };
        // A log that another process has just deleted or renamed occupies nothing.
        let Ok(metadata) = entry.metadata() else { continue };
        logs.push(LogEntry { name, path, n_bytes: metadata.len() });
    }
    Ok(logs)
}

/// Returns the name of a log, complete or not (`NAME.mcap.part`).
fn name_of(path: &Path) -> Option<LogName> {
    match is_incomplete(path) {
        true => LogName::of(&path.with_extension("")),
        false => LogName::of(path),
    }
}

fn is_incomplete(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "part")
}

/// Returns true if a writer holds the lock of an incomplete log.
fn is_being_written(path: &Path) -> bool {
    // A shared lock, because NFS refuses an exclusive one to a file that is not open for writing.
    is_incomplete(path)
        && File::open(path)
            .is_ok_and(|file| matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock)))
}

/// Deletes a log, unless another process has done so.
fn delete(path: &Path) -> Result<(), Error> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(Error::io("delete", path)(error))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn names(directory: &Path) -> Vec<String> {
        let entries = fs::read_dir(directory).unwrap();
        let mut names: Vec<String> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn the_newest_log_remains_even_if_it_exceeds_the_limit() {
        let directory = tempfile::tempdir().unwrap();
        for name in ["motion-20260101-000001.mcap", "motion-20260101-000002.mcap"] {
            fs::write(directory.path().join(name), [0; 100]).unwrap();
        }
        let mut budget = LogBudget::new(directory.path().to_owned(), 50);
        assert_eq!(budget.enforce_but_newest().unwrap(), 1);
        assert_eq!(names(directory.path()), ["motion-20260101-000002.mcap"]);
    }

    #[test]
    fn the_oldest_training_logs_are_deleted_first_and_evaluations_last() {
        let directory = tempfile::tempdir().unwrap();
        let write = |name: &str| fs::write(directory.path().join(name), [0; 100]).unwrap();
        // The order of names differs from that of numbers once a number outgrows its digits.
        let files = [
            "eval-000001-000.mcap",
            "notes.txt",
            "train-000002-000001.mcap",
            "train-000010-000005.mcap",
            "train-1000000-000009.mcap",
            "train-999999-000009.mcap.part",
        ];
        files.iter().for_each(|name| write(name));
        let incomplete = directory.path().join("train-999999-000009.mcap.part");
        let writer = File::options().write(true).open(&incomplete).unwrap();
        writer.try_lock().unwrap();
        let mut budget = LogBudget::new(directory.path().to_owned(), 500);
        assert_eq!(budget.enforce_except(None).unwrap(), 0, "other files are not counted");

        budget.limit_bytes = 400;
        assert_eq!(budget.enforce_except(None).unwrap(), 2);
        assert_eq!(
            names(directory.path()),
            [
                "eval-000001-000.mcap",
                "notes.txt",
                "train-1000000-000009.mcap",
                "train-999999-000009.mcap.part"
            ]
        );
        budget.limit_bytes = 240;
        assert_eq!(budget.enforce_except(None).unwrap(), 1, "a log that is being written stays");
        assert!(incomplete.exists());
        drop(writer);
        budget.limit_bytes = 120;
        assert_eq!(budget.enforce_except(None).unwrap(), 1);
        assert_eq!(names(directory.path()), ["eval-000001-000.mcap", "notes.txt"]);
        budget.limit_bytes = 10;
        assert_eq!(budget.enforce_except(None).unwrap(), 1);
        assert_eq!(names(directory.path()), ["notes.txt"]);
    }

    #[test]
    fn a_new_log_that_is_larger_than_the_limit_stays() {
        let directory = tempfile::tempdir().unwrap();
        let mut budget = LogBudget::new(directory.path().to_owned(), 100);
        for name in ["motion-20261129211303-000001.mcap", "motion-20261129211304-000002.mcap"] {
            let path = directory.path().join(name);
            fs::write(&path, [0; 300]).unwrap();
            budget.add(&path, 300).unwrap();
            assert_eq!(names(directory.path()), [name]);
        }
    }

    #[test]
    fn several_writers_stay_below_the_limit() {
        let directory = tempfile::tempdir().unwrap();
        let (limit, n_writers, n_bytes) = (6_000_u64, 4, 300_u64);
        let mut writers: Vec<LogBudget> =
            (0..n_writers).map(|_| LogBudget::new(directory.path().to_owned(), limit)).collect();
        let mut largest = 0;
        for number in 0..100_u64 {
            let name = format!("train-000001-{number:06}.mcap");
            fs::write(directory.path().join(&name), vec![0; usize::try_from(n_bytes).unwrap()])
                .unwrap();
            let writer = &mut writers[usize::try_from(number).unwrap() % n_writers];
            writer.add(&directory.path().join(name), n_bytes).unwrap();
            largest = largest.max(names(directory.path()).len() as u64 * n_bytes);
        }
        assert!(largest <= limit + n_writers as u64 * n_bytes, "{largest}");
        assert!(largest > limit / 2, "{largest}");
        assert!(directory.path().join("train-000001-000099.mcap").exists(), "the newest stays");
    }
}
