//! Reading of the records of an MCAP file that may be damaged.

use std::path::Path;

use mcap::McapError;
use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use tandem_system::regular_file;

use crate::error::Error;

/// Maximum size of a record or an uncompressed chunk. The reader allocates as much as a length field declares. Chunks
/// of Tandem's logs have less than 1 MiB.
const MAX_RECORD_BYTES: usize = 16 << 20;

/// Reads the MCAP file `path`, which may end anywhere.
///
/// # Errors
/// If the file cannot be read, or does not start like an MCAP file.
pub(crate) fn read_mcap(path: &Path) -> Result<Vec<u8>, Error> {
    let bytes = regular_file::read(path).map_err(Error::io("read", path))?;
    if !bytes.starts_with(mcap::MAGIC) && !mcap::MAGIC.starts_with(&bytes) {
        return Err(Error::NotMcap { path: path.to_owned() });
    }
    Ok(bytes)
}

/// An iterator over the schemas, channels, messages, metadata and the end of the data of a file, in order and including
/// those within chunks.
///
/// The checksum of a chunk is verified before its records are returned. The iterator ends after an error. Other records
/// are skipped without parsing, because the parser panics on an attachment that is too short.
pub(crate) struct Records<'a> {
    unread: &'a [u8],
    reader: LinearReader,
    failed: bool,
    /// The record that ends the data is still to come, and must.
    needs_data_end: bool,
}

impl<'a> Records<'a> {
    /// Reads a file that must be complete: everything is verified up to the last byte.
    pub(crate) fn of_complete(bytes: &'a [u8]) -> Self {
        let options = LinearReaderOptions::default().with_check_finishes_after_end_magic(true);
        Self { needs_data_end: true, ..Self::new(bytes, options) }
    }

    /// Reads a file that may end anywhere.
    pub(crate) fn of_partial(bytes: &'a [u8]) -> Self {
        Self::new(bytes, LinearReaderOptions::default().with_skip_end_magic(true))
    }

    fn new(bytes: &'a [u8], options: LinearReaderOptions) -> Self {
        let options = options
            .with_validate_chunk_crcs(true)
            .with_prevalidate_chunk_crcs(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            .with_record_length_limit(MAX_RECORD_BYTES);
        let reader = LinearReader::new_with_options(options);
        Self { unread: bytes, reader, failed: false, needs_data_end: false }
    }

    fn read(&mut self) -> Option<mcap::McapResult<Record<'static>>> {
        loop {
            match self.reader.next_event()? {
                Ok(LinearReadEvent::ReadRequest(n_wanted)) => {
                    let (next, rest) = self.unread.split_at(n_wanted.min(self.unread.len()));
                    self.reader.insert(next.len()).copy_from_slice(next);
                    self.reader.notify_read(next.len());
                    self.unread = rest;
                }
                Ok(LinearReadEvent::Record { data, opcode }) => match opcode {
                    op::SCHEMA | op::CHANNEL | op::MESSAGE | op::METADATA | op::DATA_END => {
                        return Some(parse(opcode, data).map(Record::into_owned));
                    }
                    _ => {}
                },
                Err(error) => return Some(Err(error)),
            }
        }
    }
}

impl Iterator for Records<'_> {
    type Item = mcap::McapResult<Record<'static>>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.failed {
            return None;
        }
        let record = match self.read() {
            // The reader accepts a file without this record.
            None if self.needs_data_end => Some(Err(McapError::UnexpectedEof)),
            record => record,
        };
        match &record {
            Some(Ok(Record::DataEnd(_))) => self.needs_data_end = false,
            Some(Err(_)) => self.failed = true,
            _ => {}
        }
        record
    }
}

/// Parses a record, after checking that its length fields fit its body. The parser allocates as much as they declare.
fn parse(opcode: u8, body: &[u8]) -> mcap::McapResult<Record<'_>> {
    match lengths_fit(opcode, body) {
        Some(()) => mcap::parse_record(opcode, body),
        None => Err(McapError::UnexpectedEof),
    }
}

