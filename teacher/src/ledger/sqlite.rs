//! The ledger in an SQLite file.
//!
//! The accounts are in memory. An operation collects its [`Changes`], which are written to the file in one transaction,
//! for all requests of a call together, and applied to the accounts once the file has them. If the file cannot be
//! written, the changes are dropped, in the file and in memory.

mod checksum;
mod file;
mod file_lock;
mod load;
mod rows;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use super::{
    ChargeRequest, ChargeResult, Ledger, LedgerError, OpenError, charge_all, check_budget,
    check_terms, unknown_account,
};
use crate::budget::{Account, AccountTerms, Balance, Changes, Lease, Transaction};
use checksum::Checksum;
use file::{Durability, LedgerFile, WriteError};

/// A ledger in an SQLite file that one process owns.
///
/// The end of the process at any moment (`kill -9`) loses no operation that has returned. A power cut loses no account,
/// lease or settlement that was returned, and no charge that was returned before one of those. It may lose charges of
/// the last 256 transactions after them:
///
/// - In episodes with a lease, a repeated request restores the lost charges with the same verdicts, because a lease
///   does not depend on what other episodes spend.
/// - In episodes without a lease, a repeated request charges the step anew and may get another verdict. If it is not
///   repeated, the lost units are spent in addition to the budget.
///
/// The `sqlite3` tool can read the file while the teacher runs. No other program may change it: each account has a
/// checksum over its rows, and a ledger whose checksum does not match is refused as damaged.
///
/// One process at a time can open the file, by any path. The lock is on the file itself; other files, such as the
/// `.lock` file that earlier versions left beside it, are not used. A file with several names (hard links) is refused.
/// Before and after each transaction the path must lead to the file; otherwise the ledger refuses all further charges.
#[derive(Debug)]
pub struct SqliteLedger {
    file: LedgerFile,
    accounts: BTreeMap<String, StoredAccount>,
    /// The reason why the last transaction failed, if it did.
    warning: Option<String>,
}

/// An account with the key and the checksum of its rows in the file.
#[derive(Debug)]
struct StoredAccount {
    id: i64,
    checksum: Checksum,
    account: Account,
}

/// The changes to one account, with its checksum after them.
struct AccountUpdate<'a> {
    name: &'a str,
    id: i64,
    changes: Changes,
    checksum: Checksum,
}

impl SqliteLedger {
    /// Opens the ledger at `path`, which is created if it does not exist, and locks it against other processes.
    ///
    /// # Errors
    /// When another process has it open, when it cannot be read or written, or when it is not an undamaged ledger of a
    /// known version.
    pub fn open(path: &Path) -> Result<Self, OpenError> {
        let (file, accounts) = LedgerFile::open(path)?;
        tracing::info!(ledger = ?path, accounts = accounts.len(), "ledger opened");
        Ok(Self { file, accounts, warning: None })
    }

    fn stored(&self, name: &str) -> Result<&StoredAccount, LedgerError> {
        self.accounts.get(name).ok_or_else(|| unknown_account(name))
    }

    /// Runs `operate` on account `name` and makes its changes durable.
    fn update<T>(
        &mut self,
        name: &str,
        operate: impl FnOnce(&mut Transaction<'_>) -> T,
    ) -> Result<(T, Balance), LedgerError> {
        let mut transaction = self.stored(name)?.account.begin();
        let output = operate(&mut transaction);
        let changes = [(name, transaction.into_changes())];
        let written = self.commit(changes, Durability::PowerCut);
        written.map_err(|error| self.unavailable(error))?;
        Ok((output, self.stored(name)?.account.balance()))
    }

    /// Writes changes to accounts, by name, and then applies them. If the file cannot be written, nothing has changed.
    fn commit<'a>(
        &mut self,
        changes: impl IntoIterator<Item = (&'a str, Changes)>,
        durability: Durability,
    ) -> Result<(), WriteError> {
        let changes = changes.into_iter().filter(|(_, changes)| !changes.is_empty());
        let update = |(name, changes)| {
            let StoredAccount { id, checksum, account } = self.accounts.get(name)?;
            let checksum = checksum.after(account, &changes);
            Some(AccountUpdate { name, id: *id, changes, checksum })
        };
        let updates: Vec<AccountUpdate<'_>> = changes.filter_map(update).collect();
        if updates.is_empty() {
            return Ok(());
        }
        let written = self.file.write(&updates, durability);
        self.report(&written);
        written?;
        for AccountUpdate { name, changes, checksum, .. } in updates {
            if let Some(stored) = self.accounts.get_mut(name) {
                stored.account.apply(changes);
                stored.checksum = checksum;
            }
        }
        Ok(())
    }

    /// Stores the outcome of a transaction as the warning, and logs when it differs from the previous one.
    fn report<T>(&mut self, written: &Result<T, WriteError>) {
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

impl Ledger for SqliteLedger {
    fn open(&mut self, name: &str, terms: AccountTerms) -> Result<Balance, LedgerError> {
        check_budget(terms)?;
        if let Some(stored) = self.accounts.get(name) {
            check_terms(name, stored.account.terms(), terms)?;
            return Ok(stored.account.balance());
        }
        let checksum = Checksum::of_terms(name, terms);
        let added = self.file.add_account(name, terms, checksum);
        self.report(&added);
        let id = added.map_err(|error| self.unavailable(error))?;
        let account = Account::new(terms);
        let balance = account.balance();
        self.accounts.insert(name.to_owned(), StoredAccount { id, checksum, account });
        Ok(balance)
    }

    fn balance(&mut self, name: &str) -> Result<Balance, LedgerError> {
        Ok(self.stored(name)?.account.balance())
    }

    fn open_leases(
        &mut self,
        name: &str,
        episodes: &[u64],
        units_per_episode: u32,
    ) -> Result<(Vec<Lease>, Balance), LedgerError> {
        self.update(name, |account| account.open_leases(episodes, units_per_episode))
    }

    fn settle(&mut self, name: &str, episodes: &[u64]) -> Result<Balance, LedgerError> {
        let ((), balance) = self.update(name, |account| account.settle(episodes))?;
        Ok(balance)
    }

    fn charge(&mut self, requests: &[ChargeRequest]) -> Vec<Result<ChargeResult, LedgerError>> {
        let mut transactions: BTreeMap<&str, Transaction<'_>> = BTreeMap::new();
        let mut results = Vec::with_capacity(requests.len());
        for request in requests {
            let name = &request.account;
            results.push(self.stored(name).and_then(|stored| {
                let transaction =
                    transactions.entry(name.as_str()).or_insert_with(|| stored.account.begin());
                charge_all(transaction, request)
            }));
        }
        let changes: Vec<(&str, Changes)> = transactions
            .into_iter()
            .map(|(name, transaction)| (name, transaction.into_changes()))
            .collect();
        let Err(error) = self.commit(changes, Durability::Kill) else { return results };
        let error = Arc::new(error);
        let unavailable = |_| Err(self.unavailable(Arc::clone(&error)));
        results.into_iter().map(|result| result.and_then(unavailable)).collect()
    }

    fn warning(&self) -> Option<&str> {
        self.warning.as_deref()
    }

    fn needs_restart(&self) -> bool {
        self.file.has_lost_log()
    }
}

#[cfg(test)]
mod tests;
