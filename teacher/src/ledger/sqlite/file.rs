//! The file itself: who owns it, what stands in it, how it is written.

use std::collections::BTreeMap;
use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::time::Duration;

use rusqlite::{Connection, ErrorCode, OpenFlags, Row, TransactionBehavior, params};

use crate::budget::{Account, Changes, LeaseRecord, Terms, Word, WordIndex};
use crate::ledger::OpenError;

/// Transactions that a loss of power may undo before one is waited for.
pub(super) const MAX_UNSYNCED: u32 = 256;

/// What stands in the file's header: "tndm" in ASCII.
const APPLICATION_ID: i64 = 0x746E_646D;
const VERSION: i64 = 1;
const SCHEMA: &str = include_str!("schema.sql");
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

/// An open ledger.
#[derive(Debug)]
pub(super) struct LedgerFile {
    connection: Connection,
    path: PathBuf,
    /// What the connection is set to.
    durability: Durability,
    /// Transactions since the last one that survives a loss of power.
    n_unsynced: u32,
    /// Held as long as the ledger is open; the system frees it when the process ends.
    _lock: File,
}

impl LedgerFile {
    pub(super) fn open(path: &Path) -> Result<Self, OpenError> {
        let failed = |source| OpenError::Io { path: path.to_owned(), source };
        // A name such as ":memory:" is a file too, and a link leads to the lock beside the file itself.
        let file = std::path::absolute(path).map_err(failed)?;
        let file = std::fs::canonicalize(&file).unwrap_or(file);
        if file.is_dir() {
            return Err(failed(std::io::ErrorKind::IsADirectory.into()));
        }
        let lock = lock(&file, path)?;
        let flags = OpenFlags::SQLITE_OPEN_READ_WRITE
            | OpenFlags::SQLITE_OPEN_CREATE
            | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let mut connection =
            Connection::open_with_flags(&file, flags).map_err(|error| refused(path, error))?;
        prepare(&mut connection, path)?;
        let (path, durability) = (path.to_owned(), Durability::PowerCut);
        Ok(Self { connection, path, durability, n_unsynced: 0, _lock: lock })
    }

    /// As it was named when it was opened.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Every account with its name and number.
    pub(super) fn load(&mut self) -> Result<Vec<(String, i64, Account)>, OpenError> {
        let refused = |error| refused(&self.path, error);
        let damaged = |what: String| OpenError::Damaged { path: self.path.clone(), what };
        let mut leases = by_account(read_leases(&self.connection).map_err(refused)?);
        let mut words = by_account(read_words(&self.connection).map_err(refused)?);
        let mut accounts = Vec::new();
        for (id, name, terms, spent) in read_accounts(&self.connection).map_err(refused)? {
            let leases = leases.remove(&id).unwrap_or_default();
            let words = words.remove(&id).unwrap_or_default();
            let account = Account::restore(terms, &leases, words)
                .map_err(|unsound| damaged(format!("account {name:?}: {unsound}")))?;
            if account.spent() != spent {
                let counted = account.spent();
                let what =
                    format!("account {name:?} has spent {spent}, its verdicts say {counted}");
                return Err(damaged(what));
            }
            accounts.push((name, id, account));
        }
        match leases.keys().chain(words.keys()).next() {
            Some(id) => Err(damaged(format!("there is no account {id}"))),
            None => Ok(accounts),
        }
    }

    /// Adds an account of which nothing is spent, and gives it a number.
    pub(super) fn add_account(&mut self, name: &str, terms: Terms) -> rusqlite::Result<i64> {
        self.transaction(Durability::PowerCut, |connection| {
            let sql = "INSERT INTO accounts (name, budget, strategy, spent) VALUES (?, ?, ?, 0)";
            let params = params![name, terms.budget, terms.strategy.to_string()];
            connection.prepare_cached(sql)?.insert(params)
        })
    }

    /// Writes down what changed in accounts, by their numbers: all of it or nothing.
    pub(super) fn write(
        &mut self,
        changes: &[(i64, Changes)],
        durability: Durability,
    ) -> rusqlite::Result<()> {
        self.transaction(durability, |connection| {
            changes.iter().try_for_each(|(id, changes)| write(connection, *id, changes))
        })
    }

