//! Reads the records of an MCAP file that may be damaged.

use mcap::McapError;
use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

/// The largest record or chunk, also uncompressed: the reader allocates what a length declares. Our logs have chunks of
/// less than 1 MiB.
const MAX_RECORD_BYTES: usize = 16 << 20;

/// The schemas, channels, messages, metadata and the end of the data of a file, in order, those inside chunks too. A
/// chunk's records come only after its checksum was found right. After an error there is nothing more.
///
/// Other records are skipped unparsed: nothing here needs them, and the parser panics on an attachment that is too short.
pub(crate) struct Records<'a> {
    unread: &'a [u8],
    reader: LinearReader,
    failed: bool,
}

impl<'a> Records<'a> {
    /// Of a file that must be whole: everything is checked, to the last byte.
    pub(crate) fn of_whole(bytes: &'a [u8]) -> Self {
        Self::new(bytes, LinearReaderOptions::default().with_check_finishes_after_end_magic(true))
    }

    /// Of a file that may stop anywhere.
    pub(crate) fn of_rest(bytes: &'a [u8]) -> Self {
        Self::new(bytes, LinearReaderOptions::default().with_skip_end_magic(true))
    }

    fn new(bytes: &'a [u8], options: LinearReaderOptions) -> Self {
        let options = options
            .with_validate_chunk_crcs(true)
            .with_prevalidate_chunk_crcs(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            .with_record_length_limit(MAX_RECORD_BYTES);
        Self { unread: bytes, reader: LinearReader::new_with_options(options), failed: false }
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
        let record = self.read();
        self.failed = matches!(record, Some(Err(_)));
        record
    }
}

/// Parses a record whose declared lengths fit into its body: the parser reserves as much memory as a length declares.
fn parse(opcode: u8, body: &[u8]) -> mcap::McapResult<Record<'_>> {
    match lengths_fit(opcode, body) {
        Some(()) => mcap::parse_record(opcode, body),
        None => Err(McapError::UnexpectedEof),
    }
}

fn lengths_fit(opcode: u8, body: &[u8]) -> Option<()> {
    // Numbers come first, then texts, then the data of a schema or a map of texts.
    let (n_number_bytes, n_texts, has_map) = match opcode {
        op::SCHEMA => (2, 2, false),
        op::CHANNEL => (4, 2, true),
        op::METADATA => (0, 1, true),
        _ => return Some(()),
    };
    let mut rest = body.get(n_number_bytes..)?;
    for _ in 0..n_texts {
        (_, rest) = split_text(rest)?;
    }
    let (mut last, _) = split_text(rest)?;
    while has_map && !last.is_empty() {
        (_, last) = split_text(last)?;
    }
    Some(())
}

/// The bytes behind a length, and what follows them.
fn split_text(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = bytes.split_first_chunk()?;
    rest.split_at_checked(usize::try_from(u32::from_le_bytes(*length)).ok()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file with one record.
    fn file(opcode: u8, body: &[u8]) -> Vec<u8> {
        let length = (body.len() as u64).to_le_bytes();
        [mcap::MAGIC, &[opcode], length.as_slice(), body].concat()
    }

    fn read(opcode: u8, body: &[u8]) -> Vec<mcap::McapResult<Record<'static>>> {
        Records::of_rest(&file(opcode, body)).collect()
    }

    #[test]
    fn an_attachment_too_short_for_its_checksum_is_skipped() {
        // Two times, two empty texts and a length of 0, without the checksum.
        assert!(read(op::ATTACHMENT, &[0; 32]).iter().all(Result::is_ok));
    }

    #[test]
    fn a_chunk_that_declares_too_large_a_size_is_refused_before_memory_is_reserved() {
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
    fn a_length_beyond_the_record_is_refused_before_memory_is_reserved() {
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
        check(op::SCHEMA, &[0; 2]);
        check(op::SCHEMA, &[0; 6]);
        check(op::SCHEMA, &[0; 10]);
        check(op::CHANNEL, &[0; 4]);
        check(op::CHANNEL, &[0; 12]);
        assert!(read(op::HEADER, &huge).is_empty(), "a header is not parsed");
    }
}
