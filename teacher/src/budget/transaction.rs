//! Operations on an account whose changes are collected before they are applied.

use std::collections::BTreeMap;

use super::account::{Account, LeaseRecord};
use super::verdict_bits::{VerdictBits, VerdictIndex, charged_units, verdict_index};
use super::{AccountTerms, BudgetHalf, Charge, Lease};

/// A series of operations on an account. Each operation sees the changes of those before it; the account itself stays
/// as it is until [`Account::apply`]. A ledger in a file writes the changes before it applies them.
#[derive(Debug)]
pub(crate) struct Transaction<'a> {
    account: &'a Account,
    changes: Changes,
}

/// The records that a transaction has added or changed, and the account's totals after it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Changes {
    /// Units charged.
    pub(crate) spent: u64,
    /// Unspent units of open leases.
    pub(crate) leased: u64,
    /// Leases opened or settled, by episode.
    pub(crate) leases: BTreeMap<u64, LeaseRecord>,
    /// Verdicts that are new or have more bits.
    pub(crate) verdicts: BTreeMap<VerdictIndex, VerdictBits>,
}

impl Changes {
    /// Returns true if no record has changed.
    pub(crate) fn is_empty(&self) -> bool {
        self.leases.is_empty() && self.verdicts.is_empty()
    }
}

impl<'a> Transaction<'a> {
    pub(super) const fn new(account: &'a Account) -> Self {
        let balance = account.balance();
        let changes = Changes {
            spent: balance.spent,
            leased: balance.leased,
            leases: BTreeMap::new(),
            verdicts: BTreeMap::new(),
        };
        Self { account, changes }
    }

    /// Ends the transaction and returns its changes.
    pub(crate) fn into_changes(self) -> Changes {
        self.changes
    }

    /// Returns the budget and the strategy of the account.
    pub(crate) const fn terms(&self) -> AccountTerms {
        self.account.terms()
    }

    /// Returns the units that are neither spent nor leased.
    pub(crate) const fn left(&self) -> u64 {
        self.account.terms().budget - self.assigned()
    }

    /// Returns true if units were ever reserved for `episode`.
    pub(crate) fn has_lease(&self, episode: u64) -> bool {
        self.lease(episode).is_some()
    }

    /// Opens leases; see [`Account::open_leases`].
    pub(crate) fn open_leases(&mut self, episodes: &[u64], units_per_episode: u32) -> Vec<Lease> {
        episodes.iter().map(|episode| self.open_lease(*episode, units_per_episode)).collect()
    }

    fn open_lease(&mut self, episode: u64, max_units: u32) -> Lease {
        let record = self.lease(episode).unwrap_or_else(|| {
            let units = at_most(max_units, self.left());
            let early_units = at_most(units, self.first_half().saturating_sub(self.assigned()));
            let charged_before = self.charged_units(episode);
            let record = LeaseRecord { units, early_units, charged_before, settled: false };
            self.changes.leased += u64::from(units);
            self.changes.leases.insert(episode, record);
            record
        });
        Lease { episode, units: record.units, early_units: record.early_units }
    }

    /// Settles leases; see [`Account::settle`].
    pub(crate) fn settle(&mut self, episodes: &[u64]) {
        for episode in episodes {
            if let Some(lease) = self.lease(*episode).filter(|lease| !lease.settled) {
                self.changes.leased -= u64::from(self.unspent(*episode, &lease));
                self.changes.leases.insert(*episode, LeaseRecord { settled: true, ..lease });
            }
        }
    }

    /// Returns true if there is a verdict on the step of `charge`.
    pub(crate) fn has_verdict(&self, charge: Charge) -> bool {
        let bits = self.verdicts_at(verdict_index(charge.episode, charge.step));
        bits.is_some_and(|bits| bits.get(charge.step).is_some())
    }

    /// Charges one step; see [`Account::charge`].
    pub(crate) fn charge(&mut self, charge: Charge) -> Option<BudgetHalf> {
        let Charge { episode, step, .. } = charge;
        let index = verdict_index(episode, step);
        let mut bits = self.verdicts_at(index).unwrap_or_default();
        if let Some(verdict) = bits.get(step) {
            return verdict;
        }
        let verdict = self.next_unit(episode).filter(|half| charge.wanted_in.contains(*half));
        if verdict.is_some() {
            self.spend_unit(episode);
        }
        bits.insert(step, verdict);
        self.changes.verdicts.insert(index, bits);
        verdict
    }

    /// Returns the half of the next unit that `episode` may spend, if there is one: `n_b > 0` in every procedure.
    fn next_unit(&self, episode: u64) -> Option<BudgetHalf> {
        let (is_available, is_early) = match self.lease(episode) {
            Some(lease) => {
                let unspent = self.unspent(episode, &lease);
                (!lease.settled && unspent > 0, lease.units - unspent < lease.early_units)
            }
            None => (self.left() > 0, self.assigned() < self.first_half()),
        };
        is_available.then_some(if is_early { BudgetHalf::First } else { BudgetHalf::Second })
    }

    /// `n_b ← n_b − 1`: the one place where a unit is spent, after [`Self::next_unit`] has found it.
    fn spend_unit(&mut self, episode: u64) {
        self.changes.leased -= u64::from(self.has_lease(episode));
        self.changes.spent += 1;
    }

    /// Returns the units that are spent or leased, which is also the number of the next unit, from 0.
    const fn assigned(&self) -> u64 {
        self.changes.spent + self.changes.leased
    }

    /// Returns the number of units in the first half of the budget.
    const fn first_half(&self) -> u64 {
        self.account.terms().budget.div_ceil(2)
    }

    fn lease(&self, episode: u64) -> Option<LeaseRecord> {
        self.changes.leases.get(&episode).or_else(|| self.account.lease(episode)).copied()
    }

    fn verdicts_at(&self, index: VerdictIndex) -> Option<VerdictBits> {
        self.changes.verdicts.get(&index).or_else(|| self.account.verdicts_at(index)).copied()
    }

    /// Returns the units charged to `episode`.
    fn charged_units(&self, episode: u64) -> u64 {
        let changed = &self.changes.verdicts;
        let unchanged = charged_units(self.account.verdicts(), episode);
        let unchanged = unchanged.filter(|(index, _)| !changed.contains_key(index));
        unchanged.chain(charged_units(changed, episode)).map(|(_, units)| units).sum()
    }

    fn unspent(&self, episode: u64, lease: &LeaseRecord) -> u32 {
        lease.unspent(self.charged_units(episode)).expect("a lease pays for what it has units for")
    }
}

/// Returns the smaller of `units` and `limit`.
fn at_most(units: u32, limit: u64) -> u32 {
    u32::try_from(limit).map_or(units, |limit| units.min(limit))
}
