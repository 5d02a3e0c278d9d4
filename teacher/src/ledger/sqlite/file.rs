//! The file itself: who owns it, what stands in it, how it is written.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rusqlite::{Connection, ErrorCode, OpenFlags, TransactionBehavior};

use super::hold::{Displaced, Hold};
use super::rows::{
    AccountRow, insert_account, read_accounts, read_leases, read_words, write_changes,
    write_checksum,
};
use crate::budget::{Account, Changes, Checksum, LeaseRecord, Terms, Word, WordIndex};
use crate::ledger::{OpenError, printable};

/// Transactions that a loss of power may undo before one is waited for.
pub(super) const MAX_UNSYNCED: u32 = 256;

/// What stands in the file's header: "tndm" in ASCII.
const APPLICATION_ID: i64 = 0x746E_646D;
const VERSION: i64 = 2;
/// The version without checksums.
const VERSION_1: i64 = 1;
const SCHEMA: &str = include_str!("schema.sql");
const UPGRADE_FROM_1: &str = "ALTER TABLE accounts ADD COLUMN checksum INTEGER NOT NULL DEFAULT 0";
/// How long somebody else, who ought only to look, may hold the file.
const BUSY_TIMEOUT: Duration = Duration::from_secs(2);

/// What a transaction survives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Durability {
    /// The end of this process.
    Kill,
    /// The end of the machine too; so do all transactions before it.
    PowerCut,
}

