//! One account: what is left of its budget, for whom units are set aside, and which steps were charged.

mod checksum;
mod journal;

use std::collections::BTreeMap;

use super::verdicts::{Verdicts, index};
use super::{Balance, Half, Lease, Terms, Verdict, Wish};
use journal::Journal;

pub(crate) use checksum::Checksum;
pub(crate) use journal::{Changes, LeaseRecord};

/// One budget and everything that was charged to it.
#[derive(Debug, Clone)]
pub struct Account {
    terms: Terms,
    spent: u64,
    /// Unspent units of open leases.
    leased: u64,
    leases: BTreeMap<u64, LeaseState>,
    verdicts: Verdicts,
    /// What was changed since somebody began to record it.
    journal: Option<Box<Journal>>,
}

/// A lease and what became of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct LeaseState {
    units: u32,
    early_units: u32,
    spent: u32,
    settled: bool,
}

impl Account {
    /// An account of which nothing is spent.
    #[must_use]
    pub fn new(terms: Terms) -> Self {
        Self {
            terms,
            spent: 0,
            leased: 0,
            leases: BTreeMap::new(),
            verdicts: Verdicts::default(),
            journal: None,
        }
    }

    /// What it was opened for.
    #[must_use]
    pub const fn terms(&self) -> Terms {
        self.terms
    }

    /// Units neither spent nor set aside.
    #[must_use]
    pub const fn left(&self) -> u64 {
        self.terms.budget - self.handed_out()
    }

    /// How the account stands.
    #[must_use]
    pub const fn balance(&self) -> Balance {
        Balance { terms: self.terms, spent: self.spent, leased: self.leased, left: self.left() }
    }

    /// Whether units were ever set aside for `episode`.
    #[must_use]
    pub fn has_lease(&self, episode: u64) -> bool {
        self.leases.contains_key(&episode)
    }

    /// Sets aside `units_per_episode`, or what is left, for each of `episodes` in turn.
    ///
    /// An episode that has a lease, open or settled, keeps it.
    pub fn open_leases(&mut self, episodes: &[u64], units_per_episode: u32) -> Vec<Lease> {
        episodes.iter().map(|episode| self.open_lease(*episode, units_per_episode)).collect()
    }

    fn open_lease(&mut self, episode: u64, max_units: u32) -> Lease {
        self.note_lease(episode);
        let (handed_out, left) = (self.handed_out(), self.left());
        let lease = self.leases.entry(episode).or_insert_with(|| {
            let units = at_most(max_units, left);
            let early_units =
                at_most(units, first_half(self.terms.budget).saturating_sub(handed_out));
            self.leased += u64::from(units);
            LeaseState { units, early_units, spent: 0, settled: false }
        });
        Lease { episode, units: lease.units, early_units: lease.early_units }
    }

    /// Returns the unspent units of `episodes` to the budget. Episodes without an open lease have none.
    pub fn settle(&mut self, episodes: &[u64]) {
        for episode in episodes {
            self.note_lease(*episode);
            if let Some(lease) = self.leases.get_mut(episode).filter(|lease| !lease.settled) {
                lease.settled = true;
                self.leased -= u64::from(lease.units - lease.spent);
            }
        }
    }

    /// Decides whether step `step` of `episode` costs a unit: when it is worth the next one that the episode may
    /// spend. Asked again, it gives the same verdict, whatever the wish, and charges nothing.
    ///
    /// An episode with a lease spends its lease's units and, settled, none; one without spends what is left.
    pub fn charge(&mut self, episode: u64, step: u32, wish: Wish) -> Verdict {
        if let Some(verdict) = self.verdicts.get(episode, step) {
            return verdict;
        }
        self.note_word(index(episode, step));
        let verdict = match self.next_unit(episode) {
            Some(half) if wish.covers(half) => {
                self.spend_unit(episode);
                Verdict::Charged(half)
            }
            _ => Verdict::Uncharged,
        };
        self.verdicts.insert(episode, step, verdict);
        verdict
    }

    /// The half of the next unit that `episode` may spend, when there is one: `n_b > 0` of every procedure.
    fn next_unit(&self, episode: u64) -> Option<Half> {
        let (available, early) = match self.leases.get(&episode) {
            Some(lease) => {
                (!lease.settled && lease.spent < lease.units, lease.spent < lease.early_units)
            }
            None => (self.left() > 0, self.handed_out() < first_half(self.terms.budget)),
        };
        available.then_some(if early { Half::First } else { Half::Second })
    }

    /// `n_b ← n_b − 1`: the one place where a unit is spent. There is one, [`Self::next_unit`] found it.
    fn spend_unit(&mut self, episode: u64) {
        self.note_lease(episode);
        if let Some(lease) = self.leases.get_mut(&episode) {
            lease.spent += 1;
            self.leased -= 1;
        }
        self.spent += 1;
    }

    /// Units spent or set aside; also the number of the next unit, counted from 0.
    const fn handed_out(&self) -> u64 {
        self.spent + self.leased
    }
}

/// How many units of `budget` are handed out while more than half of it is left.
const fn first_half(budget: u64) -> u64 {
    budget.div_ceil(2)
}

/// The smaller of `units` and `limit`.
fn at_most(units: u32, limit: u64) -> u32 {
    u32::try_from(limit).map_or(units, |limit| units.min(limit))
}

#[cfg(test)]
mod tests;
