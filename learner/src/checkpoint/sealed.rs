//! The file of a checkpoint: safetensors, with a checksum over every byte (the seal).
//!
//! The header begins with the seal, the SHA-256 of the whole file with zeros in place of the seal. Any flipped bit, in
//! the header, the metadata or a tensor, invalidates it.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read as _, Write as _};
use std::path::Path;

use safetensors::{Dtype, SafeTensors};
use serde_json::{Map, Value, json};
use sha2::{Digest as _, Sha256};
use tandem_core::text::hex;

/// Version of the file's layout.
pub(super) const FORMAT: &str = "3";
/// The beginning of a header; the seal follows.
const BEFORE_SEAL: &str = r#"{"__metadata__":{"seal":""#;
const SEAL_CHARS: usize = 64;
/// Size of the header's length, a little-endian `u64`. Headers are padded to a multiple of it.
const WORD_BYTES: usize = 8;
/// The position of the seal in a file.
const SEAL: std::ops::Range<usize> =
    WORD_BYTES + BEFORE_SEAL.len()..WORD_BYTES + BEFORE_SEAL.len() + SEAL_CHARS;

/// The metadata key of the settings that the run started with. Checkpoints of old versions lack it.
pub(super) const SETTINGS: &str = "settings";
/// Largest size of a header.
const MAX_HEADER_BYTES: u64 = 100 << 20;

/// A named vector.
pub(super) struct Tensor<'a> {
    pub(super) name: String,
    pub(super) dtype: Dtype,
    /// Little-endian numbers.
    pub(super) bytes: Cow<'a, [u8]>,
}

/// The contents of a file whose seal is valid.
pub(super) struct Contents<'a> {
    pub(super) metadata: BTreeMap<String, String>,
    pub(super) tensors: SafeTensors<'a>,
}

/// A file that cannot be read as a checkpoint.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Refused {
    /// Cut short or altered.
    Damaged(String),
    /// Of another format.
    Format(String),
}

/// Writes a checkpoint into `file` and returns its seal.
pub(super) fn write(
    mut file: &File,
    metadata: &[(&str, String)],
    tensors: &[Tensor<'_>],
) -> io::Result<String> {
    let mut start = start(metadata, tensors)?;
    let mut hash = Sha256::new_with_prefix(&start);
    tensors.iter().for_each(|tensor| hash.update(&tensor.bytes));
    let seal = hex(&hash.finalize());
    start[SEAL].copy_from_slice(seal.as_bytes());
    file.write_all(&start)?;
    for tensor in tensors {
        file.write_all(&tensor.bytes)?;
    }
    Ok(seal)
}

/// Returns the part of the file before the tensors, with zeros in place of the seal.
fn start(metadata: &[(&str, String)], tensors: &[Tensor<'_>]) -> io::Result<Vec<u8>> {
    let mut entries = Map::new();
    entries.insert("seal".to_owned(), Value::String("0".repeat(SEAL_CHARS)));
    entries.insert("format".to_owned(), Value::String(FORMAT.to_owned()));
    for (key, value) in metadata {
        entries.insert((*key).to_owned(), Value::String(value.clone()));
    }
    let mut header = Map::new();
    header.insert("__metadata__".to_owned(), Value::Object(entries));
    let mut end = 0;
    for Tensor { name, dtype, bytes } in tensors {
        let (begin, shape) = (end, bytes.len() * 8 / dtype.bitsize());
        end += bytes.len();
        let entry =
            json!({ "dtype": dtype.to_string(), "shape": [shape], "data_offsets": [begin, end] });
        header.insert(name.clone(), entry);
    }
    let mut header = serde_json::to_vec(&header)?;
    header.resize(header.len().next_multiple_of(WORD_BYTES), b' ');
    Ok([(header.len() as u64).to_le_bytes().as_slice(), &header].concat())
}

/// Parses the bytes of a file and verifies its seal.
pub(super) fn open(bytes: &[u8]) -> Result<Contents<'_>, Refused> {
    if bytes.get(WORD_BYTES..SEAL.start) == Some(BEFORE_SEAL.as_bytes()) {
        check_seal(bytes)?;
    }
    let damaged = |error: safetensors::SafeTensorError| Refused::Damaged(error.to_string());
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(damaged)?;
    let metadata: BTreeMap<String, String> =
        header.metadata().clone().unwrap_or_default().into_iter().collect();
    match metadata.get("format").map(String::as_str) {
        Some(FORMAT) if metadata.contains_key("seal") => {}
        Some(FORMAT) | None => return Err(Refused::Damaged("it has no seal".to_owned())),
        Some(format) => return Err(Refused::Format(format.to_owned())),
    }
    if bytes.get(WORD_BYTES..SEAL.start) != Some(BEFORE_SEAL.as_bytes()) {
        return Err(Refused::Damaged("its seal is misplaced".to_owned()));
    }
    Ok(Contents { metadata, tensors: SafeTensors::deserialize(bytes).map_err(damaged)? })
}

/// Reads the settings from a file's header, without verifying the file.
pub(super) fn settings_of(path: &Path) -> Option<String> {
    let mut file = File::open(path).ok()?;
    let mut n_bytes = [0; WORD_BYTES];
    file.read_exact(&mut n_bytes).ok()?;
    let n_bytes = Some(u64::from_le_bytes(n_bytes)).filter(|n| *n <= MAX_HEADER_BYTES)?;
    let mut header = Vec::new();
    file.take(n_bytes).read_to_end(&mut header).ok()?;
    let header: Value = serde_json::from_slice(&header).ok()?;
    Some(header.pointer("/__metadata__")?.get(SETTINGS)?.as_str()?.to_owned())
}

fn check_seal(bytes: &[u8]) -> Result<(), Refused> {
    let (Some(seal), Some(after)) = (bytes.get(SEAL), bytes.get(SEAL.end..)) else {
        return Err(Refused::Damaged("it is cut short".to_owned()));
    };
    let mut hash = Sha256::new_with_prefix(&bytes[..SEAL.start]);
    hash.update([b'0'; SEAL_CHARS]);
    hash.update(after);
    if hex(&hash.finalize()).as_bytes() == seal {
        return Ok(());
    }
    Err(Refused::Damaged("its contents do not match its seal".to_owned()))
}

/// Replaces the seal of altered bytes by the valid one.
#[cfg(test)]
pub(super) fn reseal(mut bytes: Vec<u8>) -> Vec<u8> {
    if bytes.len() >= SEAL.end {
        bytes[SEAL].fill(b'0');
        let seal = hex(&Sha256::digest(&bytes));
        bytes[SEAL].copy_from_slice(seal.as_bytes());
    }
    bytes
}
