//! Bounds on a model file, checked before it is decoded.
//!
//! A decoder allocates a structure for each message and eight bytes for each packed integer, so a file of a few
//! megabytes could demand gigabytes. [`check`] walks the file without allocating and counts both.

use crate::error::ModelError;

/// Largest accepted file, 64 MiB: some 16 million parameters.
pub const MAX_FILE_BYTES: usize = 64 << 20;
/// Largest accepted number of Protobuf fields, over all nested messages.
pub const MAX_FIELDS: usize = 1 << 15;
/// Largest accepted number of bytes of a list of integers, such as the dimensions of a tensor.
const MAX_INTEGERS_BYTES: usize = 256;

/// A field that the decoder reads as a nested message or as a list of integers.
enum Part {
    Message(&'static [(u64, Self)]),
    Integers,
}

const TENSOR: &[(u64, Part)] = &[(1, Part::Integers)];
const VALUE_INFO: &[(u64, Part)] =
    &[(2, Part::Message(&[(1, Part::Message(&[(2, Part::Message(&[(1, Part::Message(&[]))]))]))]))];
const NODE: &[(u64, Part)] =
    &[(5, Part::Message(&[(5, Part::Message(TENSOR)), (8, Part::Integers)]))];
const GRAPH: &[(u64, Part)] = &[
    (1, Part::Message(NODE)),
    (5, Part::Message(TENSOR)),
    (11, Part::Message(VALUE_INFO)),
    (12, Part::Message(VALUE_INFO)),
];
const MODEL: &[(u64, Part)] =
    &[(7, Part::Message(GRAPH)), (8, Part::Message(&[])), (14, Part::Message(&[]))];

/// Checks that `file` is a Protobuf message whose decoded form is not much larger than the file.
///
/// # Errors
/// When the file is malformed, too large, or has too many fields.
pub fn check(file: &[u8]) -> Result<(), ModelError> {
    if file.len() > MAX_FILE_BYTES {
        let got = file.len();
        return Err(ModelError::TooLarge { what: "bytes", got, most: MAX_FILE_BYTES });
    }
    let n_fields = count(file, MODEL, 0)?;
    if n_fields == 0 { Err(ModelError::NotOnnx) } else { Ok(()) }
}

/// Returns `n_fields` plus the number of fields of `message` and of the messages in it.
fn count(
    mut message: &[u8],
    parts: &[(u64, Part)],
    mut n_fields: usize,
) -> Result<usize, ModelError> {
    while !message.is_empty() {
        n_fields += 1;
        if n_fields > MAX_FIELDS {
            let what = "or more fields";
            return Err(ModelError::TooLarge { what, got: n_fields, most: MAX_FIELDS });
        }
        let key = take_varint(&mut message)?;
        match key & 7 {
            0 => drop(take_varint(&mut message)?),
            1 => drop(take(&mut message, 8)?),
            2 => {
                let length = take_varint(&mut message)?;
                let content = take(&mut message, length)?;
                let part = parts.iter().find(|(number, _)| *number == key >> 3);
                match part.map(|(_, part)| part) {
                    Some(Part::Message(parts)) => n_fields = count(content, parts, n_fields)?,
                    Some(Part::Integers) if content.len() > MAX_INTEGERS_BYTES => {
                        let what = "bytes in a list of integers";
                        let most = MAX_INTEGERS_BYTES;
                        return Err(ModelError::TooLarge { what, got: content.len(), most });
                    }
                    Some(Part::Integers) | None => {}
                }
            }
            5 => drop(take(&mut message, 4)?),
            _ => return Err(ModelError::NotOnnx),
        }
    }
    Ok(n_fields)
}

fn take<'a>(message: &mut &'a [u8], length: u64) -> Result<&'a [u8], ModelError> {
    let length = usize::try_from(length).map_err(|_too_long| ModelError::NotOnnx)?;
    let (content, rest) = message.split_at_checked(length).ok_or(ModelError::NotOnnx)?;
    *message = rest;
    Ok(content)
}

fn take_varint(message: &mut &[u8]) -> Result<u64, ModelError> {
    let mut value = 0_u64;
    for shift in (0..64).step_by(7) {
        let (byte, rest) = message.split_first().ok_or(ModelError::NotOnnx)?;
        *message = rest;
        value |= u64::from(byte & 0x7f) << shift;
        if byte & 0x80 == 0 {
            return Ok(value);
        }
    }
    Err(ModelError::NotOnnx)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(file: &[u8]) -> String {
        check(file).expect_err("must be refused").to_string()
    }

    #[test]
    fn truncated_and_foreign_bytes_are_no_models() {
        for file in [
            &b""[..],
            b"\x3a",
            b"\x3a\x05\x00",
            b"\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff",
            b"PK\x03\x04",
        ] {
            assert_eq!(refusal(file), "it is not a complete ONNX file", "{file:?}");
        }
        assert!(check(b"\x08\x07").is_ok(), "a version alone is well formed");
    }

    #[test]
    fn many_empty_messages_and_packed_integers_are_refused_before_they_are_decoded() {
        let empty_nodes = b"\x0a\x00".repeat(MAX_FIELDS);
        let graph = |content: &[u8]| {
            let n = content.len();
            let [low, middle, high] = [n, n >> 7, n >> 14].map(|n| u8::try_from(n & 0x7f).unwrap());
            [&[0x3a, low | 0x80, middle | 0x80, high], content].concat()
        };
        assert_eq!(
            refusal(&graph(&empty_nodes)),
            "it has 32769 or more fields, expected at most 32768"
        );
        let dims = [&[0x2a, 0x83, 0x04, 0x0a, 0x80, 0x04][..], &[1; 512], &[0; 1]].concat();
        assert_eq!(
            refusal(&graph(&dims)),
            "it has 512 bytes in a list of integers, expected at most 256"
        );
    }
}
