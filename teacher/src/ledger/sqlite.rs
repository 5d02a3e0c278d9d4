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
//! The file can be read with the `sqlite3` tool while the teacher runs. It must not be changed, at any time: each
//! account has a checksum over its rows, and a ledger with another one is refused as damaged.
//!
//! One process at a time has the file, by whichever path. The lock is on the file itself: other files, such as the
//! `.lock` file that earlier versions left beside it, have no part in it. A file with several names (hard links) is
//! refused. After every transaction the path must still lead to the file, else nothing more is charged.

mod file;
mod hold;
mod rows;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use super::{
    Bill, Ledger, LedgerError, OpenError, Receipt, charge_all, check_budget, check_terms,
    unknown_account,
};
use crate::budget::{Account, Balance, Checksum, Lease, Terms};
use file::{AccountChanges, Durability, LedgerFile, StoredAccount, WriteError};

/// Accounts in an SQLite file.
#[derive(Debug)]
pub struct SqliteLedger {
    file: LedgerFile,
    accounts: BTreeMap<String, Kept>,
    /// Why the last transaction failed, if it did.
    warning: Option<String>,
}

/// An account, and its number and checksum in the file.
#[derive(Debug)]
struct Kept {
    id: i64,
    checksum: Checksum,
    account: Account,
}

impl SqliteLedger {
    /// Opens the ledger in `path`, which is made when there is none, and keeps other processes from opening it.
    ///
    /// # Errors
    /// When another process has it open, when it cannot be read or written, or is not a sound ledger of this version.
    pub fn open(path: &Path) -> Result<Self, OpenError> {
        let (file, accounts) = LedgerFile::open(path)?;
        tracing::info!(ledger = ?path, accounts = accounts.len(), "ledger opened");
        let accounts = accounts.into_iter().map(|stored| {
            let StoredAccount { id, name, checksum, account } = stored;
            (name, Kept { id, checksum, account })
        });
        Ok(Self { file, accounts: accounts.collect(), warning: None })
    }

    fn account(&mut self, name: &str) -> Result<&mut Account, LedgerError> {
        let kept = self.accounts.get_mut(name).ok_or_else(|| unknown_account(name))?;
        Ok(&mut kept.account)
    }

    /// Writes what changed in the accounts called `names`; when that fails, nothing has changed.
    fn commit(&mut self, names: &BTreeSet<&str>, durability: Durability) -> Result<(), WriteError> {
        let accounts = &self.accounts;
        let changed = names.iter().filter_map(|name| accounts.get(*name)).map(Kept::changes);
        let changed: Vec<_> = changed.filter(|changed| !changed.changes.is_empty()).collect();
        let written =
            if changed.is_empty() { Ok(()) } else { self.file.write(&changed, durability) };
        let checksums: BTreeMap<i64, Checksum> =
            changed.iter().map(|changed| (changed.id, changed.checksum)).collect();
        if !changed.is_empty() {
            self.note(&written);
        }
        for name in names {
            if let Some(kept) = self.accounts.get_mut(*name) {
                match written {
                    Ok(()) => kept.keep(checksums.get(&kept.id)),
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

    /// Remembers whether the file could be written, and logs when that changes.
    fn note<T>(&mut self, written: &Result<T, WriteError>) {
        let path = self.file.path();
        let warning = written.as_ref().err().map(|error| format!("cannot write {path:?}: {error}"));
        match (&self.warning, &warning) {
            (None, Some(warning)) => tracing::error!("nothing can be charged: {warning}"),
            (Some(_), None) => tracing::info!(ledger = ?path, "the ledger can be written again"),
            _ => {}
        }
        self.warning = warning;
    }

    fn unavailable(&self, error: impl std::error::Error + Send + Sync + 'static) -> LedgerError {
        let what = format!("cannot write {:?}", self.file.path());
        LedgerError::Unavailable { what, source: Some(Box::new(error)) }
    }
}

impl Kept {
    /// What has changed since the last transaction.
    fn changes(&self) -> AccountChanges {
        let changes = self.account.recorded();
        let checksum = self.checksum + changes.checksum;
        AccountChanges { id: self.id, changes, checksum }
    }

    /// Notes that the changes are written, and with which checksum.
    fn keep(&mut self, written: Option<&Checksum>) {
        self.account.keep();
        self.checksum = written.copied().unwrap_or(self.checksum);
    }
}

impl Ledger for SqliteLedger {
    fn open(&mut self, name: &str, terms: Terms) -> Result<Balance, LedgerError> {
        check_budget(terms)?;
        if let Some(kept) = self.accounts.get(name) {
            check_terms(name, kept.account.terms(), terms)?;
            return Ok(kept.account.balance());
        }
        let checksum = Checksum::of_terms(name, terms);
        let added = self.file.add_account(name, terms, checksum);
        self.note(&added);
        let id = added.map_err(|error| self.unavailable(error))?;
        let account = Account::new(terms);
        let balance = account.balance();
        self.accounts.insert(name.to_owned(), Kept { id, checksum, account });
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

    fn warning(&self) -> Option<&str> {
        self.warning.as_deref()
    }
}

#[cfg(test)]
mod tests;
