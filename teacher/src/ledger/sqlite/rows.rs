//! The rows of the tables: how they are read and written.

use rusqlite::{Connection, Row, params};

use crate::budget::{Changes, Checksum, LeaseRecord, Terms, Word, WordIndex};

/// A row of the table of accounts.
pub(super) struct AccountRow {
    pub(super) id: i64,
    pub(super) name: String,
    pub(super) terms: Terms,
    pub(super) spent: u64,
    pub(super) checksum: Option<Checksum>,
}

pub(super) fn read_accounts(
    connection: &Connection,
    has_checksums: bool,
) -> rusqlite::Result<Vec<AccountRow>> {
    let checksum = if has_checksums { "checksum" } else { "NULL" };
    let sql = format!("SELECT id, name, budget, strategy, spent, {checksum} FROM accounts");
    let read = |row: &Row<'_>| {
        let strategy = row.get_ref(3)?.as_str()?.parse();
        let strategy = strategy.map_err(|error| unreadable(3, error))?;
        let terms = Terms { budget: row.get(2)?, strategy };
        let checksum = row.get::<_, Option<i64>>(5)?.map(Checksum::from_bits);
        Ok(AccountRow { id: row.get(0)?, name: row.get(1)?, terms, spent: row.get(4)?, checksum })
    };
    connection.prepare(&sql)?.query_map((), read)?.collect()
}

pub(super) fn read_leases(connection: &Connection) -> rusqlite::Result<Vec<(i64, LeaseRecord)>> {
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

pub(super) fn read_words(
    connection: &Connection,
) -> rusqlite::Result<Vec<(i64, (WordIndex, Word))>> {
    let sql = "SELECT account, episode, word, asked, charged, first_half FROM verdicts";
    let read = |row: &Row<'_>| {
        let bits = |idx| row.get::<_, i64>(idx).map(i64::cast_unsigned);
        let word = Word { asked: bits(3)?, charged: bits(4)?, first_half: bits(5)? };
        Ok((row.get(0)?, ((bits(1)?, row.get(2)?), word)))
    };
    connection.prepare(sql)?.query_map((), read)?.collect()
}

/// Adds an account of which nothing is spent, and gives its number.
pub(super) fn insert_account(
    connection: &Connection,
    name: &str,
    terms: Terms,
    checksum: Checksum,
) -> rusqlite::Result<i64> {
    let sql =
        "INSERT INTO accounts (name, budget, strategy, spent, checksum) VALUES (?, ?, ?, 0, ?)";
    let strategy = terms.strategy.to_string();
    let params = params![name, terms.budget, strategy, checksum.to_bits()];
    connection.prepare_cached(sql)?.insert(params)
}

/// Writes the checksum of account `id` alone.
pub(super) fn write_checksum(
    connection: &Connection,
    id: i64,
    checksum: Checksum,
) -> rusqlite::Result<()> {
    let sql = "UPDATE accounts SET checksum = ?2 WHERE id = ?1";
    connection.prepare_cached(sql)?.execute(params![id, checksum.to_bits()])?;
    Ok(())
}

/// Writes what has changed in account `id`, which then has `checksum`.
pub(super) fn write_changes(
    connection: &Connection,
    id: i64,
    changes: &Changes,
    checksum: Checksum,
) -> rusqlite::Result<()> {
    let sql = "UPDATE accounts SET spent = ?2, checksum = ?3 WHERE id = ?1";
    connection.prepare_cached(sql)?.execute(params![id, changes.spent, checksum.to_bits()])?;
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

fn unreadable(
    column: usize,
    error: impl std::error::Error + Send + Sync + 'static,
) -> rusqlite::Error {
    rusqlite::Error::FromSqlConversionFailure(column, rusqlite::types::Type::Text, Box::new(error))
}
