//! Reads the records of an MCAP file that may be damaged.

use mcap::records::Record;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

/// No record or chunk may claim to be larger: a damaged length must not fill the memory.
const MAX_RECORD_BYTES: usize = 256 << 20;

/// The records of a file in order, those inside chunks too. A chunk's records come only after its checksum was found
/// right. After an error there is nothing more.
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
                Ok(LinearReadEvent::Record { data, opcode }) => {
                    return Some(mcap::parse_record(opcode, data).map(Record::into_owned));
                }
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
