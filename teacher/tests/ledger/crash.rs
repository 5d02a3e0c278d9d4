//! A process that ends at any moment: what was answered is there, and nothing is charged twice.

use std::fs;
use std::path::Path;

use tandem_teacher::budget::{Lease, Verdict, Wish};
use tandem_teacher::ledger::{Charge, Ledger as _, SqliteLedger};

use crate::place::{bill, charge, terms};

const NAME: &str = "run";
const BUDGET: u64 = 150;

/// What a client was told, and what then stood on the disk.
#[derive(Default, Clone)]
struct Told {
    steps: Vec<(Charge, Verdict)>,
    leases: Vec<Lease>,
    settled: Vec<u64>,
    /// Spent, leased, left.
    state: (u64, u64, u64),
    database: Vec<u8>,
    log: Vec<u8>,
}

/// Plays ten episodes with leases and one without; looks at the files after every answer.
fn play(path: &Path) -> Vec<Told> {
    let mut ledger = SqliteLedger::open(path).expect("a ledger");
    ledger.open(NAME, terms(BUDGET)).expect("an account");
    let mut told = Told::default();
    let mut history = Vec::new();
    for round in 0..5_u64 {
        let episodes = [2 * round, 2 * round + 1];
        told.leases.extend(ledger.open_leases(NAME, &episodes, 40).expect("leases").0);
        history.push(look(&mut ledger, path, &mut told));
        for step in 0..12_u32 {
            let wish = |episode: u64| {
                let first = !(episode + u64::from(step)).is_multiple_of(3);
                charge(episode, step, Wish { first, second: true })
            };
            let charges = [wish(episodes[0]), wish(episodes[1]), wish(999 + u64::from(step) * 64)];
            let receipt = ledger.charge(&[bill(NAME, &charges)]).remove(0).expect("paid");
            told.steps.extend(charges.into_iter().zip(receipt.verdicts));
            history.push(look(&mut ledger, path, &mut told));
        }
        ledger.settle(NAME, &episodes).expect("settled");
        told.settled.extend(episodes);
        history.push(look(&mut ledger, path, &mut told));
    }
    history
}

fn look(ledger: &mut SqliteLedger, path: &Path, told: &mut Told) -> Told {
    let balance = ledger.balance(NAME).expect("an account");
    told.state = (balance.spent, balance.leased, balance.left);
    told.database = fs::read(path).expect("a database");
    told.log = fs::read(log_of(path)).expect("its log");
    told.clone()
}

fn log_of(path: &Path) -> std::path::PathBuf {
    path.with_file_name("ledger.sqlite-wal")
}

/// Opens a ledger of these bytes and compares it with what was told, asking for everything again.
fn check(told: &Told, database: &[u8], log: &[u8]) {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("ledger.sqlite");
    fs::write(&path, database).expect("written");
    fs::write(log_of(&path), log).expect("written");
    let mut ledger = SqliteLedger::open(&path).expect("a sound ledger");
    let state = |ledger: &mut SqliteLedger| {
        let balance = ledger.balance(NAME).expect("an account");
        (balance.spent, balance.leased, balance.left)
    };
    assert_eq!(state(&mut ledger), told.state);
    let swapped = |wish: Wish| Wish { first: !wish.first, second: !wish.second };
    let again: Vec<Charge> = told
        .steps
        .iter()
        .map(|(asked, _)| charge(asked.episode, asked.step, swapped(asked.wish)))
        .collect();
    let verdicts: Vec<Verdict> = told.steps.iter().map(|(_, verdict)| *verdict).collect();
    let receipt = ledger.charge(&[bill(NAME, &again)]).remove(0).expect("paid");
    assert_eq!(receipt.verdicts, verdicts);
    let episodes: Vec<u64> = told.leases.iter().map(|lease| lease.episode).collect();
    assert_eq!(ledger.open_leases(NAME, &episodes, 1).expect("leases").0, told.leases);
    ledger.settle(NAME, &told.settled).expect("settled");
    assert_eq!(state(&mut ledger), told.state, "nothing was new");
}

#[test]
fn whatever_was_answered_is_in_the_files_at_that_moment() {
    let directory = tempfile::tempdir().expect("a directory");
    let history = play(&directory.path().join("ledger.sqlite"));
    assert_eq!(history.last().expect("answers").state.1, 0, "all leases are settled");
    for told in &history {
        check(told, &told.database, &told.log);
    }
}

/// The system may have written any part of a transaction when the process ends.
#[test]
fn a_transaction_is_written_as_a_whole_or_not() {
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
