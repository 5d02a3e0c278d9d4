//! The database file: its lock, its transactions and their durability.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rusqlite::{Connection, OpenFlags, TransactionBehavior};

use super::checksum::Checksum;
use super::file_lock::{Displaced, FileLock};
use super::load::{load, prepare, refused, upgrade};
use super::rows::{insert_account, write_update};
use super::{AccountUpdate, StoredAccount};
use crate::budget::AccountTerms;
use crate::ledger::OpenError;

/// The number of transactions after which one is flushed to the disk.
pub(super) const MAX_UNSYNCED: u32 = 256;

/// The failure that a transaction survives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Durability {
    /// The end of the process.
    Kill,
    /// A power cut too, and so do all transactions before it.
    PowerCut,
}

/// The reason why a transaction failed.
#[derive(Debug, thiserror::Error)]
pub(super) enum WriteError {
    /// SQLite cannot write the file.
    #[error(transparent)]
    Sqlite(#[from] rusqlite::Error),
    /// The file was displaced. No further transaction is written to it.
    #[error(transparent)]
    Displaced(#[from] Displaced),
}

/// An open and locked database file.
#[derive(Debug)]
pub(super) struct LedgerFile {
    connection: Connection,
    path: PathBuf,
    /// The current setting of the connection.
    durability: Durability,
    /// Transactions since the last one that survives a power cut.
    n_unsynced: u32,
    /// Set for good once the file was displaced.
    displaced: Option<Displaced>,
    /// Dropped after the connection, because closing the file releases SQLite's locks.
    lock: FileLock,
}

impl LedgerFile {
    /// Opens the ledger at `path`, which is created if it does not exist, and loads its accounts.
    pub(super) fn open(path: &Path) -> Result<(Self, BTreeMap<String, StoredAccount>), OpenError> {
        let mut lock = FileLock::acquire(path)?;
        let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let refused = |error| refused(path, &error);
        let mut connection =
            Connection::open_with_flags(lock.resolved_path(), flags).map_err(refused)?;
        let version = prepare(&mut connection, path)?;
        let accounts = load(&connection, version, path)?;
        upgrade(&mut connection, version, &accounts, path)?;
        lock.remember_log();
        if lock.check_in_place().is_err() {
            return Err(OpenError::InUse(path.to_owned()));
        }
        let (path, durability) = (path.to_owned(), Durability::PowerCut);
        let file = Self { connection, path, durability, n_unsynced: 0, displaced: None, lock };
        Ok((file, accounts))
    }

    /// Returns the path with which the ledger was opened.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns true if the log beside the file was displaced. The file itself has every answered charge then.
    pub(super) fn has_lost_log(&self) -> bool {
        self.displaced == Some(Displaced::Log)
    }

    /// Adds an account with an unspent budget, and returns its key.
    pub(super) fn add_account(
        &mut self,
        name: &str,
        terms: AccountTerms,
        checksum: Checksum,
    ) -> Result<i64, WriteError> {
        self.transaction(Durability::PowerCut, |connection| {
            insert_account(connection, name, terms, checksum)
        })
    }

    /// Writes the changes to all accounts, or none of them.
    pub(super) fn write(
        &mut self,
        updates: &[AccountUpdate<'_>],
        durability: Durability,
    ) -> Result<(), WriteError> {
        self.transaction(durability, |connection| {
            updates.iter().try_for_each(|update| write_update(connection, update))
        })
    }

    /// Returns the number of transactions that a power cut may undo.
    #[cfg(test)]
    pub(super) const fn n_unsynced(&self) -> u32 {
        self.n_unsynced
    }

    /// Returns SQLite's setting `synchronous`: 1 flushes at checkpoints only, 2 after each transaction.
    #[cfg(test)]
    pub(super) fn synchronous(&self) -> u32 {
        let read = |row: &rusqlite::Row<'_>| row.get(0);
        self.connection.pragma_query_value(None, "synchronous", read).expect("a setting")
    }

    /// Limits the file to `n_pages` pages, or to its current size.
    #[cfg(test)]
    pub(super) fn limit_pages(&self, n_pages: u32) {
        let check = |_: &rusqlite::Row<'_>| Ok(());
        self.connection
            .pragma_update_and_check(None, "max_page_count", n_pages, check)
            .expect("a limit");
    }

    /// Runs `write` in a transaction, which is rolled back on an error.
    fn transaction<T>(
        &mut self,
        durability: Durability,
        write: impl FnOnce(&Connection) -> rusqlite::Result<T>,
    ) -> Result<T, WriteError> {
        if let Some(displaced) = self.displaced {
            return Err(displaced.into());
        }
        let durability =
            if self.n_unsynced >= MAX_UNSYNCED { Durability::PowerCut } else { durability };
        self.set_durability(durability)?;
        // Another process may have opened a file that replaced this one, and shares its log files.
        self.check_in_place()?;
        let transaction =
            self.connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
        let answer = write(&transaction)?;
        transaction.commit()?;
        self.n_unsynced = match durability {
            Durability::Kill => self.n_unsynced + 1,
            Durability::PowerCut => 0,
        };
        // The transaction counts only if the next process that opens the path finds it.
        self.check_in_place()?;
        Ok(answer)
    }

    fn check_in_place(&mut self) -> Result<(), Displaced> {
        self.lock.check_in_place().map_err(|displaced| self.give_up(displaced))
    }

    /// Refuses all further transactions: they would be lost, or would contradict the file once it is put back.
    fn give_up(&mut self, displaced: Displaced) -> Displaced {
        tracing::error!(ledger = ?self.path, "nothing more is charged: {displaced}");
        self.displaced = Some(displaced);
        if displaced == Displaced::Log {
            self.rescue_log();
        }
        displaced
    }

    /// Copies the transactions in the lost log into the database.
    fn rescue_log(&self) {
        let mut is_blocked = true;
        let copied = self.connection.pragma(None, "wal_checkpoint", "TRUNCATE", |row| {
            is_blocked = row.get(0)?;
            Ok(())
        });
        if copied.is_err() || is_blocked {
            tracing::error!(ledger = ?self.path, "the last charges are lost if this process is killed");
        }
    }

    /// Ends a transaction that failed to roll back, and sets the durability of the next one.
    fn set_durability(&mut self, durability: Durability) -> rusqlite::Result<()> {
        if !self.connection.is_autocommit() {
            self.connection.execute_batch("ROLLBACK")?;
        }
        if self.durability != durability {
            let synchronous = match durability {
                Durability::Kill => "NORMAL",
                Durability::PowerCut => "FULL",
            };
            self.connection.pragma_update(None, "synchronous", synchronous)?;
            self.durability = durability;
        }
        Ok(())
    }
}
