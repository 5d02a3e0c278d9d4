//! The fields of an MCAP record: little-endian numbers, and texts after their lengths.

use std::collections::BTreeMap;

/// The fields that are not read yet. Every method returns `None` if the record is too short or a text is not UTF-8.
pub(crate) struct Fields<'a>(pub(crate) &'a [u8]);

impl<'a> Fields<'a> {
    pub(crate) fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    pub(crate) fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    pub(crate) fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }

    pub(crate) fn text(&mut self) -> Option<&'a str> {
        let length = usize::try_from(self.u32()?).ok()?;
        let (text, rest) = self.0.split_at_checked(length)?;
        self.0 = rest;
        std::str::from_utf8(text).ok()
    }

    /// Reads pairs of texts, after the number of their bytes.
    pub(crate) fn map(&mut self) -> Option<BTreeMap<String, String>> {
        let length = usize::try_from(self.u32()?).ok()?;
        let (pairs, rest) = self.0.split_at_checked(length)?;
        self.0 = rest;
        let (mut pairs, mut map) = (Fields(pairs), BTreeMap::new());
        while !pairs.0.is_empty() {
            let (key, value) = (pairs.text()?, pairs.text()?);
            map.insert(key.to_owned(), value.to_owned());
        }
        Some(map)
    }

    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (bytes, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*bytes)
    }
}