    /// Transactions that a loss of power may undo.
    #[cfg(test)]
    pub(super) const fn n_unsynced(&self) -> u32 {
        self.n_unsynced
    }

    /// Lets the file have no more than `n_pages` pages, or those that it has.
    #[cfg(test)]
    pub(super) fn limit_pages(&self, n_pages: u32) {
        let check = |_: &Row<'_>| Ok(());
        self.connection
            .pragma_update_and_check(None, "max_page_count", n_pages, check)
            .expect("a limit");
    }

    fn transaction<T>(
        &mut self,
        durability: Durability,
        write: impl FnOnce(&Connection) -> rusqlite::Result<T>,
    ) -> rusqlite::Result<T> {
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
        Ok(answer)
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

/// Takes the lock beside `file`, which was named `path`.
fn lock(file: &Path, path: &Path) -> Result<File, OpenError> {
    let mut name = file.as_os_str().to_owned();
    name.push(".lock");
    let name = PathBuf::from(name);
    let lock = File::options().create(true).truncate(false).write(true).open(&name);
    let lock = lock.map_err(|source| OpenError::Io { path: name.clone(), source })?;
    match lock.try_lock() {
        Ok(()) => Ok(lock),
        Err(TryLockError::WouldBlock) => Err(OpenError::InUse(path.to_owned())),
        Err(TryLockError::Error(source)) => Err(OpenError::Io { path: name, source }),
    }
}

/// Checks that the file is a sound ledger of this version, or makes it one when it is empty.
fn prepare(connection: &mut Connection, path: &Path) -> Result<(), OpenError> {
    let refused = |error| refused(path, error);
    connection.busy_timeout(BUSY_TIMEOUT).map_err(refused)?;
    let header = |name| connection.pragma_query_value(None, name, |row| row.get::<_, i64>(0));
    let application_id = header("application_id").map_err(refused)?;
    let version = header("user_version").map_err(refused)?;
    let n_tables = "SELECT count(*) FROM sqlite_schema";
    let n_tables: i64 = connection.query_row(n_tables, (), |row| row.get(0)).map_err(refused)?;
    let path_buf = || path.to_owned();
    match (application_id, version, n_tables) {
        (0, 0, 0) => {}
        (APPLICATION_ID, VERSION, _) => check(connection, path)?,
        (APPLICATION_ID, found, _) => {
            return Err(OpenError::Version { path: path_buf(), found, expected: VERSION });
        }
        _ => {
            let found = "an SQLite database of another program";
            return Err(OpenError::NotALedger { path: path_buf(), found });
        }
    }
    if connection.is_readonly("main").map_err(refused)? {
        let source = std::io::ErrorKind::PermissionDenied.into();
        return Err(OpenError::Io { path: path_buf(), source });
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
    }
    Ok(())
}

/// Lets SQLite look whether every page is where it belongs.
fn check(connection: &Connection, path: &Path) -> Result<(), OpenError> {
    let verdict = connection.pragma_query_value(None, "quick_check", |row| row.get::<_, String>(0));
    match verdict {
        Ok(verdict) if verdict == "ok" => Ok(()),
        Ok(what) => {
            Err(OpenError::Damaged { path: path.to_owned(), what: what.replace('\n', " ") })
        }
        Err(error) => Err(refused(path, error)),
    }
}

fn create(connection: &mut Connection) -> rusqlite::Result<()> {
    let transaction = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
    transaction.execute_batch(SCHEMA)?;
    transaction.pragma_update(None, "application_id", APPLICATION_ID)?;
    transaction.pragma_update(None, "user_version", VERSION)?;
    transaction.commit()
}

/// What an error of SQLite's means for somebody who opens a ledger.
fn refused(path: &Path, error: rusqlite::Error) -> OpenError {
    let path = path.to_owned();
    match error.sqlite_error_code() {
        Some(ErrorCode::NotADatabase) => {
            OpenError::NotALedger { path, found: "something that is not an SQLite database" }
        }
        // The tables are not those of a ledger, or hold what no ledger writes.
        Some(ErrorCode::DatabaseCorrupt | ErrorCode::TypeMismatch | ErrorCode::Unknown) | None => {
            OpenError::Damaged { path, what: error.to_string() }
        }
        Some(_) => OpenError::Io { path, source: std::io::Error::other(error) },
    }
}

fn read_accounts(connection: &Connection) -> rusqlite::Result<Vec<(i64, String, Terms, u64)>> {
    let sql = "SELECT id, name, budget, strategy, spent FROM accounts";
    let read = |row: &Row<'_>| {
        let strategy = row.get_ref(3)?.as_str()?.parse();
        let strategy = strategy.map_err(|error| unreadable(3, error))?;
        let terms = Terms { budget: row.get(2)?, strategy };
        Ok((row.get(0)?, row.get(1)?, terms, row.get(4)?))
    };
    connection.prepare(sql)?.query_map((), read)?.collect()
}

fn read_leases(connection: &Connection) -> rusqlite::Result<Vec<(i64, LeaseRecord)>> {
    let sql = "SELECT account, episode, units, early_units, charged_before, settled FROM leases";
    let read = |row: &Row<'_>| {
        let lease = LeaseRecord {
            episode: row.get::<_, i64>(1)?.cast_unsigned(),
            units: row.get(2)?,
            early_units: row.get(3)?,
            charged_before: row.get(4)?,
            settled: row.get(5)?,
        };
        Ok((row.get(0)?, lease))
    };
    connection.prepare(sql)?.query_map((), read)?.collect()
}

