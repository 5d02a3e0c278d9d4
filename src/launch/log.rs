//! The log file that collects the standard error of child processes.

use std::fs::{File, OpenOptions};
use std::io::{self, Read as _, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};
use std::process::Stdio;

use anyhow::Context as _;

/// The prefix of the line in which this program reports an error.
const ERROR_PREFIX: &str = "tandem: ";

/// A log file that is open for appending.
#[derive(Debug)]
pub(crate) struct ProcessLog {
    path: PathBuf,
    file: File,
}

impl ProcessLog {
    /// Opens the log, or creates it.
    pub(crate) fn open(path: &Path) -> anyhow::Result<Self> {
        let file = OpenOptions::new().create(true).append(true).open(path);
        let file = file.with_context(|| format!("cannot write {}", path.display()))?;
        Ok(Self { path: path.to_owned(), file })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the open file. Its lock lasts until this process and every child that writes to it have ended.
    pub(crate) const fn file(&self) -> &File {
        &self.file
    }

    pub(super) fn try_clone(&self) -> io::Result<Stdio> {
        Ok(self.file.try_clone()?.into())
    }

    /// Returns the current size.
    pub(crate) fn n_bytes(&self) -> u64 {
        self.file.metadata().map_or(0, |metadata| metadata.len())
    }

    /// Returns the text from `offset` to the end; an empty one if the file cannot be read.
    pub(crate) fn text_since(&self, offset: u64) -> String {
        text_since(&self.path, offset).unwrap_or_default()
    }

    /// Returns the last error that a process has reported since the log had `offset` bytes.
    ///
    /// If there is none, a line about that is added to the log, which shows whether the process could have written one.
    pub(crate) fn last_error_since(&self, offset: u64) -> String {
        let text = self.text_since(offset);
        let reported = text.lines().rev().find_map(|line| line.strip_prefix(ERROR_PREFIX));
        let path = self.path.display();
        match reported.map_or_else(|| self.note_silence().map(|()| "no reason reported"), Ok) {
            Ok(reason) => reason.to_owned(),
            Err(error) => format!("no reason reported: {path} cannot be written: {error}"),
        }
    }

    fn note_silence(&self) -> io::Result<()> {
        // The path is opened again: the file that is open may have been deleted.
        let mut log = OpenOptions::new().append(true).open(&self.path)?;
        log.write_all(b"a process ended without reporting a reason\n")
    }
}

/// Returns the text of a file from `offset` to the end.
fn text_since(path: &Path, offset: u64) -> io::Result<String> {
    let mut file = File::open(path)?;
    file.seek(SeekFrom::Start(offset))?;
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes)?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

/// Returns the last line of `text` that is not blank.
pub(crate) fn last_line(text: &str) -> Option<&str> {
    text.lines().rfind(|line| !line.trim().is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn log(text: &str) -> (tempfile::TempDir, ProcessLog) {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("tandem.log");
        std::fs::write(&path, text).expect("writes");
        let log = ProcessLog::open(&path).expect("opens");
        (directory, log)
    }

    #[test]
    fn the_last_error_since_the_start_of_a_process_is_found() {
        let (_directory, log) = log("tandem: before\nINFO round 1\ntandem: now\nINFO bye\n");
        assert_eq!(log.last_error_since(15), "now");
        assert_eq!(log.last_error_since(0), "now");
        assert_eq!(log.n_bytes(), 49);
    }

    #[test]
    fn a_process_without_an_error_line_is_noted_in_the_log() {
        let (_directory, log) = log("tandem: before\n");
        assert_eq!(log.last_error_since(15), "no reason reported");
        assert_eq!(log.text_since(15), "a process ended without reporting a reason\n");
    }

    #[test]
    fn the_last_line_is_one_that_is_not_blank() {
        assert_eq!(last_line("one\ntwo\n \n\n"), Some("two"));
        assert_eq!(last_line("\n"), None);
    }
}
