//! What an account needs so that somebody can keep it elsewhere: a record of what changed, a way back, and a way to
//! build it again.

use std::collections::BTreeMap;

use super::super::verdicts::{Verdicts, Word, WordIndex};
use super::checksum::Checksum;
use super::{Account, LeaseState, Terms};

/// How an account was before the first change: only what has been touched.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Journal {
    spent: u64,
    leased: u64,
    leases: BTreeMap<u64, Option<LeaseState>>,
    words: BTreeMap<WordIndex, Option<Word>>,
}

/// What is to be written down of an account that has changed.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Changes {
    /// Units charged, all in all.
    pub(crate) spent: u64,
    /// Leases opened or settled.
    pub(crate) leases: Vec<LeaseRecord>,
    /// Words of verdicts that are new or have more bits.
    pub(crate) words: Vec<(WordIndex, Word)>,
    /// The difference that they make to the account's checksum.
    pub(crate) checksum: Checksum,
}

/// A lease as it is written down. What is spent of it follows from the verdicts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct LeaseRecord {
    /// The episode's number.
    pub(crate) episode: u64,
    /// Units set aside.
    pub(crate) units: u32,
    /// How many of them lie in the first half of the budget.
    pub(crate) early_units: u32,
    /// Units that the episode was charged before it had the lease.
    pub(crate) charged_before: u64,
    /// Whether its rest went back to the budget.
    pub(crate) settled: bool,
}

/// Why records make no account.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Unsound {
    /// A lease is larger than it can be.
    #[error("the lease of episode {0} does not fit its verdicts")]
    Lease(u64),
    /// A step is charged that was not asked about.
    #[error("the verdicts on episode {0} contradict one another")]
    Verdicts(u64),
    /// More is handed out than there is.
    #[error("more than the budget is handed out")]
    Overspent,
}

impl Changes {
    /// Whether there is nothing to write.
    pub(crate) const fn is_empty(&self) -> bool {
        self.leases.is_empty() && self.words.is_empty()
    }
}

impl Account {
    /// Builds the account of which `leases` and `words` were written down.
    pub(crate) fn restore(
        terms: Terms,
        leases: &[LeaseRecord],
        words: impl IntoIterator<Item = (WordIndex, Word)>,
    ) -> Result<Self, Unsound> {
        let mut account = Self::new(terms);
        for (index, word) in words {
            if !word.is_sound() {
                return Err(Unsound::Verdicts(index.0));
            }
            account.spent += u64::from(word.charged.count_ones());
            account.verdicts.set_word(index, Some(word));
        }
        for record in leases {
            let lease = LeaseState::restore(record, &account.verdicts)
                .ok_or(Unsound::Lease(record.episode))?;
            if !lease.settled {
                account.leased += u64::from(lease.units - lease.spent);
            }
            account.leases.insert(record.episode, lease);
        }
        if account.handed_out() > terms.budget {
            return Err(Unsound::Overspent);
        }
        Ok(account)
    }

    /// Units charged.
    pub(crate) const fn spent(&self) -> u64 {
        self.spent
    }

    /// Begins to record changes, unless that has begun.
    pub(crate) fn record(&mut self) {
        if self.journal.is_none() {
            let (spent, leased) = (self.spent, self.leased);
            let journal =
                Journal { spent, leased, leases: BTreeMap::new(), words: BTreeMap::new() };
            self.journal = Some(Box::new(journal));
        }
    }

    /// What has changed since [`Self::record`].
    pub(crate) fn recorded(&self) -> Changes {
        let Some(journal) = &self.journal else { return Changes::default() };
        let mut changes = Changes { spent: self.spent, ..Changes::default() };
        for (episode, before) in &journal.leases {
            let Some(lease) = self.leases.get(episode) else { continue };
            let lease = lease.record(*episode, &self.verdicts);
            match before {
                Some(before) if before.settled == lease.settled => continue,
                Some(before) => {
                    let before = LeaseRecord { settled: before.settled, ..lease };
                    changes.checksum = changes.checksum - Checksum::of_lease(&before);
                }
                None => {}
            }
            changes.checksum = changes.checksum + Checksum::of_lease(&lease);
            changes.leases.push(lease);
        }
        for (index, before) in &journal.words {
            let Some(word) = self.verdicts.word(*index) else { continue };
            let before = before.map(|before| Checksum::of_word(*index, before));
            changes.checksum =
                changes.checksum - before.unwrap_or_default() + Checksum::of_word(*index, word);
            changes.words.push((*index, word));
        }
        changes
    }

    /// Ends the record: the changes stand.
    pub(crate) fn keep(&mut self) {
        self.journal = None;
    }

    /// Ends the record and makes the account what it was before it.
    pub(crate) fn undo(&mut self) {
        let Some(journal) = self.journal.take() else { return };
        (self.spent, self.leased) = (journal.spent, journal.leased);
        for (episode, lease) in journal.leases {
            match lease {
                Some(lease) => drop(self.leases.insert(episode, lease)),
                None => drop(self.leases.remove(&episode)),
            }
        }
        for (index, word) in journal.words {
            self.verdicts.set_word(index, word);
        }
    }

    /// Notes how the lease of `episode` is before it changes.
    pub(super) fn note_lease(&mut self, episode: u64) {
        if let Some(journal) = &mut self.journal {
            let lease = || self.leases.get(&episode).copied();
            journal.leases.entry(episode).or_insert_with(lease);
        }
    }

