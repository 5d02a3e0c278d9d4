//! The end of the process at any moment: every answered operation survives, and nothing is charged twice.

use std::fs;
use std::path::Path;

use tandem_teacher::budget::{Charge, Lease};
use tandem_teacher::ledger::{Ledger as _, SqliteLedger};

use crate::ledger_tests::fixture::{Verdict, charge, inverted, request, terms};

const NAME: &str = "run";
const BUDGET: u64 = 150;

/// The answers that a client has received, and the files after the last of them.
#[derive(Default, Clone)]
struct Snapshot {
    steps: Vec<(Charge, Verdict)>,
    leases: Vec<Lease>,
    settled: Vec<u64>,
    /// Spent, leased, left.
    state: (u64, u64, u64),
    database: Vec<u8>,
    log: Vec<u8>,
}

/// Runs ten episodes with leases and some without, and takes a snapshot after each answer.
fn play(path: &Path) -> Vec<Snapshot> {
    let mut ledger = SqliteLedger::open(path).expect("a ledger");
    ledger.open(NAME, terms(BUDGET)).expect("an account");
    let mut snapshot = Snapshot::default();
    let mut history = Vec::new();
    for round in 0..5_u64 {
        let episodes = [2 * round, 2 * round + 1];
        snapshot.leases.extend(ledger.open_leases(NAME, &episodes, 40).expect("leases").0);
        history.push(take_snapshot(&mut ledger, path, &mut snapshot));
        for step in 0..12_u32 {
            let wanted = |episode: u64| {
                let first = !(episode + u64::from(step)).is_multiple_of(3);
                charge(episode, step, [first, true])
            };
            let unleased = 999 + u64::from(step) * 64;
            let charges = [wanted(episodes[0]), wanted(episodes[1]), wanted(unleased)];
            let result = ledger.charge(&[request(NAME, &charges)]).remove(0).expect("paid");
            snapshot.steps.extend(charges.into_iter().zip(result.verdicts));
            history.push(take_snapshot(&mut ledger, path, &mut snapshot));
        }
        ledger.settle(NAME, &episodes).expect("settled");
        snapshot.settled.extend(episodes);
        history.push(take_snapshot(&mut ledger, path, &mut snapshot));
    }
    history
}

fn take_snapshot(ledger: &mut SqliteLedger, path: &Path, snapshot: &mut Snapshot) -> Snapshot {
    let balance = ledger.balance(NAME).expect("an account");
    snapshot.state = (balance.spent, balance.leased, balance.left);
    snapshot.database = fs::read(path).expect("a database");
    snapshot.log = fs::read(log_of(path)).expect("its log");
    snapshot.clone()
}

fn log_of(path: &Path) -> std::path::PathBuf {
    path.with_file_name("ledger.sqlite-wal")
}

/// Opens a ledger with these bytes and checks that it repeats all answers of the snapshot.
fn check(snapshot: &Snapshot, database: &[u8], log: &[u8]) {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("ledger.sqlite");
    fs::write(&path, database).expect("written");
    fs::write(log_of(&path), log).expect("written");
    let mut ledger = SqliteLedger::open(&path).expect("a sound ledger");
    let state = |ledger: &mut SqliteLedger| {
        let balance = ledger.balance(NAME).expect("an account");
        (balance.spent, balance.leased, balance.left)
    };
    assert_eq!(state(&mut ledger), snapshot.state);
    let again: Vec<Charge> = snapshot.steps.iter().map(|(charge, _)| inverted(charge)).collect();
    let verdicts: Vec<Verdict> = snapshot.steps.iter().map(|(_, verdict)| *verdict).collect();
    let result = ledger.charge(&[request(NAME, &again)]).remove(0).expect("paid");
    assert_eq!(result.verdicts, verdicts);
    let episodes: Vec<u64> = snapshot.leases.iter().map(|lease| lease.episode).collect();
    assert_eq!(ledger.open_leases(NAME, &episodes, 1).expect("leases").0, snapshot.leases);
    ledger.settle(NAME, &snapshot.settled).expect("settled");
    assert_eq!(state(&mut ledger), snapshot.state, "nothing was new");
}

#[test]
fn every_answer_is_in_the_files_when_it_is_given() {
    let directory = tempfile::tempdir().expect("a directory");
    let history = play(&directory.path().join("ledger.sqlite"));
    assert_eq!(history.last().expect("answers").state.1, 0, "all leases are settled");
    for snapshot in &history {
        check(snapshot, &snapshot.database, &snapshot.log);
    }
}

/// The end of the process may leave any prefix of a transaction in the log.
#[test]
fn a_torn_transaction_is_discarded_as_a_whole() {
    let directory = tempfile::tempdir().expect("a directory");
    let history = play(&directory.path().join("ledger.sqlite"));
    let mut n_torn = 0;
    for (idx, pair) in history.windows(2).enumerate().step_by(3) {
        let [before, after] = pair else { unreachable!("two of them") };
        assert!(after.log.starts_with(&before.log), "the log is appended to");
        assert_eq!(after.database, before.database, "only the log is written");
        let (from, to) = (before.log.len(), after.log.len());
        assert!(to > from, "an answer is written down before it is given");
        for torn in [from + 1, from + (to - from) * (idx % 7 + 1) / 8, to - 1] {
            check(before, &before.database, &after.log[..torn]);
            n_torn += 1;
        }
        check(after, &before.database, &after.log);
    }
    assert!(n_torn > 60, "{n_torn}");
}
