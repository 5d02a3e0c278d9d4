//! The lock on a ledger's file, and files that are moved away while in use.

use std::fs;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use rusqlite::Connection;
use tandem_teacher::ledger::{Ledger as _, LedgerError, OpenError, SqliteLedger};
use tempfile::TempDir;

use crate::ledger_tests::fixture::{BOTH, FIRST, charge, request, terms};
use crate::ledger_tests::servers::Log;

/// An open ledger with one unit of ten spent, by step 0 of episode 1.
fn opened() -> (TempDir, PathBuf, SqliteLedger) {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("ledger.sqlite");
    let mut ledger = SqliteLedger::open(&path).expect("a ledger");
    ledger.open("run", terms(10)).expect("an account");
    charge_step(&mut ledger, 0).expect("paid");
    (directory, path, ledger)
}

fn charge_step(ledger: &mut SqliteLedger, step: u32) -> Result<(), LedgerError> {
    let result = ledger.charge(&[request("run", &[charge(1, step, BOTH)])]).remove(0)?;
    assert_eq!(result.verdicts, [FIRST]);
    Ok(())
}

fn beside(path: &Path, suffix: &str) -> PathBuf {
    path.with_file_name(format!("ledger.sqlite{suffix}"))
}

fn check_in_use(path: &Path) {
    let error = SqliteLedger::open(path).expect_err("refused");
    assert!(matches!(error, OpenError::InUse(_)), "{error}");
    let expected = format!(
        "another teacher uses the ledger {path:?}: end that one, or give this one a ledger of its own"
    );
    assert_eq!(error.to_string(), expected);
}

/// Checks that nothing more is charged, whatever is put back, and that earlier verdicts are still returned.
fn check_refuses_charges(ledger: &mut SqliteLedger, expected: &str) {
    for step in [1, 2] {
        let error = charge_step(ledger, step).expect_err("refused");
        assert!(matches!(error, LedgerError::Unavailable { .. }), "{error}");
        assert!(error.to_string().contains(expected), "{error}");
    }
    assert!(ledger.open("walk", terms(10)).is_err());
    assert!(ledger.open_leases("run", &[2], 3).is_err());
    assert_eq!(ledger.balance("run").expect("an account").spent, 1);
    charge_step(ledger, 0).expect("known");
}

#[test]
fn a_file_has_one_owner_at_a_time_under_all_names() {
    let (directory, path, first) = opened();
    check_in_use(&path);
    let link = directory.path().join("link.sqlite");
    std::os::unix::fs::symlink(&path, &link).expect("a link");
    check_in_use(&link);
    let twin = directory.path().join("twin.sqlite");
    fs::hard_link(&path, &twin).expect("a link");
    check_in_use(&twin);
    fs::remove_file(&twin).expect("removed");
    drop(first);
    assert_eq!(SqliteLedger::open(&link).expect("free").balance("run").expect("kept").spent, 1);
}

#[test]
fn other_files_do_not_affect_the_lock() {
    let (_directory, path, first) = opened();
    for suffix in [".lock", "-shm", "-wal"] {
        drop(fs::remove_file(beside(&path, suffix)));
        check_in_use(&path);
    }
    drop(first);
    // Earlier versions locked a file of this name and left it behind.
    let lock = fs::File::create(beside(&path, ".lock")).expect("a file");
    lock.lock().expect("locked");
    SqliteLedger::open(&path).expect("free");
}

/// The system releases a process's POSIX locks, such as SQLite's, when it closes any descriptor of the file.
#[test]
fn a_refused_attempt_releases_no_locks() {
    let (directory, path, _first) = opened();
    let inode = format!(":{} ", fs::metadata(&path).expect("a file").ino());
    let locks = || {
        let locks = fs::read_to_string("/proc/locks").expect("Linux");
        locks.lines().filter(|lock| lock.contains(&inode)).count()
    };
    let before = locks();
    assert!(before >= 2, "the ledger's own lock and SQLite's");
    check_in_use(&path);
    let link = directory.path().join("link.sqlite");
    std::os::unix::fs::symlink(&path, &link).expect("a link");
    check_in_use(&link);
    assert_eq!(locks(), before);
}

#[test]
fn nothing_is_charged_to_a_file_that_was_deleted() {
    let (_directory, path, mut ledger) = opened();
    fs::remove_file(&path).expect("removed");
    check_refuses_charges(
        &mut ledger,
        "deleted, moved or replaced while in use: put it back and restart",
    );
}

#[test]
fn nothing_is_charged_to_a_file_that_was_replaced() {
    let (_directory, path, mut ledger) = opened();
    let aside = beside(&path, ".aside");
    fs::rename(&path, &aside).expect("moved");
    let mut second = SqliteLedger::open(&path).expect("a new ledger");
    second.open("run", terms(10)).expect("an account");
    check_refuses_charges(
        &mut ledger,
        "deleted, moved or replaced while in use: put it back and restart",
    );
    drop(second);
    fs::rename(&aside, &path).expect("moved back");
    check_refuses_charges(
        &mut ledger,
        "deleted, moved or replaced while in use: put it back and restart",
    );
}

#[test]
fn answered_charges_survive_the_deletion_of_the_log() {
    let (directory, path, mut ledger) = opened();
    fs::remove_file(beside(&path, "-wal")).expect("removed");
    check_refuses_charges(
        &mut ledger,
        "-wal file was deleted, moved or replaced while in use: restart",
    );
    // As after kill -9: only the database is there.
    let copy = directory.path().join("copy.sqlite");
    fs::copy(&path, &copy).expect("copied");
    let mut again = SqliteLedger::open(&copy).expect("a sound ledger");
    // The step whose answer was refused may be charged, but only once.
    assert!([1, 2].contains(&again.balance("run").expect("an account").spent));
    charge_step(&mut again, 0).expect("known");
    charge_step(&mut again, 1).expect("paid");
    assert_eq!(again.balance("run").expect("an account").spent, 2);
}

#[test]
fn a_log_that_cannot_be_copied_because_of_a_reader_is_reported() {
    for is_read in [false, true] {
        let (_directory, path, mut ledger) = opened();
        let reader = Connection::open(&path).expect("a database");
        if is_read {
            let sql = "BEGIN; SELECT spent FROM accounts";
            reader.execute_batch(sql).expect(sql);
        }
        fs::remove_file(beside(&path, "-wal")).expect("removed");
        let log = Log::default();
        log.of(|| charge_step(&mut ledger, 1)).expect_err("refused");
        let logged = log.text();
        assert!(logged.contains("nothing more is charged"), "{logged}");
        assert_eq!(logged.contains("the last charges are lost if"), is_read, "{logged}");
    }
}

#[test]
fn a_reader_does_not_disturb() {
    let (_directory, path, mut ledger) = opened();
    for step in 1..5 {
        let reader = Connection::open(&path).expect("a database");
        let sql = "SELECT spent FROM accounts";
        let spent: u32 = reader.query_row(sql, (), |row| row.get(0)).expect(sql);
        assert_eq!(spent, step);
        drop(reader);
        charge_step(&mut ledger, step).expect("paid");
    }
}
