mod damage;

use super::*;
use crate::budget::{BudgetHalf, BudgetHalves, Charge};
use crate::strategy::Strategy;

const TERMS: AccountTerms = AccountTerms { budget: 100_000, strategy: Strategy::EarlyAdvising };

fn ledger() -> (tempfile::TempDir, SqliteLedger) {
    let directory = tempfile::tempdir().unwrap();
    let mut ledger = SqliteLedger::open(&directory.path().join("ledger.sqlite")).unwrap();
    ledger.open("run", TERMS).unwrap();
    (directory, ledger)
}

fn request(account: &str, episode: u64, steps: std::ops::Range<u32>) -> ChargeRequest {
    let charge = |step| Charge { episode, step, wanted_in: BudgetHalves::BOTH };
    let charges = steps.map(charge).collect();
    let strategy = TERMS.strategy;
    ChargeRequest { account: account.to_owned(), strategy, episode_steps: 50, charges }
}

/// Returns the accounts in memory as text.
fn accounts(ledger: &SqliteLedger) -> String {
    format!("{:?}", ledger.accounts)
}

#[test]
fn a_failed_write_changes_nothing() {
    let (_directory, mut ledger) = ledger();
    ledger.open("walk", TERMS).unwrap();
    ledger.open_leases("run", &[1, 2], 9).unwrap();
    ledger.charge(&[request("run", 1, 0..3)]).remove(0).unwrap();
    let before = accounts(&ledger);
    ledger.file.limit_pages(1);
    let episodes: Vec<u64> = (1..2_000).collect();
    let message = ledger.open_leases("run", &episodes, 9).unwrap_err().to_string();
    assert!(message.contains("database or disk is full"), "{message}");
    let many: Vec<ChargeRequest> =
        (10..1_000).map(|episode| request("walk", episode, 0..2)).collect();
    let requests = [vec![request("run", 1, 2..5), request("nun", 1, 0..1)], many].concat();
    let outcomes = ledger.charge(&requests);
    let is_unavailable = |outcome: &Result<ChargeResult, LedgerError>| {
        matches!(outcome, Err(LedgerError::Unavailable { .. }))
    };
    assert_eq!(outcomes.iter().filter(|outcome| is_unavailable(outcome)).count(), 991);
    let message = outcomes[1].as_ref().unwrap_err().to_string();
    assert_eq!(message, "unknown account \"nun\": open it first");
    assert_eq!(accounts(&ledger), before);
    ledger.charge(&[request("run", 1, 0..3)]).remove(0).expect("it is known");
    let warning = ledger.warning().expect("known charges are not written");
    assert!(warning.contains("ledger.sqlite") && warning.contains("disk is full"), "{warning}");
    ledger.file.limit_pages(1_000_000);
    let outcomes = ledger.charge(&requests);
    assert_eq!(ledger.warning(), None);
    let first = Some(BudgetHalf::First);
    assert_eq!(outcomes[0].as_ref().unwrap().verdicts, [first; 3]);
    assert!(outcomes[2..].iter().all(Result::is_ok));
    assert_eq!(ledger.balance("run").unwrap().spent, 5);
    assert_eq!(ledger.balance("walk").unwrap().spent, 2 * 990);
    ledger.open_leases("run", &episodes, 9).unwrap();
    let path = ledger.file.path().to_owned();
    let after = accounts(&ledger);
    drop(ledger);
    assert_eq!(accounts(&SqliteLedger::open(&path).unwrap()), after);
}

#[test]
fn a_lease_makes_the_charges_before_it_survive_a_loss_of_power() {
    let (_directory, mut ledger) = ledger();
    assert_eq!(ledger.file.n_unsynced(), 0, "an account is opened for good");
    for step in 0..5 {
        ledger.charge(&[request("run", 1, step..step + 1)]).remove(0).unwrap();
    }
    assert_eq!(ledger.file.n_unsynced(), 5);
    ledger.charge(&[request("run", 1, 0..5)]).remove(0).unwrap();
    assert_eq!(ledger.file.n_unsynced(), 5, "what is known is not written again");
    ledger.open_leases("run", &[2], 3).unwrap();
    assert_eq!(ledger.file.n_unsynced(), 0);
    ledger.charge(&[request("run", 2, 0..1)]).remove(0).unwrap();
    ledger.settle("run", &[2]).unwrap();
    assert_eq!(ledger.file.n_unsynced(), 0);
}

#[test]
fn a_charge_does_not_wait_for_the_disk_and_a_lease_does() {
    let (_directory, mut ledger) = ledger();
    for step in 0..2 {
        ledger.charge(&[request("run", 1, step..step + 1)]).remove(0).unwrap();
        assert_eq!(ledger.file.synchronous(), 1, "checkpoints only");
    }
    ledger.open_leases("run", &[2], 3).unwrap();
    assert_eq!(ledger.file.synchronous(), 2, "every transaction");
    ledger.charge(&[request("run", 2, 0..1)]).remove(0).unwrap();
    assert_eq!(ledger.file.synchronous(), 1);
}

#[test]
fn no_more_than_so_many_charges_can_be_lost_to_a_loss_of_power() {
    let (_directory, mut ledger) = ledger();
    let mut most = 0;
    for step in 0..2 * file::MAX_UNSYNCED + 5 {
        ledger.charge(&[request("run", 1, step..step + 1)]).remove(0).unwrap();
        most = most.max(ledger.file.n_unsynced());
    }
    assert_eq!((most, ledger.file.n_unsynced()), (file::MAX_UNSYNCED, 3));
}
