//! Accounts in a file that one process owns.
//!
//! The accounts are in memory and every change goes to the file before it is answered: all bills of one call in one
//! transaction. When the file cannot be written, the accounts are put back to what they were.
//!
//! What survives: the end of the process at any moment (`kill -9`) loses nothing that was answered. A loss of power
//! loses no account, lease or settlement that was answered, and no charge that was answered before one of those. Of
//! the charges after that it may lose those of the last [`file::MAX_UNSYNCED`] transactions:
//!
//! - Episodes with a lease: nothing is lost for good. Their steps get the same verdicts when they are asked about
//!   again, because a lease does not depend on what others spend.
//! - Episodes without a lease: what was forgotten is charged anew when it is asked about again, and may then get
//!   another verdict; if it is not asked about again, so much more than the budget is spent.
//!
//! Everything can be looked at with the `sqlite3` tool while the teacher runs, but not changed: this process would not
//! see it.

mod file;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use super::{
    Bill, Ledger, LedgerError, OpenError, Receipt, charge_all, check_budget, check_terms,
    unknown_account,
};
use crate::budget::{Account, Balance, Lease, Terms};
use file::{Durability, LedgerFile};

/// Accounts in an SQLite file.
#[derive(Debug)]
pub struct SqliteLedger {
    file: LedgerFile,
    accounts: BTreeMap<String, Kept>,
}

/// An account and its number in the file.
#[derive(Debug)]
struct Kept {
    id: i64,
    account: Account,
}

impl SqliteLedger {
    /// Opens the ledger in `path`, which is made when there is none, and keeps other processes from opening it.
    ///
    /// # Errors
    /// When another process has it open, when it cannot be read or written, or is not a sound ledger of this version.
    pub fn open(path: &Path) -> Result<Self, OpenError> {
        let mut file = LedgerFile::open(path)?;
        let accounts = file.load()?;
        tracing::info!(ledger = %path.display(), accounts = accounts.len(), "ledger opened");
        let accounts = accounts.into_iter().map(|(name, id, account)| (name, Kept { id, account }));
        Ok(Self { file, accounts: accounts.collect() })
    }

    fn account(&mut self, name: &str) -> Result<&mut Account, LedgerError> {
        let kept = self.accounts.get_mut(name).ok_or_else(|| unknown_account(name))?;
        Ok(&mut kept.account)
    }

    /// Writes what changed in the accounts called `names`; when that fails, nothing has changed.
    fn commit(
        &mut self,
        names: &BTreeSet<&str>,
        durability: Durability,
    ) -> Result<(), rusqlite::Error> {
        let accounts = &self.accounts;
        let changed = names.iter().filter_map(|name| accounts.get(*name));
        let changes = changed.map(|kept| (kept.id, kept.account.recorded()));
        let changes: Vec<_> = changes.filter(|(_, changes)| !changes.is_empty()).collect();
        let written =
            if changes.is_empty() { Ok(()) } else { self.file.write(&changes, durability) };
        for name in names {
            if let Some(kept) = self.accounts.get_mut(*name) {
                match written {
                    Ok(()) => kept.account.keep(),
                    Err(_) => kept.account.undo(),
                }
            }
        }
        written
    }

    /// Changes account `name` and writes that down for good.
    fn change<T>(
        &mut self,
        name: &str,
        change: impl FnOnce(&mut Account) -> T,
    ) -> Result<T, LedgerError> {
        let account = self.account(name)?;
        account.record();
        let answer = change(account);
        match self.commit(&BTreeSet::from([name]), Durability::PowerCut) {
            Ok(()) => Ok(answer),
            Err(error) => Err(self.unavailable(error)),
        }
    }

    fn unavailable(&self, error: impl std::error::Error + Send + Sync + 'static) -> LedgerError {
        let what = format!("cannot write {:?}", self.file.path());
        LedgerError::Unavailable { what, source: Some(Box::new(error)) }
    }
}

impl Ledger for SqliteLedger {
    fn open(&mut self, name: &str, terms: Terms) -> Result<Balance, LedgerError> {
        check_budget(terms)?;
        if let Some(kept) = self.accounts.get(name) {
            check_terms(name, kept.account.terms(), terms)?;
            return Ok(kept.account.balance());
        }
        let id = self.file.add_account(name, terms).map_err(|error| self.unavailable(error))?;
        let account = Account::new(terms);
        let balance = account.balance();
        self.accounts.insert(name.to_owned(), Kept { id, account });
        Ok(balance)
    }

    fn balance(&mut self, name: &str) -> Result<Balance, LedgerError> {
        Ok(self.account(name)?.balance())
    }

    fn open_leases(
        &mut self,
        name: &str,
        episodes: &[u64],
        units_per_episode: u32,
    ) -> Result<(Vec<Lease>, Balance), LedgerError> {
        self.change(name, |account| {
            (account.open_leases(episodes, units_per_episode), account.balance())
        })
    }

    fn settle(&mut self, name: &str, episodes: &[u64]) -> Result<Balance, LedgerError> {
        self.change(name, |account| {
            account.settle(episodes);
            account.balance()
        })
    }

    fn charge(&mut self, bills: &[Bill]) -> Vec<Result<Receipt, LedgerError>> {
        let charge = |bill: &Bill| {
            let account = self.account(&bill.account)?;
            account.record();
            charge_all(account, &bill.charges)
        };
        let outcomes: Vec<_> = bills.iter().map(charge).collect();
        let names = bills.iter().map(|bill| bill.account.as_str()).collect();
        let Err(error) = self.commit(&names, Durability::Kill) else { return outcomes };
        let error = std::sync::Arc::new(error);
        let failed = |outcome: Result<Receipt, LedgerError>| {
            outcome.and_then(|_| Err(self.unavailable(std::sync::Arc::clone(&error))))
        };
        outcomes.into_iter().map(failed).collect()
    }
}

#[cfg(test)]
mod tests;
