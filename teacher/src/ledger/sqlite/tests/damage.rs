//! Flipped bits: a damaged file is refused or has exactly the same accounts.

use std::fs;
use std::path::Path;

use rusqlite::Connection;

use super::*;

/// The page size: small, so that each table of a small file has several pages.
const PAGE_BYTES: usize = 512;

/// Returns the bytes of a closed ledger with three accounts.
fn small_ledger(path: &Path) -> Vec<u8> {
    let mut ledger = SqliteLedger::open(path).unwrap();
    for (name, budget) in [("run", 100), ("walk", 1_000_000), ("rest", 7)] {
        ledger.open(name, AccountTerms { budget, ..TERMS }).unwrap();
    }
    let episodes: Vec<u64> = (0..24).collect();
    ledger.open_leases("run", &episodes, 3).unwrap();
    for episode in episodes {
        ledger.charge(&[request("run", episode, 0..5), request("walk", episode, 60..70)]);
    }
    ledger.settle("run", &[0, 1, 2, 3]).unwrap();
    drop(ledger);
    let connection = Connection::open(path).unwrap();
    let sql = format!(
        "PRAGMA journal_mode = DELETE; PRAGMA page_size = {PAGE_BYTES}; VACUUM;
        PRAGMA journal_mode = WAL;"
    );
    connection.execute_batch(&sql).unwrap();
    drop(connection);
    fs::read(path).unwrap()
}

/// The outcome of opening a file with a flipped bit.
#[derive(Debug, PartialEq, Eq)]
enum Outcome {
    Refused,
    /// It opens with the same accounts.
    Unharmed,
    Wrong(String),
}

fn start(path: &Path, bytes: &[u8], expected: &str) -> Outcome {
    for suffix in ["", "-wal", "-shm"] {
        drop(fs::remove_file(format!("{}{suffix}", path.display())));
    }
    fs::write(path, bytes).unwrap();
    let error = match SqliteLedger::open(path) {
        Ok(ledger) if accounts(&ledger) == expected => return Outcome::Unharmed,
        Ok(ledger) => return Outcome::Wrong(accounts(&ledger)),
        Err(error) => error,
    };
    let is_one_line = !error.to_string().contains(char::is_control);
    match error {
        OpenError::Damaged { .. } | OpenError::NotALedger { .. } | OpenError::Version { .. }
            if is_one_line =>
        {
            Outcome::Refused
        }
        _ => Outcome::Wrong(format!("{error:?}")),
    }
}

#[test]
fn a_flipped_bit_is_refused_or_changes_nothing() {
    check_flips(7);
}

#[test]
#[ignore = "takes minutes"]
fn every_flipped_bit_is_refused_or_changes_nothing() {
    check_flips(1);
}

/// Flips every `stride`th bit in turn.
fn check_flips(stride: usize) {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("ledger.sqlite");
    let mut bytes = small_ledger(&path);
    let expected = accounts(&SqliteLedger::open(&path).unwrap());
    let (mut n_unharmed, mut n_refused, mut wrong) = (0, 0, Vec::new());
    for place in (0..bytes.len() * 8).step_by(stride) {
        let (byte, bit) = (place / 8, place % 8);
        bytes[byte] ^= 1 << bit;
        match start(&path, &bytes, &expected) {
            Outcome::Refused => n_refused += 1,
            Outcome::Unharmed => n_unharmed += 1,
            Outcome::Wrong(what) => {
                let (page, byte) = (byte / PAGE_BYTES, byte % PAGE_BYTES);
                wrong.push(format!("bit {bit} of byte {byte} of page {page}: {what}"));
            }
        }
        bytes[byte] ^= 1 << bit;
    }
    assert!(wrong.is_empty(), "{} flips: {:#?}", wrong.len(), &wrong[..wrong.len().min(20)]);
    println!("{n_unharmed} flips harmless, {n_refused} refused");
    assert!(n_refused > n_unharmed / 10, "{n_unharmed} flips harmless, {n_refused} refused");
}
