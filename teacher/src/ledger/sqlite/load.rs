//! Opening a database: the checks of its header, pages, rows and checksums, and upgrades of earlier versions.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use rusqlite::{Connection, ErrorCode, TransactionBehavior};

use super::StoredAccount;
use super::checksum::Checksum;
use super::rows::{AccountRow, read_accounts, read_leases, read_verdicts, write_checksum};
use crate::budget::{Account, LeaseRecord, VerdictBits, VerdictIndex};
use crate::ledger::{OpenError, printable};

/// The application id in the file's header: "tndm" in ASCII.
const APPLICATION_ID: i64 = 0x746E_646D;
/// The version of new ledgers.
const VERSION: i64 = 2;
/// The version without checksums.
const VERSION_1: i64 = 1;
const SCHEMA: &str = include_str!("schema.sql");
const UPGRADE_FROM_1: &str = "ALTER TABLE accounts ADD COLUMN checksum INTEGER NOT NULL DEFAULT 0";
/// The time that a transaction waits for another program that has locked the file.
const BUSY_TIMEOUT: Duration = Duration::from_secs(2);

/// Checks that the file is an undamaged database of a ledger, creates the tables if it is empty, and returns its
/// version.
pub(super) fn prepare(connection: &mut Connection, path: &Path) -> Result<i64, OpenError> {
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
    // The file lock has opened the file for writing, so only its header can make it read-only.
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

/// Runs SQLite's check of all pages and indices.
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

/// Upgrades a ledger of version 1 in one transaction: adds the checksums of its accounts.
pub(super) fn upgrade(
    connection: &mut Connection,
    version: i64,
    accounts: &BTreeMap<String, StoredAccount>,
    path: &Path,
) -> Result<(), OpenError> {
    if version != VERSION_1 {
        return Ok(());
    }
    let mut upgrade = || {
        let transaction = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
        transaction.execute_batch(UPGRADE_FROM_1)?;
        for account in accounts.values() {
            write_checksum(&transaction, account.id, account.checksum)?;
        }
        transaction.pragma_update(None, "user_version", VERSION)?;
        transaction.commit()
    };
    upgrade().map_err(|error| refused(path, &error))?;
    tracing::info!(ledger = ?path, "ledger upgraded from version 1 to version {VERSION}");
    Ok(())
}

/// Loads all accounts by name, and checks them against their checksums unless the version has none.
pub(super) fn load(
    connection: &Connection,
    version: i64,
    path: &Path,
) -> Result<BTreeMap<String, StoredAccount>, OpenError> {
    let refused = |error| refused(path, &error);
    let damaged = |what: String| OpenError::Damaged { path: path.to_owned(), what };
    let mut leases = by_account(read_leases(connection).map_err(refused)?);
    let mut verdicts = by_account(read_verdicts(connection).map_err(refused)?);
    let has_checksums = version != VERSION_1;
    let mut accounts = BTreeMap::new();
    for row in read_accounts(connection, has_checksums).map_err(refused)? {
        let leases = leases.remove(&row.id).unwrap_or_default();
        let verdicts = verdicts.remove(&row.id).unwrap_or_default();
        let account = restore(&row, &leases, &verdicts);
        let account = account.map_err(|what| damaged(format!("account {:?}{what}", row.name)))?;
        accounts.insert(row.name, account);
    }
    match leases.keys().chain(verdicts.keys()).next() {
        Some(id) => Err(damaged(format!("there is no account {id}"))),
        None => Ok(accounts),
    }
}

/// Restores the account of these rows, or returns the rest of a sentence that begins with the account.
fn restore(
    row: &AccountRow,
    leases: &[(u64, LeaseRecord)],
    verdicts: &[(VerdictIndex, VerdictBits)],
) -> Result<StoredAccount, String> {
    let account = Account::restore(row.terms, leases, verdicts);
    let account = account.map_err(|error| format!(": {error}"))?;
    let (stored, spent) = (row.spent, account.balance().spent);
    if spent != stored {
        return Err(format!(" has spent {stored}, its verdicts say {spent}"));
    }
    let leases = leases.iter().map(|(episode, lease)| Checksum::of_lease(*episode, lease));
    let verdicts = verdicts.iter().map(|(index, bits)| Checksum::of_verdicts(*index, bits));
    let checksum = Checksum::of_terms(&row.name, row.terms) + leases.chain(verdicts).sum();
    if row.checksum.is_some_and(|stored| stored != checksum) {
        return Err(": its rows do not match its checksum".to_owned());
    }
    Ok(StoredAccount { id: row.id, checksum, account })
}

fn by_account<T>(rows: Vec<(i64, T)>) -> BTreeMap<i64, Vec<T>> {
    let mut by_account: BTreeMap<i64, Vec<T>> = BTreeMap::new();
    for (id, row) in rows {
        by_account.entry(id).or_default().push(row);
    }
    by_account
}

/// Maps an error of SQLite to the reason why the ledger cannot be opened.
pub(super) fn refused(path: &Path, error: &rusqlite::Error) -> OpenError {
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
        // The tables are not those of a ledger, or have values that no ledger writes.
        _ => OpenError::Damaged { path, what },
    }
}
