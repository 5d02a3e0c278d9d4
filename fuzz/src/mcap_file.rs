//! MCAP files: an eight-byte magic, records (opcode, length, body), the magic again.
//!
//! A chunk is a record whose body holds further records. Checksums of zero mean "not checked".

use std::ops::Range;

use crate::{Mutate, mutate_part};

const MAGIC_BYTES: usize = 8;
/// Opcode and length.
const HEAD_BYTES: usize = 9;
const FOOTER: u8 = 0x02;
const CHUNK: u8 = 0x06;
const DATA_END: u8 = 0x0f;
/// Of a chunk: start and end time, uncompressed size; the checksum follows.
const BEFORE_CHUNK_CRC: usize = 24;
const CRC_BYTES: usize = 4;

/// Mutates the body of one record, inside an uncompressed chunk too, and updates the enclosing lengths. `seed`
/// chooses the record.
pub fn mutate_file(file: &[u8], max_size: usize, seed: u32, mutate: Mutate) -> Vec<u8> {
    let seed = seed as usize;
    let records = records(file, MAGIC_BYTES);
    if seed.is_multiple_of(8) || records.is_empty() {
        return mutate_part(file, 0..file.len(), max_size, mutate);
    }
    let record = &records[seed / 8 % records.len()];
    let body = record.start + HEAD_BYTES..record.end;
    let inner = inner_records(file, record);
    let mut mutated = match inner.as_slice() {
        [] => mutate_part(file, body, max_size, mutate),
        inner => {
            let inner = &inner[seed / 64 % inner.len()];
            let inner_body = inner.start + HEAD_BYTES..inner.end;
            let mut mutated = mutate_part(file, inner_body, max_size, mutate);
            let grown = mutated.len().wrapping_sub(file.len());
            set_length(&mut mutated, inner.start + 1, inner.len() - HEAD_BYTES, grown);
            let (size, records_size) = chunk_size_fields(record);
            for field in [size, records_size] {
                let was = read_u64(file, field).and_then(|n| usize::try_from(n).ok());
                set_length(&mut mutated, field, was.unwrap_or_default(), grown);
            }
            mutated
        }
    };
    let grown = mutated.len().wrapping_sub(file.len());
    set_length(&mut mutated, record.start + 1, record.len() - HEAD_BYTES, grown);
    mutated
}

/// Returns the file with every checksum of a chunk, the data and the summary set to zero.
pub fn without_checksums(file: &[u8]) -> Vec<u8> {
    let mut cleared = file.to_vec();
    for record in records(file, MAGIC_BYTES) {
        let body = record.start + HEAD_BYTES..record.end;
        let crc = match file[record.start] {
            CHUNK => body.start + BEFORE_CHUNK_CRC,
            DATA_END => body.start,
            FOOTER => body.start + 2 * size_of::<u64>(),
            _ => continue,
        };
        if let Some(crc) = cleared[..body.end].get_mut(crc..crc + CRC_BYTES) {
            crc.fill(0);
        }
    }
    cleared
}

/// Returns the ranges of the complete records of `file` from `start` on.
fn records(file: &[u8], mut start: usize) -> Vec<Range<usize>> {
    let mut records = Vec::new();
    while let Some(length) = read_u64(file, start + 1) {
        let end = usize::try_from(length).ok().and_then(|n| (start + HEAD_BYTES).checked_add(n));
        match end {
            Some(end) if end <= file.len() => records.push(start..end),
            _ => break,
        }
        start = records.last().map_or(start, |record| record.end);
    }
    records
}

/// Returns the records inside an uncompressed chunk.
fn inner_records(file: &[u8], record: &Range<usize>) -> Vec<Range<usize>> {
    let (_, records_size) = chunk_size_fields(record);
    let compression = record.start + HEAD_BYTES + BEFORE_CHUNK_CRC + CRC_BYTES;
    let uncompressed = file.get(compression..compression + 4) == Some(&[0; 4]);
    if file[record.start] != CHUNK || !uncompressed || records_size + 8 > record.end {
        return Vec::new();
    }
    records(&file[..record.end], records_size + 8)
}

/// Positions of a chunk's two size fields: uncompressed and stored. Both are equal without compression.
fn chunk_size_fields(record: &Range<usize>) -> (usize, usize) {
    let body = record.start + HEAD_BYTES;
    (body + 16, body + BEFORE_CHUNK_CRC + CRC_BYTES + size_of::<u32>())
}

fn read_u64(file: &[u8], at: usize) -> Option<u64> {
    file.get(at..)?.first_chunk().map(|bytes| u64::from_le_bytes(*bytes))
}

fn set_length(file: &mut [u8], at: usize, was: usize, grown: usize) {
    if let Some(field) = file.get_mut(at..at + size_of::<u64>()) {
        field.copy_from_slice(&(was.wrapping_add(grown) as u64).to_le_bytes());
    }
}