/// Why a transaction is not made.
#[derive(Debug, thiserror::Error)]
pub(super) enum WriteError {
    /// SQLite cannot write it.
    #[error(transparent)]
    Sqlite(#[from] rusqlite::Error),
    /// It would be lost. Nothing is written to this file any more.
    #[error(transparent)]
    Displaced(#[from] Displaced),
}

/// An account as the file has it.
#[derive(Debug)]
pub(super) struct StoredAccount {
    pub(super) id: i64,
    pub(super) name: String,
    pub(super) checksum: Checksum,
    pub(super) account: Account,
}

/// What changed in one account.
pub(super) struct AccountChanges {
    pub(super) id: i64,
    pub(super) changes: Changes,
    /// Of the account once it has changed.
    pub(super) checksum: Checksum,
}

/// An open ledger.
#[derive(Debug)]
pub(super) struct LedgerFile {
    connection: Connection,
    path: PathBuf,
    /// What the connection is set to.
    durability: Durability,
    /// Transactions since the last one that survives a loss of power.
    n_unsynced: u32,
    /// Set for good when the file is found to be no longer in its place.
    displaced: Option<Displaced>,
    /// Dropped after the connection: closing the file would release SQLite's locks.
    hold: Hold,
}

impl LedgerFile {
    /// Opens the ledger at `path`, which is made when there is none, with every account in it.
    pub(super) fn open(path: &Path) -> Result<(Self, Vec<StoredAccount>), OpenError> {
        let mut hold = Hold::take(path)?;
        let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let refused = |error| refused(path, &error);
        let mut connection =
            Connection::open_with_flags(hold.resolved(), flags).map_err(refused)?;
        let version = prepare(&mut connection, path)?;
        let accounts = load(&connection, version, path)?;
        if version == VERSION_1 {
            upgrade(&mut connection, &accounts).map_err(refused)?;
            tracing::info!(ledger = ?path, "ledger upgraded from version 1 to version {VERSION}");
        }
        hold.note_log();
        if hold.check_in_place().is_err() {
            return Err(OpenError::InUse(path.to_owned()));
        }
        let (path, durability) = (path.to_owned(), Durability::PowerCut);
        let file = Self { connection, path, durability, n_unsynced: 0, displaced: None, hold };
        Ok((file, accounts))
    }

    /// As it was named when it was opened.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Adds an account of which nothing is spent, and gives it a number.
    pub(super) fn add_account(
        &mut self,
        name: &str,
        terms: Terms,
        checksum: Checksum,
    ) -> Result<i64, WriteError> {
        self.transaction(Durability::PowerCut, |connection| {
            insert_account(connection, name, terms, checksum)
        })
    }

    /// Writes down what changed in accounts: all of it or nothing.
    pub(super) fn write(
        &mut self,
        changed: &[AccountChanges],
        durability: Durability,
    ) -> Result<(), WriteError> {
        self.transaction(durability, |connection| {
            changed.iter().try_for_each(|AccountChanges { id, changes, checksum }| {
                write_changes(connection, *id, changes, *checksum)
            })
        })
    }

    /// Transactions that a loss of power may undo.
    #[cfg(test)]
    pub(super) const fn n_unsynced(&self) -> u32 {
        self.n_unsynced
    }

    /// SQLite's setting `synchronous`: 1 waits for the disk at checkpoints only, 2 at every transaction.
    #[cfg(test)]
    pub(super) fn synchronous(&self) -> u32 {
        let read = |row: &rusqlite::Row<'_>| row.get(0);
        self.connection.pragma_query_value(None, "synchronous", read).expect("a setting")
    }

    /// Lets the file have no more than `n_pages` pages, or those that it has.
    #[cfg(test)]
    pub(super) fn limit_pages(&self, n_pages: u32) {
        let check = |_: &rusqlite::Row<'_>| Ok(());
        self.connection
            .pragma_update_and_check(None, "max_page_count", n_pages, check)
            .expect("a limit");
    }

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
        let transaction =
            self.connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
        // What is dropped without having been committed is undone.
        let answer = write(&transaction)?;
        transaction.commit()?;
        self.n_unsynced = match durability {
            Durability::Kill => self.n_unsynced + 1,
            Durability::PowerCut => 0,
        };
        // Only now is it certain that the transaction is in a file that will be found again.
        self.hold.check_in_place().map_err(|displaced| self.give_up(displaced))?;
        Ok(answer)
    }

    /// Writes nothing from now on: it would be lost, or would not fit what is in the file when it is put back.
    fn give_up(&mut self, displaced: Displaced) -> Displaced {
        tracing::error!(ledger = ?self.path, "nothing more is charged: {displaced}");
        self.displaced = Some(displaced);
        if displaced == Displaced::Log {
            self.rescue_log();
        }
        displaced
    }

    /// Copies what only the lost log has into the database.
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

/// Checks that the file is a sound ledger, or makes it one when it is empty, and gives its version.
fn prepare(connection: &mut Connection, path: &Path) -> Result<i64, OpenError> {
    let refused = |error| refused(path, &error);
    connection.busy_timeout(BUSY_TIMEOUT).map_err(refused)?;
    let header = |name| connection.pragma_query_value(None, name, |row| row.get::<_, i64>(0));
    let application_id = header("application_id").map_err(refused)?;
    let version = header("user_version").map_err(refused)?;
    let n_tables = "SELECT count(*) FROM sqlite_schema";
    let n_tables: i64 = connection.query_row(n_tables, (), |row| row.get(0)).map_err(refused)?;
    let path_buf = || path.to_owned();
    match (application_id, version, n_tables) {
        (0, 0, 0) => {}
        (APPLICATION_ID, VERSION_1 | VERSION, _) => check(connection, path)?,
        (APPLICATION_ID, found, _) => {
            return Err(OpenError::Version { path: path_buf(), found, newest: VERSION });
        }
        _ => {
            let found = "an SQLite database of another program";
            return Err(OpenError::NotALedger { path: path_buf(), found });
        }
    }
    // The file itself is open for writing by now.
    if connection.is_readonly("main").map_err(refused)? {
        let what = "its header says that it cannot be written".to_owned();
        return Err(OpenError::Damaged { path: path_buf(), what });
    }
    let mode = connection
        .pragma_update_and_check(None, "journal_mode", "WAL", |row| row.get::<_, String>(0));
    if mode.map_err(refused)? != "wal" {
        let source = std::io::Error::other("its file system cannot share memory");
        return Err(OpenError::Io { path: path_buf(), source });
    }
    connection.pragma_update(None, "synchronous", "FULL").map_err(refused)?;
    if n_tables == 0 {
        create(connection).map_err(refused)?;
        return Ok(VERSION);
    }
    Ok(version)
}

/// Lets SQLite check whether every page is where it belongs and every account is in the index of names.
fn check(connection: &Connection, path: &Path) -> Result<(), OpenError> {
    let verdict =
        connection.pragma_query_value(None, "integrity_check", |row| row.get::<_, String>(0));
    match verdict {
        Ok(verdict) if verdict == "ok" => Ok(()),
        Ok(what) => Err(OpenError::Damaged { path: path.to_owned(), what: printable(&what) }),
        Err(error) => Err(refused(path, &error)),
    }
}

fn create(connection: &mut Connection) -> rusqlite::Result<()> {
    let transaction = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
    transaction.execute_batch(SCHEMA)?;
    transaction.pragma_update(None, "application_id", APPLICATION_ID)?;
    transaction.pragma_update(None, "user_version", VERSION)?;
    transaction.commit()
}

/// Gives a ledger of version 1 the checksums that it lacks, in one transaction.
fn upgrade(connection: &mut Connection, accounts: &[StoredAccount]) -> rusqlite::Result<()> {
    let transaction = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
    transaction.execute_batch(UPGRADE_FROM_1)?;
    for account in accounts {
        write_checksum(&transaction, account.id, account.checksum)?;
    }
    transaction.pragma_update(None, "user_version", VERSION)?;
    transaction.commit()
}

/// Every account, checked against its checksum where the version of the file has them.
fn load(
    connection: &Connection,
    version: i64,
    path: &Path,
) -> Result<Vec<StoredAccount>, OpenError> {
    let refused = |error| refused(path, &error);
    let damaged = |what: String| OpenError::Damaged { path: path.to_owned(), what };
    let mut leases = by_account(read_leases(connection).map_err(refused)?);
    let mut words = by_account(read_words(connection).map_err(refused)?);
    let has_checksums = version != VERSION_1;
    let mut accounts = Vec::new();
    for row in read_accounts(connection, has_checksums).map_err(refused)? {
        let leases = leases.remove(&row.id).unwrap_or_default();
        let words = words.remove(&row.id).unwrap_or_default();
        let stored = row.checksum;
        let account = restore(row, &leases, &words).map_err(damaged)?;
        if has_checksums && stored != Some(account.checksum) {
            let what = "its rows do not match its checksum";
            return Err(damaged(format!("account {:?}: {what}", account.name)));
        }
        accounts.push(account);
    }
    match leases.keys().chain(words.keys()).next() {
        Some(id) => Err(damaged(format!("there is no account {id}"))),
        None => Ok(accounts),
    }
}

/// The account of these rows, or what is wrong with them.
fn restore(
    row: AccountRow,
    leases: &[LeaseRecord],
    words: &[(WordIndex, Word)],
) -> Result<StoredAccount, String> {
    let AccountRow { id, name, terms, spent, .. } = row;
    let account = Account::restore(terms, leases, words.iter().copied())
        .map_err(|unsound| format!("account {name:?}: {unsound}"))?;
    if account.spent() != spent {
        let counted = account.spent();
        return Err(format!("account {name:?} has spent {spent}, its verdicts say {counted}"));
    }
    let leases = leases.iter().map(Checksum::of_lease);
    let words = words.iter().map(|(index, word)| Checksum::of_word(*index, *word));
    let checksum = Checksum::of_terms(&name, terms) + leases.chain(words).sum();
    Ok(StoredAccount { id, name, checksum, account })
}

fn by_account<T>(rows: Vec<(i64, T)>) -> BTreeMap<i64, Vec<T>> {
    let mut by_account: BTreeMap<i64, Vec<T>> = BTreeMap::new();
    for (id, row) in rows {
        by_account.entry(id).or_default().push(row);
    }
    by_account
}

/// What an error of SQLite's means for somebody who opens a ledger.
fn refused(path: &Path, error: &rusqlite::Error) -> OpenError {
    use ErrorCode as E;
    let (path, what) = (path.to_owned(), printable(&error.to_string()));
    match error.sqlite_error_code() {
        Some(E::NotADatabase) => {
            OpenError::NotALedger { path, found: "something that is not an SQLite database" }
        }
        Some(
            E::PermissionDenied
            | E::OperationAborted
            | E::DatabaseBusy
            | E::DatabaseLocked
            | E::OutOfMemory
            | E::ReadOnly
            | E::OperationInterrupted
            | E::SystemIoFailure
            | E::DiskFull
            | E::CannotOpen
            | E::FileLockingProtocolFailed
            | E::NoLargeFileSupport,
        ) => OpenError::Io { path, source: std::io::Error::other(what) },
        // The tables are not those of a ledger, or hold what no ledger writes.
        _ => OpenError::Damaged { path, what },
    }
}