fn read_words(connection: &Connection) -> rusqlite::Result<Vec<(i64, (WordIndex, Word))>> {
    let sql = "SELECT account, episode, word, asked, charged, first_half FROM verdicts";
    let read = |row: &Row<'_>| {
        let bits = |idx| row.get::<_, i64>(idx).map(i64::cast_unsigned);
        let word = Word { asked: bits(3)?, charged: bits(4)?, first_half: bits(5)? };
        Ok((row.get(0)?, ((bits(1)?, row.get(2)?), word)))
    };
    connection.prepare(sql)?.query_map((), read)?.collect()
}

fn unreadable(
    column: usize,
    error: impl std::error::Error + Send + Sync + 'static,
) -> rusqlite::Error {
    rusqlite::Error::FromSqlConversionFailure(column, rusqlite::types::Type::Text, Box::new(error))
}

fn by_account<T>(rows: Vec<(i64, T)>) -> BTreeMap<i64, Vec<T>> {
    let mut by_account: BTreeMap<i64, Vec<T>> = BTreeMap::new();
    for (id, row) in rows {
        by_account.entry(id).or_default().push(row);
    }
    by_account
}

fn write(connection: &Connection, id: i64, changes: &Changes) -> rusqlite::Result<()> {
    if let Some(spent) = changes.spent {
        let sql = "UPDATE accounts SET spent = ?2 WHERE id = ?1";
        connection.prepare_cached(sql)?.execute(params![id, spent])?;
    }
    if !changes.leases.is_empty() {
        let sql = "INSERT INTO leases VALUES (?, ?, ?, ?, ?, ?)
            ON CONFLICT DO UPDATE SET settled = excluded.settled";
        let mut statement = connection.prepare_cached(sql)?;
        for lease in &changes.leases {
            let LeaseRecord { units, early_units, charged_before, settled, .. } = *lease;
            let episode = lease.episode.cast_signed();
            statement.execute(params![id, episode, units, early_units, charged_before, settled])?;
        }
    }
    if !changes.words.is_empty() {
        let sql = "INSERT INTO verdicts VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT DO UPDATE SET
            asked = excluded.asked, charged = excluded.charged, first_half = excluded.first_half";
        let mut statement = connection.prepare_cached(sql)?;
        for ((episode, word_idx), word) in &changes.words {
            let [episode, asked, charged, first_half] =
                [*episode, word.asked, word.charged, word.first_half].map(u64::cast_signed);
            statement.execute(params![id, episode, word_idx, asked, charged, first_half])?;
        }
    }
    Ok(())
}