fn lengths_fit(opcode: u8, body: &[u8]) -> Option<()> {
    // A body has numbers, then strings, then the data of a schema or a map of strings.
    let (n_number_bytes, n_strings, has_map) = match opcode {
        op::SCHEMA => (2, 2, false),
        op::CHANNEL => (4, 2, true),
        op::METADATA => (0, 1, true),
        _ => return Some(()),
    };
    let mut rest = body.get(n_number_bytes..)?;
    for _ in 0..n_strings {
        (_, rest) = split_string(rest)?;
    }
    let (mut last, _) = split_string(rest)?;
    while has_map && !last.is_empty() {
        let (_key, value) = split_string(last)?;
        (_, last) = split_string(value)?;
    }
    Some(())
}

/// Splits off a string with its length prefix.
fn split_string(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = bytes.split_first_chunk()?;
    rest.split_at_checked(usize::try_from(u32::from_le_bytes(*length)).ok()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a file with one record.
    fn file(opcode: u8, body: &[u8]) -> Vec<u8> {
        [mcap::MAGIC, &record(opcode, body)].concat()
    }

    fn record(opcode: u8, body: &[u8]) -> Vec<u8> {
        let length = (body.len() as u64).to_le_bytes();
        [&[opcode], length.as_slice(), body].concat()
    }

    fn read(opcode: u8, body: &[u8]) -> Vec<mcap::McapResult<Record<'static>>> {
        Records::of_partial(&file(opcode, body)).collect()
    }

    #[test]
    fn a_complete_file_says_where_its_data_end() {
        let records = |data_end: &[u8]| {
            let (header, footer) = (file(op::HEADER, &[0; 8]), record(op::FOOTER, &[0; 20]));
            let file = [&header, data_end, &footer, mcap::MAGIC].concat();
            Records::of_complete(&file).collect::<Vec<_>>()
        };
        let complete = records(&record(op::DATA_END, &[0; 4]));
        assert!(matches!(complete.as_slice(), [Ok(Record::DataEnd(_))]), "{complete:?}");
        let without = records(&[]);
        assert!(matches!(without.as_slice(), [Err(McapError::UnexpectedEof)]), "{without:?}");
    }

    #[test]
    fn an_attachment_that_is_too_short_is_skipped() {
        // Two times, two empty strings and a length of 0, without the checksum.
        assert!(read(op::ATTACHMENT, &[0; 32]).iter().all(Result::is_ok));
    }

    #[test]
    fn a_chunk_with_a_too_large_size_is_refused_before_allocation() {
        let chunk = |uncompressed_size: u64| {
            let (times, checksum) = ([0; 16], [1; 4]);
            let (compression, n_compressed) = (b"\x04\0\0\0zstd", [0; 8]);
            [&times[..], &uncompressed_size.to_le_bytes(), &checksum, compression, &n_compressed]
                .concat()
        };
        let records = read(op::CHUNK, &chunk(MAX_RECORD_BYTES as u64 + 1));
        assert!(matches!(records.as_slice(), [Err(McapError::ChunkTooLarge(_))]), "{records:?}");
        let records = read(op::CHUNK, &chunk(MAX_RECORD_BYTES as u64));
        assert!(!matches!(records.as_slice(), [Err(McapError::ChunkTooLarge(_))]), "{records:?}");
    }

    #[test]
    fn a_length_beyond_the_record_is_refused_before_allocation() {
        let huge = u32::MAX.to_le_bytes();
        let check = |opcode, before: &[u8]| {
            let records = read(opcode, &[before, &huge, b"text"].concat());
            let [Err(McapError::UnexpectedEof)] = records.as_slice() else {
                panic!("opcode {opcode}, {} bytes before the length: {records:?}", before.len());
            };
        };
        check(op::METADATA, &[]);
        check(op::METADATA, &[0; 4]);
        check(op::METADATA, &[0, 0, 0, 0, 8, 0, 0, 0]);
        check(op::METADATA, &[0, 0, 0, 0, 12, 0, 0, 0, 0, 0, 0, 0]);
        // A map of one empty key: the length of its value lies behind the map.
        check(op::METADATA, &[0, 0, 0, 0, 4, 0, 0, 0, 0, 0, 0, 0]);
        check(op::SCHEMA, &[0; 2]);
        check(op::SCHEMA, &[0; 6]);
        check(op::SCHEMA, &[0; 10]);
        check(op::CHANNEL, &[0; 4]);
        check(op::CHANNEL, &[0; 12]);
        assert!(read(op::HEADER, &huge).is_empty(), "a header is not parsed");
    }
}