    /// Notes how the word at `index` is before it changes.
    pub(super) fn note_word(&mut self, index: WordIndex) {
        if let Some(journal) = &mut self.journal {
            journal.words.entry(index).or_insert_with(|| self.verdicts.word(index));
        }
    }
}

impl LeaseState {
    fn record(&self, episode: u64, verdicts: &Verdicts) -> LeaseRecord {
        LeaseRecord {
            episode,
            units: self.units,
            early_units: self.early_units,
            charged_before: verdicts.n_charged(episode) - u64::from(self.spent),
            settled: self.settled,
        }
    }

    /// The lease of which `record` was written down, unless the episode's verdicts contradict it.
    fn restore(record: &LeaseRecord, verdicts: &Verdicts) -> Option<Self> {
        let spent = verdicts.n_charged(record.episode).checked_sub(record.charged_before)?;
        let spent = u32::try_from(spent).ok()?;
        let LeaseRecord { units, early_units, settled, .. } = *record;
        (spent <= units && early_units <= units).then_some(Self {
            units,
            early_units,
            spent,
            settled,
        })
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::rng::{Stream, episode_rng, index};

    use super::*;
    use crate::budget::Wish;
    use crate::strategy::Strategy;

    const TERMS: Terms = Terms { budget: 120, strategy: Strategy::EarlyAdvising };

    /// What is written down, as a store keeps it.
    #[derive(Default)]
    struct Written {
        leases: BTreeMap<u64, LeaseRecord>,
        words: BTreeMap<WordIndex, Word>,
        spent: u64,
        checksum: Checksum,
    }

    impl Written {
        fn write(&mut self, changes: Changes) {
            if !changes.is_empty() {
                self.spent = changes.spent;
            }
            self.checksum = self.checksum + changes.checksum;
            self.leases.extend(changes.leases.iter().map(|lease| (lease.episode, *lease)));
            self.words.extend(changes.words);
        }

        fn restore(&self) -> Account {
            let leases: Vec<LeaseRecord> = self.leases.values().copied().collect();
            let words = self.words.iter().map(|(index, word)| (*index, *word));
            Account::restore(TERMS, &leases, words).expect("sound")
        }

        /// The checksum, computed anew from every record.
        fn sum(&self) -> Checksum {
            let leases = self.leases.values().map(Checksum::of_lease);
            leases
                .chain(self.words.iter().map(|(index, word)| Checksum::of_word(*index, *word)))
                .sum()
        }
    }

    /// One to five random operations on episodes 0 to 9.
    fn disturb(account: &mut Account, below: &mut impl FnMut(u32) -> u32) {
        for _ in 0..=below(5) {
            let (episode, step) = (u64::from(below(10)), below(100));
            match below(10) {
                0 => drop(account.open_leases(&[episode, (episode + 3) % 10], step % 20)),
                1 => account.settle(&[episode]),
                _ => {
                    let wish = Wish { first: true, second: below(2) == 0 };
                    account.charge(episode, step, wish);
                }
            }
        }
    }

    /// Everything that an account knows.
    fn parts(account: &Account) -> String {
        format!("{account:?}")
    }

    #[test]
    fn what_is_undone_leaves_no_trace_and_what_is_kept_can_be_restored() {
        for seed in 0..50 {
            let mut rng = episode_rng(seed, 0, Stream::Replay);
            let mut below =
                |n: u32| u32::try_from(index(&mut rng, usize::try_from(n).unwrap())).unwrap();
            let (mut account, mut written) = (Account::new(TERMS), Written::default());
            for _ in 0..60 {
                let before = parts(&account);
                account.record();
                disturb(&mut account, &mut below);
                account.record();
                disturb(&mut account, &mut below);
                let changes = account.recorded();
                if below(2) == 0 {
                    account.undo();
                    assert_eq!(parts(&account), before, "seed {seed}");
                } else {
                    account.keep();
                    assert_eq!(changes.is_empty(), parts(&account) == before, "seed {seed}");
                    written.write(changes);
                }
                assert_eq!(parts(&written.restore()), parts(&account), "seed {seed}");
                assert_eq!(written.spent, account.spent(), "seed {seed}");
                assert_eq!(written.checksum, written.sum(), "seed {seed}");
            }
        }
    }

    #[test]
    fn records_that_contradict_one_another_are_refused() {
        let lease = |units, early_units| LeaseRecord {
            episode: 7,
            units,
            early_units,
            charged_before: 0,
            settled: false,
        };
        let word = |asked, charged| ((7, 0), Word { asked, charged, first_half: 0 });
        let check = |lease: LeaseRecord, word: (WordIndex, Word), expected: Option<Unsound>| {
            assert_eq!(Account::restore(TERMS, &[lease], [word]).err(), expected);
        };
        check(lease(2, 1), word(0b111, 0b11), None);
        check(lease(1, 1), word(0b111, 0b11), Some(Unsound::Lease(7)));
        check(lease(2, 3), word(0b111, 0b11), Some(Unsound::Lease(7)));
        check(lease(2, 1), word(0b001, 0b11), Some(Unsound::Verdicts(7)));
        check(lease(121, 1), word(0b111, 0b11), Some(Unsound::Overspent));
        let charged_before = LeaseRecord { charged_before: 3, ..lease(2, 1) };
        check(charged_before, word(0b111, 0b11), Some(Unsound::Lease(7)));
    }
}
