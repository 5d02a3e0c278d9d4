//! An MCAP file while it is written: its names, options and channels.

use std::collections::BTreeMap;
use std::fs::{File, TryLockError};
use std::io::BufWriter;
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

use foxglove::Encode;
use foxglove::messages::{Log, Timestamp, log::Level};
use mcap::records::{MessageHeader, Metadata};
use tandem_system::atomic_file;

use crate::error::Error;

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
        let part_path = part_path(path);
        // Two workers may record one episode: a slot is played twice if its first worker is slow.
        let options = File::options().write(true).create(true).truncate(false).open(&part_path);
        let file = options.map_err(Error::io("create", &part_path))?;
        if let Err(TryLockError::WouldBlock) = file.try_lock() {
            return Err(Error::LogInUse { path: path.to_owned() });
        }
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
        message
            .encode(&mut file.buffer)
            .map_err(|error| std::io::Error::other(error.to_string()))?;
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
