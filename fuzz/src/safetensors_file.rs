//! Safetensors files: an eight-byte header length, a JSON header, the tensors' bytes.

use sha2::{Digest as _, Sha256};

use crate::{Mutate, mutate_part};

const WORD_BYTES: usize = 8;
/// The start of a checkpoint's header, before the seal.
const BEFORE_SEAL: &[u8] = br#"{"__metadata__":{"seal":""#;
const SEAL_CHARS: usize = 64;

/// Mutates the header or the tensors and updates the header's length. `seed` chooses the part.
pub fn mutate_file(file: &[u8], max_size: usize, seed: u32, mutate: Mutate) -> Vec<u8> {
    let Some(header_end) = header_end(file) else {
        return mutate_part(file, 0..file.len(), max_size, mutate);
    };
    let (part, n_tensor_bytes) = match seed % 8 {
        0 => return mutate_part(file, 0..file.len(), max_size, mutate),
        1 => (header_end..file.len(), None),
        _ => (WORD_BYTES..header_end, Some(file.len() - header_end)),
    };
    let mut mutated = mutate_part(file, part, max_size, mutate);
    let end = n_tensor_bytes.map_or(header_end, |n| mutated.len() - n);
    mutated[..WORD_BYTES].copy_from_slice(&((end - WORD_BYTES) as u64).to_le_bytes());
    mutated
}

/// Returns the end of the header, or `None` if the file is too short.
fn header_end(file: &[u8]) -> Option<usize> {
    let length = u64::from_le_bytes(*file.first_chunk::<WORD_BYTES>()?);
    let end = WORD_BYTES.checked_add(usize::try_from(length).ok()?)?;
    (end <= file.len()).then_some(end)
}

/// Returns the checkpoint `file` with a valid SHA-256 seal, if it has room for one.
pub fn seal_anew(file: &[u8]) -> Vec<u8> {
    let mut sealed = file.to_vec();
    let start = WORD_BYTES + BEFORE_SEAL.len();
    if file.get(WORD_BYTES..start) == Some(BEFORE_SEAL) && file.len() >= start + SEAL_CHARS {
        let seal = start..start + SEAL_CHARS;
        sealed[seal.clone()].fill(b'0');
        let digest = Sha256::digest(&sealed);
        let hex: String = digest.iter().map(|byte| format!("{byte:02x}")).collect();
        sealed[seal].copy_from_slice(hex.as_bytes());
    }
    sealed
}
