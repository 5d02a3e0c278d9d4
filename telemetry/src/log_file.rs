//! An MCAP file while it is written: its names, options and channels.

use std::collections::BTreeMap;
use std::fs::{File, Metadata as FileMetadata, TryLockError};
use std::io::{self, BufWriter, ErrorKind};
use std::marker::PhantomData;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use foxglove::Encode;
use foxglove::messages::{Log, Timestamp, log::Level};
use mcap::records::{MessageHeader, Metadata};
use tandem_system::atomic_file;

use crate::error::Error;

/// Attempts to open a file that another writer completes at the same time.
const MAX_ATTEMPTS: usize = 10;

/// An MCAP writer with the path of its file and a buffer for encoding messages.
///
/// The file is named `NAME.part` until [`finish`](Self::finish) syncs and renames it, so a file without that suffix is
/// complete even after a power cut.
pub(crate) struct LogFile {
    path: PathBuf,
    part_path: PathBuf,
    writer: mcap::Writer<BufWriter<File>>,
    buffer: Vec<u8>,
}

impl LogFile {
    /// Creates the file that will be named `path`. An incomplete file of that name is overwritten, unless another writer
    /// still has it.
    pub(crate) fn create(path: &Path) -> Result<Self, Error> {
        Self::create_with(path, open)
    }

    fn create_with(path: &Path, open: impl Fn(&Path) -> io::Result<File>) -> Result<Self, Error> {
        let part_path = part_path(path);
        let file = open_locked(&part_path, open).map_err(Error::io("create", &part_path))?;
        let file = file.ok_or_else(|| Error::LogInUse { path: path.to_owned() })?;
        file.set_len(0).map_err(Error::io("create", &part_path))?;
        let writer = write_options().create(BufWriter::new(file));
        let writer = writer.map_err(Error::write_log(&part_path))?;
        Ok(Self { path: path.to_owned(), part_path, writer, buffer: Vec::new() })
    }

    /// Returns a function for `map_err` on writing to this file.
    pub(crate) fn write_error(&self) -> impl FnOnce(mcap::McapError) -> Error {
        Error::write_log(&self.part_path)
    }

    pub(crate) fn write_metadata(
        &mut self,
        name: &str,
        metadata: BTreeMap<String, String>,
    ) -> mcap::McapResult<()> {
        self.writer.write_metadata(&Metadata { name: name.to_owned(), metadata })
    }

    /// Flushes everything so far to the file, where it outlives the process.
    pub(crate) fn flush(&mut self) -> mcap::McapResult<()> {
        self.writer.flush()
    }

    /// Completes the file, gives it its name and returns that.
    pub(crate) fn finish(mut self) -> Result<PathBuf, Error> {
        self.writer.finish().map_err(Error::write_log(&self.part_path))?;
        let file = self.writer.into_inner();
        atomic_file::publish(file.get_ref(), &self.part_path, &self.path)
            .map_err(Error::io("complete", &self.part_path))?;
        Ok(self.path)
    }
}

/// A channel of one log.
pub(crate) struct Channel<T> {
    id: u16,
    n_messages: u32,
    message: PhantomData<T>,
}

impl<T: Encode> Channel<T> {
    pub(crate) fn open(file: &mut LogFile, topic: &str) -> mcap::McapResult<Self> {
        let schema_id = match T::get_schema() {
            Some(schema) => file.writer.add_schema(&schema.name, &schema.encoding, &schema.data)?,
            None => 0,
        };
        let id = file.writer.add_channel(
            schema_id,
            topic,
            &T::get_message_encoding(),
            &BTreeMap::new(),
        )?;
        Ok(Self { id, n_messages: 0, message: PhantomData })
    }

    pub(crate) fn write(
        &mut self,
        file: &mut LogFile,
        time_ns: u64,
        message: &T,
    ) -> mcap::McapResult<()> {
        file.buffer.clear();
        message.encode(&mut file.buffer).map_err(|error| io::Error::other(error.to_string()))?;
        let header = MessageHeader {
            channel_id: self.id,
            sequence: self.n_messages,
            log_time: time_ns,
            publish_time: time_ns,
        };
        self.n_messages += 1;
        file.writer.write_to_known_channel(&header, &file.buffer)
    }
}

