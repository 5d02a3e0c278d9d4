//! Recovery of the incomplete MCAP file of a killed writer.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use mcap::McapError;
use mcap::records::Record;
use tandem_system::{atomic_file, regular_file};

use crate::error::Error;
use crate::log_file::write_options;
use crate::records::Records;

/// Contents of a recovered file.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct RecoveredCounts {
    /// Number of messages of all channels.
    pub messages: u64,
    /// Number of metadata records.
    pub metadata_records: u64,
    /// Error at which reading of the source ended; `None` if it was complete.
    pub ended_by: Option<String>,
}

/// Copies schemas, channels, messages and metadata of `source`, up to the first damage, to the complete file
/// `destination`.
///
/// Files of other programs can be recovered too. Their attachments and the profile in their header are not copied, and
/// a record or chunk of more than 16 MiB counts as damage.
///
/// `source` is not modified. `destination` is created only when it is complete, so an error leaves no incomplete file.
///
/// # Errors
/// If `source` cannot be read, does not start like an MCAP file or is damaged before its first message, or if
/// `destination` cannot be written.
pub fn recover(source: &Path, destination: &Path) -> Result<RecoveredCounts, Error> {
    let bytes = regular_file::read(source).map_err(Error::io("read", source))?;
    if !bytes.starts_with(mcap::MAGIC) {
        return Err(Error::NotMcap { path: source.to_owned() });
    }
    atomic_file::replace_with(destination, |file| copy_readable(&bytes, file)).map_err(|error| {
        match error {
            CopyError::NoMessage => Error::NothingToRecover { path: source.to_owned() },
            CopyError::Write(error) => Error::write_log(destination)(error),
        }
    })
}

/// The reason why a file is not copied.
enum CopyError {
    NoMessage,
    Write(McapError),
}

impl From<McapError> for CopyError {
    fn from(error: McapError) -> Self {
        Self::Write(error)
    }
}

impl From<std::io::Error> for CopyError {
    fn from(error: std::io::Error) -> Self {
        Self::Write(error.into())
    }
}

fn copy_readable(bytes: &[u8], file: &File) -> Result<RecoveredCounts, CopyError> {
    let mut copy = Copy {
        writer: write_options().create(BufWriter::new(file))?,
        counts: RecoveredCounts::default(),
    };
    copy.counts.ended_by = Some(McapError::UnexpectedEof.to_string());
    for record in Records::of_partial(bytes) {
        let damage = match record {
            Ok(Record::DataEnd(_)) => {
                copy.counts.ended_by = None;
                break;
            }
            Ok(record) => copy.write(&record)?,
            Err(damage) => Some(damage),
        };
        if let Some(damage) = damage {
            copy.counts.ended_by = Some(damage.to_string());
            break;
        }
    }
    if copy.counts.messages == 0 && copy.counts.ended_by.is_some() {
        return Err(CopyError::NoMessage);
    }
    copy.writer.finish()?;
    Ok(copy.counts)
}

/// The recovered file while it is written.
struct Copy<'a> {
    writer: mcap::Writer<BufWriter<&'a File>>,
    counts: RecoveredCounts,
}

impl Copy<'_> {
    /// Writes a record, or returns why it contradicts the previous ones.
    fn write(&mut self, record: &Record<'_>) -> mcap::McapResult<Option<McapError>> {
        match self.try_write(record) {
            Ok(()) => Ok(None),
            Err(error @ (McapError::Io(_) | McapError::AttemptedWriteAfterFailure)) => Err(error),
            Err(contradiction) => Ok(Some(contradiction)),
        }
    }

    fn try_write(&mut self, record: &Record<'_>) -> mcap::McapResult<()> {
        match record {
            Record::Schema { header, data } => {
                self.writer.add_schema_with_id(header.id, &header.name, &header.encoding, data)?;
            }
            Record::Channel(channel) => {
                let (topic, encoding) = (&channel.topic, &channel.message_encoding);
                self.writer.add_channel_with_id(
                    channel.id,
                    channel.schema_id,
                    topic,
                    encoding,
                    &channel.metadata,
                )?;
            }
            Record::Message { header, data } => {
                self.writer.write_to_known_channel(header, data)?;
                self.counts.messages += 1;
            }
            Record::Metadata(metadata) => {
                self.writer.write_metadata(metadata)?;
                self.counts.metadata_records += 1;
            }
            _ => {}
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::log_file::LogFile;

    #[test]
    fn a_log_of_metadata_alone_is_refused_and_nothing_is_written() {
        let directory = tempfile::tempdir().expect("a directory");
        let source = directory.path().join("torn.mcap.part");
        let mut log = LogFile::create(&directory.path().join("torn.mcap")).expect("creates");
        log.write_metadata("kind", [("a".to_owned(), "b".to_owned())].into()).expect("writes");
        log.flush().expect("writes");
        let destination = directory.path().join("recovered.mcap");
        for _ in 0..2 {
            let refusal = recover(&source, &destination).expect_err("no message");
            assert_eq!(refusal.to_string(), format!("{source:?} has no message to recover"));
            let left = std::fs::read_dir(directory.path()).expect("readable").flatten();
            let left: Vec<PathBuf> = left.map(|entry| entry.path()).collect();
            assert_eq!(left, std::slice::from_ref(&source));
            std::fs::write(&source, mcap::MAGIC).expect("writes");
        }
    }
}
