//! A checksum over everything that an account consists of.

use std::iter::Sum;
use std::ops::{Add, Sub};

use xxhash_rust::xxh3::xxh3_64;

use super::super::verdicts::{Word, WordIndex};
use super::{LeaseRecord, Terms};

/// The sum of the hashes of an account's records, modulo 2^64.
///
/// A sum does not depend on the order of the records, and a change costs as much as the records that it touches. It
/// differs when a record is changed, missing or surplus, and when records of two accounts are exchanged.
///
/// Files contain these numbers: the encodings below must not change.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Checksum(u64);

/// The first number of an encoded record, so that records of different kinds differ.
const KIND_TERMS: u64 = 0;
const KIND_LEASE: u64 = 1;
const KIND_WORD: u64 = 2;

impl Checksum {
    /// The checksum of account `name` before anything is leased or charged.
    pub(crate) fn of_terms(name: &str, terms: Terms) -> Self {
        let head = [KIND_TERMS, terms.budget].map(u64::to_le_bytes);
        let mut record = head.as_flattened().to_vec();
        // No strategy contains a zero byte, so the name begins after the first one.
        record.extend(terms.strategy.to_string().bytes().chain([0]).chain(name.bytes()));
        Self(xxh3_64(&record))
    }

    /// The part of one lease.
    pub(crate) fn of_lease(lease: &LeaseRecord) -> Self {
        let LeaseRecord { episode, units, early_units, charged_before, settled } = *lease;
        let (units, early_units) = (u64::from(units), u64::from(early_units));
        let settled = u64::from(settled);
        Self::of_numbers([KIND_LEASE, episode, units, early_units, charged_before, settled])
    }

    /// The part of one word of verdicts.
    pub(crate) fn of_word((episode, word_idx): WordIndex, word: Word) -> Self {
        let Word { asked, charged, first_half } = word;
        let word_idx = u64::from(word_idx);
        Self::of_numbers([KIND_WORD, episode, word_idx, asked, charged, first_half])
    }

    fn of_numbers(numbers: [u64; 6]) -> Self {
        Self(xxh3_64(numbers.map(u64::to_le_bytes).as_flattened()))
    }

    /// The checksum that [`Self::to_bits`] gave.
    pub(crate) const fn from_bits(bits: i64) -> Self {
        Self(bits.cast_unsigned())
    }

    /// The checksum as an SQLite integer.
    pub(crate) const fn to_bits(self) -> i64 {
        self.0.cast_signed()
    }
}

impl Add for Checksum {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self(self.0.wrapping_add(other.0))
    }
}

impl Sub for Checksum {
    type Output = Self;

    fn sub(self, other: Self) -> Self {
        Self(self.0.wrapping_sub(other.0))
    }
}

impl Sum for Checksum {
    fn sum<I: Iterator<Item = Self>>(parts: I) -> Self {
        parts.fold(Self::default(), Add::add)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::strategy::Strategy;

    const LEASE: LeaseRecord =
        LeaseRecord { episode: 7, units: 50, early_units: 20, charged_before: 3, settled: true };
    const WORD: Word = Word { asked: 0b111, charged: 0b011, first_half: 0b001 };

    #[test]
    fn the_numbers_in_files_do_not_change() {
        let terms = Terms { budget: 100, strategy: Strategy::MistakeQ { threshold: 0.05 } };
        assert_eq!(Checksum::of_terms("run", terms), Checksum(0xCB7107CD35B588B7));
        assert_eq!(Checksum::of_lease(&LEASE), Checksum(0x827388E34CDD0534));
        assert_eq!(Checksum::of_word((7, 1), WORD), Checksum(0x991E109C4DF90316));
        for (checksum, bits) in [(0, 0), (1, 1), (1 << 63, i64::MIN), (u64::MAX - 1, -2)] {
            assert_eq!(Checksum(checksum).to_bits(), bits);
            assert_eq!(Checksum::from_bits(bits), Checksum(checksum));
        }
    }

    #[test]
    fn a_part_is_added_and_taken_away_modulo_two_to_the_64() {
        let (sum, part) = (Checksum(1), Checksum(3));
        assert_eq!(Checksum(u64::MAX - 1) + part, sum);
        assert_eq!(sum - part, Checksum(u64::MAX - 1));
        assert_eq!([part, sum, part].into_iter().sum::<Checksum>(), Checksum(7));
    }

    #[test]
    fn every_field_of_a_record_counts() {
        let terms =
            |budget, threshold| Terms { budget, strategy: Strategy::MistakeQ { threshold } };
        let word = |asked, charged, first_half| Word { asked, charged, first_half };
        let all = [
            Checksum::of_terms("run", terms(100, 0.5)),
            Checksum::of_terms("ruo", terms(100, 0.5)),
            Checksum::of_terms("run", terms(101, 0.5)),
            Checksum::of_terms("run", terms(100, 0.25)),
            Checksum::of_lease(&LEASE),
            Checksum::of_lease(&LeaseRecord { episode: 8, ..LEASE }),
            Checksum::of_lease(&LeaseRecord { units: 51, ..LEASE }),
            Checksum::of_lease(&LeaseRecord { early_units: 21, ..LEASE }),
            Checksum::of_lease(&LeaseRecord { charged_before: 4, ..LEASE }),
            Checksum::of_lease(&LeaseRecord { settled: false, ..LEASE }),
            Checksum::of_word((7, 1), WORD),
            Checksum::of_word((8, 1), WORD),
            Checksum::of_word((7, 2), WORD),
            Checksum::of_word((7, 1), word(0b1111, 0b011, 0b001)),
            Checksum::of_word((7, 1), word(0b111, 0b111, 0b001)),
            Checksum::of_word((7, 1), word(0b111, 0b011, 0b011)),
        ];
        for (idx, checksum) in all.iter().enumerate() {
            assert!(!all[..idx].contains(checksum), "record {idx}");
        }
    }
}
