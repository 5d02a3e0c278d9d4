//! One account: its budget, its leases and its verdicts.

use std::collections::BTreeMap;

use super::transaction::{Changes, Transaction};
use super::verdict_bits::{VerdictBits, VerdictIndex, charged_units};
use super::{AccountTerms, Balance, BudgetHalf, Charge, Lease};

/// A budget with its leases and the verdicts on all steps that were asked about.
#[derive(Debug, Clone, PartialEq)]
pub struct Account {
    terms: AccountTerms,
    spent: u64,
    /// Unspent units of open leases.
    leased: u64,
    /// By episode.
    leases: BTreeMap<u64, LeaseRecord>,
    verdicts: BTreeMap<VerdictIndex, VerdictBits>,
}

/// The lease of one episode, as ledgers store it. The units spent of it follow from the verdicts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct LeaseRecord {
    /// Units reserved.
    pub(crate) units: u32,
    /// The number of these units in the first half of the budget.
    pub(crate) early_units: u32,
    /// Units charged to the episode before it had the lease.
    pub(crate) charged_before: u64,
    /// True after the unspent units were returned to the budget.
    pub(crate) settled: bool,
}

/// The reason why stored records do not form an account.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum AccountError {
    /// The units of a lease contradict the verdicts on its episode.
    #[error("the lease of episode {0} does not fit its verdicts")]
    Lease(u64),
    /// A step is charged that was not asked about.
    #[error("the verdicts on episode {0} contradict one another")]
    Verdicts(u64),
    /// More units are spent and leased than the budget has.
    #[error("more than the budget is handed out")]
    Overspent,
}

impl Account {
    /// Creates an account with an unspent budget.
    #[must_use]
    pub const fn new(terms: AccountTerms) -> Self {
        Self { terms, spent: 0, leased: 0, leases: BTreeMap::new(), verdicts: BTreeMap::new() }
    }

    /// Restores an account from its stored records.
    ///
    /// # Errors
    /// When the records contradict one another.
    pub(crate) fn restore(
        terms: AccountTerms,
        leases: &[(u64, LeaseRecord)],
        verdicts: &[(VerdictIndex, VerdictBits)],
    ) -> Result<Self, AccountError> {
        let mut account = Self::new(terms);
        for (index, bits) in verdicts {
            if !bits.is_consistent() {
                return Err(AccountError::Verdicts(index.0));
            }
            account.spent += bits.n_charged();
            account.verdicts.insert(*index, *bits);
        }
        for (episode, lease) in leases {
            let unspent = lease.unspent(account.charged_units(*episode));
            let unspent = unspent.ok_or(AccountError::Lease(*episode))?;
            account.leased += if lease.settled { 0 } else { u64::from(unspent) };
            account.leases.insert(*episode, *lease);
        }
        if account.spent + account.leased > terms.budget {
            return Err(AccountError::Overspent);
        }
        Ok(account)
    }

    /// Returns the budget and the strategy.
    #[must_use]
    pub const fn terms(&self) -> AccountTerms {
        self.terms
    }

    /// Returns the units that are neither spent nor leased.
    #[must_use]
    pub const fn left(&self) -> u64 {
        self.balance().left
    }

    /// Returns the state of the account.
    #[must_use]
    pub const fn balance(&self) -> Balance {
        let Self { terms, spent, leased, .. } = *self;
        Balance { terms, spent, leased, left: terms.budget - spent - leased }
    }

    /// Reserves `units_per_episode`, or the units that are left, for each of `episodes` in turn.
    ///
    /// An episode that has a lease, open or settled, keeps it.
    pub fn open_leases(&mut self, episodes: &[u64], units_per_episode: u32) -> Vec<Lease> {
        self.update(|transaction| transaction.open_leases(episodes, units_per_episode))
    }

    /// Returns the unspent units of `episodes` to the budget. Episodes without an open lease have none.
    pub fn settle(&mut self, episodes: &[u64]) {
        self.update(|transaction| transaction.settle(episodes));
    }

    /// Decides whether a step costs a unit, and returns the half of the budget that the unit belongs to.
    ///
    /// A step costs a unit if the episode has one to spend and the step is worth it. An episode with a lease spends the
    /// units of its lease and, once settled, none; an episode without a lease spends units that are left. A repeated
    /// request gets the same verdict and charges nothing, even if it wants something else.
    pub fn charge(&mut self, charge: Charge) -> Option<BudgetHalf> {
        self.update(|transaction| transaction.charge(charge))
    }

    /// Runs `operate` in a transaction and applies its changes.
    pub(crate) fn update<T>(&mut self, operate: impl FnOnce(&mut Transaction<'_>) -> T) -> T {
        let mut transaction = self.begin();
        let output = operate(&mut transaction);
        let changes = transaction.into_changes();
        self.apply(changes);
        output
    }

    /// Begins a transaction. Dropping it discards its changes.
    pub(crate) const fn begin(&self) -> Transaction<'_> {
        Transaction::new(self)
    }

    /// Applies the changes of a transaction on this account.
    pub(crate) fn apply(&mut self, changes: Changes) {
        let Changes { spent, leased, leases, verdicts } = changes;
        (self.spent, self.leased) = (spent, leased);
        self.leases.extend(leases);
        self.verdicts.extend(verdicts);
    }

    /// Returns the lease of `episode`, open or settled.
    pub(crate) fn lease(&self, episode: u64) -> Option<&LeaseRecord> {
        self.leases.get(&episode)
    }

    /// Returns the verdicts at `index`, if one of its steps was asked about.
    pub(crate) fn verdicts_at(&self, index: VerdictIndex) -> Option<&VerdictBits> {
        self.verdicts.get(&index)
    }

    /// Returns all verdicts.
    pub(crate) const fn verdicts(&self) -> &BTreeMap<VerdictIndex, VerdictBits> {
        &self.verdicts
    }

    fn charged_units(&self, episode: u64) -> u64 {
        charged_units(&self.verdicts, episode).map(|(_, units)| units).sum()
    }
}

impl LeaseRecord {
    /// Returns the unspent units when `charged_units` were charged to the episode in all, or `None` if that contradicts
    /// the lease.
    pub(crate) fn unspent(&self, charged_units: u64) -> Option<u32> {
        let spent = u32::try_from(charged_units.checked_sub(self.charged_before)?).ok()?;
        self.units.checked_sub(spent).filter(|_| self.early_units <= self.units)
    }
}
