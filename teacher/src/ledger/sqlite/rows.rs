//! Reads and writes the rows of the tables.

use rusqlite::{Connection, Row, params};

use super::AccountUpdate;
use super::checksum::Checksum;
use crate::budget::{AccountTerms, LeaseRecord, VerdictBits, VerdictIndex};

/// A row of the table `accounts`.
pub(super) struct AccountRow {
    pub(super) id: i64,
    pub(super) name: String,
    pub(super) terms: AccountTerms,
    pub(super) spent: u64,
    /// `None` in a ledger of version 1.
    pub(super) checksum: Option<Checksum>,
}

/// Reads all accounts.
pub(super) fn read_accounts(
    connection: &Connection,
    has_checksums: bool,
) -> rusqlite::Result<Vec<AccountRow>> {
    let checksum = if has_checksums { "checksum" } else { "NULL" };
    let sql = format!("SELECT id, name, budget, strategy, spent, {checksum} FROM accounts");
    let read = |row: &Row<'_>| {
        let strategy = row.get_ref(3)?.as_str()?.parse();
        let strategy = strategy.map_err(|error| unreadable(3, error))?;
        let terms = AccountTerms { budget: row.get(2)?, strategy };
        let checksum = row.get::<_, Option<i64>>(5)?.map(Checksum::from_bits);
        Ok(AccountRow { id: row.get(0)?, name: row.get(1)?, terms, spent: row.get(4)?, checksum })
    };
    connection.prepare(&sql)?.query_map((), read)?.collect()
}

/// Reads all leases: the account's key, the episode and the lease.
pub(super) fn read_leases(
    connection: &Connection,
) -> rusqlite::Result<Vec<(i64, (u64, LeaseRecord))>> {
    let sql = "SELECT account, episode, units, early_units, charged_before, settled FROM leases";
    let read = |row: &Row<'_>| {
        let lease = LeaseRecord {
            units: row.get(2)?,
            early_units: row.get(3)?,
            charged_before: row.get(4)?,
            settled: row.get(5)?,
        };
        Ok((row.get(0)?, (row.get::<_, i64>(1)?.cast_unsigned(), lease)))
    };
    connection.prepare(sql)?.query_map((), read)?.collect()
}

/// Reads all verdicts: the account's key, the index and the bits.
pub(super) fn read_verdicts(
    connection: &Connection,
) -> rusqlite::Result<Vec<(i64, (VerdictIndex, VerdictBits))>> {
    let sql = "SELECT account, episode, word, asked, charged, first_half FROM verdicts";
    let read = |row: &Row<'_>| {
        let number = |idx| row.get::<_, i64>(idx).map(i64::cast_unsigned);
        let bits = VerdictBits { asked: number(3)?, charged: number(4)?, first_half: number(5)? };
        Ok((row.get(0)?, ((number(1)?, row.get(2)?), bits)))
    };
    connection.prepare(sql)?.query_map((), read)?.collect()
}

/// Inserts an account with an unspent budget, and returns its key.
pub(super) fn insert_account(
    connection: &Connection,
    name: &str,
    terms: AccountTerms,
    checksum: Checksum,
) -> rusqlite::Result<i64> {
    let sql =
        "INSERT INTO accounts (name, budget, strategy, spent, checksum) VALUES (?, ?, ?, 0, ?)";
    let strategy = terms.strategy.to_string();
    let params = params![name, terms.budget, strategy, checksum.to_bits()];
    connection.prepare_cached(sql)?.insert(params)
}

/// Writes only the checksum of account `id`.
pub(super) fn write_checksum(
    connection: &Connection,
    id: i64,
    checksum: Checksum,
) -> rusqlite::Result<()> {
    let sql = "UPDATE accounts SET checksum = ?2 WHERE id = ?1";
    connection.prepare_cached(sql)?.execute(params![id, checksum.to_bits()])?;
    Ok(())
}

/// Writes the changes to an account, its checksum and its spent units.
pub(super) fn write_update(
    connection: &Connection,
    update: &AccountUpdate<'_>,
) -> rusqlite::Result<()> {
    let AccountUpdate { id, changes, checksum, .. } = update;
    let sql = "UPDATE accounts SET spent = ?2, checksum = ?3 WHERE id = ?1";
    connection.prepare_cached(sql)?.execute(params![id, changes.spent, checksum.to_bits()])?;
    if !changes.leases.is_empty() {
        let sql = "INSERT INTO leases VALUES (?, ?, ?, ?, ?, ?)
            ON CONFLICT DO UPDATE SET settled = excluded.settled";
        let mut statement = connection.prepare_cached(sql)?;
        for (episode, lease) in &changes.leases {
            let LeaseRecord { units, early_units, charged_before, settled } = *lease;
            let episode = episode.cast_signed();
            statement.execute(params![id, episode, units, early_units, charged_before, settled])?;
        }
    }
    if !changes.verdicts.is_empty() {
        let sql = "INSERT INTO verdicts VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT DO UPDATE SET
            asked = excluded.asked, charged = excluded.charged, first_half = excluded.first_half";
        let mut statement = connection.prepare_cached(sql)?;
        for ((episode, word_idx), bits) in &changes.verdicts {
            let [episode, asked, charged, first_half] =
                [*episode, bits.asked, bits.charged, bits.first_half].map(u64::cast_signed);
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
