//! A checksum over all records of an account.

use std::iter::Sum;
use std::ops::{Add, Sub};

use xxhash_rust::xxh3::xxh3_64;

use crate::budget::{Account, AccountTerms, Changes, LeaseRecord, VerdictBits, VerdictIndex};

/// The sum of the hashes of an account's records, modulo 2^64.
///
/// A sum does not depend on the order of the records, and an update costs as much as the records that it changes. The
/// checksum differs if a record is changed, missing or surplus, or if records of two accounts are exchanged.
///
/// Ledger files contain checksums: the encodings below must not change.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Checksum(u64);

/// The kind of a record is the first number of its encoding.
const KIND_TERMS: u64 = 0;
const KIND_LEASE: u64 = 1;
const KIND_VERDICTS: u64 = 2;

impl Checksum {
    /// Returns the checksum of account `name` without leases and verdicts.
    pub(super) fn of_terms(name: &str, terms: AccountTerms) -> Self {
        let head = [KIND_TERMS, terms.budget].map(u64::to_le_bytes);
        let mut record = head.as_flattened().to_vec();
        // No strategy contains a zero byte, so the name begins after the first one.
        record.extend(terms.strategy.to_string().bytes().chain([0]).chain(name.bytes()));
        Self(xxh3_64(&record))
    }

    /// Returns the term of the sum for one lease.
    pub(super) fn of_lease(episode: u64, lease: &LeaseRecord) -> Self {
        let LeaseRecord { units, early_units, charged_before, settled } = *lease;
        let (units, early_units) = (u64::from(units), u64::from(early_units));
        let settled = u64::from(settled);
        Self::of_numbers([KIND_LEASE, episode, units, early_units, charged_before, settled])
    }

    /// Returns the term of the sum for the verdicts at one index.
    pub(super) fn of_verdicts((episode, word_idx): VerdictIndex, bits: &VerdictBits) -> Self {
        let VerdictBits { asked, charged, first_half } = *bits;
        let word_idx = u64::from(word_idx);
        Self::of_numbers([KIND_VERDICTS, episode, word_idx, asked, charged, first_half])
    }

    /// Returns the checksum after `changes` to `account`, whose checksum is `self`.
    pub(super) fn after(self, account: &Account, changes: &Changes) -> Self {
        let leases = changes.leases.iter().map(|(episode, lease)| {
            let of = |lease| Self::of_lease(*episode, lease);
            of(lease) - account.lease(*episode).map(of).unwrap_or_default()
        });
        let verdicts = changes.verdicts.iter().map(|(index, bits)| {
            let of = |bits| Self::of_verdicts(*index, bits);
            of(bits) - account.verdicts_at(*index).map(of).unwrap_or_default()
        });
        self + leases.chain(verdicts).sum()
    }

    fn of_numbers(numbers: [u64; 6]) -> Self {
        Self(xxh3_64(numbers.map(u64::to_le_bytes).as_flattened()))
    }

    /// Converts an SQLite integer to a checksum; the inverse of [`Self::to_bits`].
    pub(super) const fn from_bits(bits: i64) -> Self {
        Self(bits.cast_unsigned())
    }

    /// Converts the checksum to an SQLite integer.
    pub(super) const fn to_bits(self) -> i64 {
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
        LeaseRecord { units: 50, early_units: 20, charged_before: 3, settled: true };
    const BITS: VerdictBits = VerdictBits { asked: 0b111, charged: 0b011, first_half: 0b001 };

    #[test]
    fn the_numbers_in_files_do_not_change() {
        let terms = AccountTerms { budget: 100, strategy: Strategy::MistakeQ { threshold: 0.05 } };
        assert_eq!(Checksum::of_terms("run", terms), Checksum(0xCB7107CD35B588B7));
        assert_eq!(Checksum::of_lease(7, &LEASE), Checksum(0x827388E34CDD0534));
        assert_eq!(Checksum::of_verdicts((7, 1), &BITS), Checksum(0x991E109C4DF90316));
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
            |budget, threshold| AccountTerms { budget, strategy: Strategy::MistakeQ { threshold } };
        let bits = |asked, charged, first_half| VerdictBits { asked, charged, first_half };
        let all = [
            Checksum::of_terms("run", terms(100, 0.5)),
            Checksum::of_terms("ruo", terms(100, 0.5)),
            Checksum::of_terms("run", terms(101, 0.5)),
            Checksum::of_terms("run", terms(100, 0.25)),
            Checksum::of_lease(7, &LEASE),
            Checksum::of_lease(8, &LEASE),
            Checksum::of_lease(7, &LeaseRecord { units: 51, ..LEASE }),
            Checksum::of_lease(7, &LeaseRecord { early_units: 21, ..LEASE }),
            Checksum::of_lease(7, &LeaseRecord { charged_before: 4, ..LEASE }),
            Checksum::of_lease(7, &LeaseRecord { settled: false, ..LEASE }),
            Checksum::of_verdicts((7, 1), &BITS),
            Checksum::of_verdicts((8, 1), &BITS),
            Checksum::of_verdicts((7, 2), &BITS),
            Checksum::of_verdicts((7, 1), &bits(0b1111, 0b011, 0b001)),
            Checksum::of_verdicts((7, 1), &bits(0b111, 0b111, 0b001)),
            Checksum::of_verdicts((7, 1), &bits(0b111, 0b011, 0b011)),
        ];
        for (idx, checksum) in all.iter().enumerate() {
            assert!(!all[..idx].contains(checksum), "record {idx}");
        }
    }
}
