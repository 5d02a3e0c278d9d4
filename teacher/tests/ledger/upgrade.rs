//! Ledger files of earlier versions.

use std::fs;
use std::path::{Path, PathBuf};

use rusqlite::Connection;
use tandem_teacher::Strategy;
use tandem_teacher::budget::{AccountTerms, Balance, Charge, Lease};
use tandem_teacher::ledger::{ChargeRequest, Ledger, MemoryLedger, OpenError, SqliteLedger};
use tempfile::TempDir;

use crate::ledger_tests::fixture::{BOTH, NEITHER, Verdict, charge, request, terms};

const LEASED: &str = "leased";
const FREE: &str = "free \"quoted\"\n\u{1b}[31m";

const FREE_TERMS: AccountTerms =
    AccountTerms { budget: 12, strategy: Strategy::MistakeQ { threshold: 0.05 } };

fn free_request(charges: &[Charge]) -> ChargeRequest {
    ChargeRequest { strategy: FREE_TERMS.strategy, ..request(FREE, charges) }
}

/// Repeats the operations that created `tests/data/ledger-v1.sqlite`: leases that are open, settled and exhausted,
/// episodes without a lease, numbers beyond 2^63, steps beyond the first word, and a name with quotes and control
/// characters.
fn play(ledger: &mut dyn Ledger) {
    ledger.open(LEASED, terms(100)).expect("an account");
    ledger.open(FREE, FREE_TERMS).expect("an account");
    ledger.open_leases(LEASED, &[0, 1, 2, u64::MAX], 15).expect("leases");
    for step in 0..20 {
        let wanted = if step % 3 == 0 { NEITHER } else { BOTH };
        let charges =
            [charge(0, step, BOTH), charge(1, step, wanted), charge(u64::MAX, 49 - step, wanted)];
        let free = [charge(7, 5 * step, wanted), charge(1 << 63, step, BOTH)];
        let outcomes = ledger.charge(&[request(LEASED, &charges), free_request(&free)]);
        assert!(outcomes.iter().all(Result::is_ok));
    }
    ledger.settle(LEASED, &[0, u64::MAX]).expect("settled");
}

/// Repeats the operations that only its write-ahead log contains.
fn play_on(ledger: &mut dyn Ledger) {
    ledger.open_leases(LEASED, &[3], 15).expect("leases");
    ledger.charge(&[request(LEASED, &[charge(3, 1, BOTH)])]).remove(0).expect("paid");
}

/// Returns the answers to requests for all steps and leases of [`play`], and for new ones.
fn answers_of(ledger: &mut dyn Ledger) -> (Vec<Verdict>, Vec<Lease>, [Balance; 2]) {
    let steps = |episodes: &[u64]| {
        let steps = episodes.iter().flat_map(|episode| (0..50).map(|step| (*episode, step)));
        steps.map(|(episode, step)| charge(episode, step, BOTH)).collect::<Vec<_>>()
    };
    let requests =
        [request(LEASED, &steps(&[0, 1, 2, 3, u64::MAX])), free_request(&steps(&[7, 1 << 63]))];
    let results = ledger.charge(&requests).into_iter().map(|outcome| outcome.expect("paid"));
    let verdicts = results.flat_map(|result| result.verdicts).collect();
    let leases = ledger.open_leases(LEASED, &[0, 1, 2, 3, 4, u64::MAX], 15).expect("leases").0;
    let balances = [LEASED, FREE].map(|name| ledger.balance(name).expect("an account"));
    (verdicts, leases, balances)
}

/// Copies the ledger and the log that a killed teacher of version 1 left.
fn copy() -> (TempDir, PathBuf) {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("teacher/tests/data");
    let directory = tempfile::tempdir().expect("a directory");
    for name in ["ledger-v1.sqlite", "ledger-v1.sqlite-wal"] {
        fs::copy(data.join(name), directory.path().join(name)).expect("copied");
    }
    let path = directory.path().join("ledger-v1.sqlite");
    (directory, path)
}

fn version(path: &Path) -> i64 {
    let connection = Connection::open(path).expect("a database");
    connection.pragma_query_value(None, "user_version", |row| row.get(0)).expect("a version")
}

#[test]
fn a_ledger_of_version_1_is_upgraded_and_keeps_its_accounts() {
    let (_directory, path) = copy();
    let mut model = MemoryLedger::default();
    play(&mut model);
    play_on(&mut model);
    let mut ledger = SqliteLedger::open(&path).expect("a ledger");
    let expected = [LEASED, FREE].map(|name| model.balance(name).expect("an account"));
    let balances = [LEASED, FREE].map(|name| ledger.balance(name).expect("an account"));
    assert_eq!(balances, expected);
    let answers = answers_of(&mut ledger);
    assert_eq!(answers, answers_of(&mut model));
    drop(ledger);
    assert_eq!(version(&path), 2);
    let mut again = SqliteLedger::open(&path).expect("a ledger");
    assert_eq!(answers_of(&mut again), answers);
}

#[test]
fn an_upgraded_ledger_opens_again_although_nothing_was_charged_to_it() {
    let (_directory, path) = copy();
    let balance = |path: &Path| SqliteLedger::open(path).expect("a ledger").balance(LEASED);
    let upgraded = balance(&path).expect("an account");
    assert_eq!(version(&path), 2);
    assert_eq!(balance(&path).expect("an account"), upgraded);
}

#[test]
fn a_damaged_ledger_of_version_1_is_refused_and_not_upgraded() {
    let (_directory, path) = copy();
    let other = Connection::open(&path).expect("a database");
    other.execute_batch("UPDATE verdicts SET charged = 0 WHERE episode = 1").expect("a change");
    drop(other);
    let before = fs::read(&path).expect("bytes");
    let error = SqliteLedger::open(&path).expect_err("refused");
    assert!(matches!(error, OpenError::Damaged { .. }), "{error}");
    assert_eq!(fs::read(&path).expect("bytes"), before);
    assert_eq!(version(&path), 1);
}