/// Opens and locks the file `path`; returns `None` if another writer has it.
fn open_locked(path: &Path, open: impl Fn(&Path) -> io::Result<File>) -> io::Result<Option<File>> {
    // Two workers may record one episode: a slot is played twice if its first worker is slow.
    for _ in 0..MAX_ATTEMPTS {
        let file = open(path)?;
        if let Err(TryLockError::WouldBlock) = file.try_lock() {
            return Ok(None);
        }
        // Between opening and locking, the other writer may have completed and renamed this file.
        if leads_to(path, &file)? {
            return Ok(Some(file));
        }
    }
    Ok(None)
}

/// Opens the file `path`, which may exist, and keeps its contents.
fn open(path: &Path) -> io::Result<File> {
    File::options().write(true).create(true).truncate(false).open(path)
}

fn leads_to(path: &Path, file: &File) -> io::Result<bool> {
    let identity = |metadata: FileMetadata| (metadata.dev(), metadata.ino());
    match std::fs::metadata(path) {
        Ok(metadata) => Ok(identity(metadata) == identity(file.metadata()?)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}

/// Returns the name of `path` while it is written.
fn part_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".part");
    PathBuf::from(name)
}

/// Returns the options of all logs: no helper threads, because there is one writer per episode in progress.
pub(crate) fn write_options() -> mcap::WriteOptions {
    mcap::WriteOptions::new()
        .compression(Some(mcap::Compression::Zstd))
        .compression_level(0)
        .compression_threads(0)
        .library(concat!("tandem/", env!("CARGO_PKG_VERSION")))
}

/// Returns a line for a log channel.
pub(crate) fn log_line(time_ns: u64, level: Level, message: &str) -> Log {
    Log {
        timestamp: Some(timestamp(time_ns)),
        level: level.into(),
        message: message.to_owned(),
        name: "tandem".to_owned(),
        ..Log::default()
    }
}

/// Converts seconds since the start to nanoseconds.
///
/// # Errors
/// If the time is negative, not finite or too large.
pub(crate) fn nanoseconds(time_s: f64) -> Result<u64, Error> {
    let time = std::time::Duration::try_from_secs_f64(time_s).ok();
    time.and_then(|time| u64::try_from(time.as_nanos()).ok()).ok_or(Error::Time { time_s })
}

pub(crate) fn timestamp(time_ns: u64) -> Timestamp {
    Timestamp::saturating_from_epoch_secs_f64(time_ns as f64 * 1e-9)
}

pub(crate) fn check_length(field: &'static str, got: usize, expected: usize) -> Result<(), Error> {
    if got == expected { Ok(()) } else { Err(Error::Length { field, got, expected }) }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::fs;

    use super::*;

    const LOG: &str = "the log of another writer";

    /// Creates a log while another writer completes the same one, after each of the first `n_renamed` times that its
    /// file is opened. Returns the result, whether the other's log is whole and whether there is an incomplete one.
    fn create_during_renames(n_renamed: usize) -> (Result<(), Error>, bool, bool) {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("eval-000001-000.mcap");
        let n_opened = Cell::new(0);
        let created = LogFile::create_with(&path, |part| {
            n_opened.set(n_opened.get() + 1);
            if n_opened.get() > n_renamed {
                return open(part);
            }
            fs::write(part, LOG)?;
            let file = open(part)?;
            fs::rename(part, &path)?;
            Ok(file)
        });
        let is_whole = fs::read_to_string(&path).is_ok_and(|text| text == LOG);
        (created.map(drop), is_whole, part_path(&path).exists())
    }

    #[test]
    fn a_log_that_is_completed_between_opening_and_locking_is_not_overwritten() {
        let (created, is_whole, has_part) = create_during_renames(1);
        assert!(created.is_ok() && is_whole && has_part, "{created:?} {is_whole} {has_part}");
        let (refused, is_whole, has_part) = create_during_renames(usize::MAX);
        assert!(matches!(refused, Err(Error::LogInUse { .. })), "{refused:?}");
        assert!(is_whole && !has_part);
    }

    #[test]
    fn an_incomplete_log_is_overwritten_unless_another_writer_has_it() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("eval-000001-000.mcap");
        fs::write(part_path(&path), LOG).expect("writes");
        let first = LogFile::create(&path).expect("creates");
        let refused = LogFile::create(&path).map(drop).expect_err("another writer has it");
        assert!(matches!(refused, Error::LogInUse { .. }), "{refused}");
        first.finish().expect("completes");
        let bytes = fs::read(&path).expect("readable");
        assert!(bytes.starts_with(mcap::MAGIC) && bytes.ends_with(mcap::MAGIC));
    }
}
