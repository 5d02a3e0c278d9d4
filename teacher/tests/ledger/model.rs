//! Random operations on a ledger and on a ledger in memory: equal answers, with the ledger closed and reopened in
//! between.

use proptest::collection::vec;
use proptest::prelude::{Just, Strategy as _, any, prop_oneof};
use proptest::test_runner::{Config, TestCaseError, TestRunner};
use tandem_teacher::budget::Charge;
use tandem_teacher::ledger::{Ledger, MemoryLedger};

use crate::ledger_tests::fixture::{TestLedger, charge, request, terms};

/// The number of random series of operations.
const N_CASES: u32 = 48;

#[derive(Debug, Clone)]
enum Operation {
    Open { account: u8, budget: u64 },
    Balance { account: u8 },
    OpenLeases { account: u8, episodes: Vec<u64>, units: u32 },
    Settle { account: u8, episodes: Vec<u64> },
    Charge(Vec<(u8, Vec<Charge>)>),
    Reopen,
}

fn episode() -> impl proptest::strategy::Strategy<Value = u64> {
    prop_oneof![8 => 0..6_u64, 1 => Just(u64::MAX), 1 => Just(1_u64 << 63)]
}

fn operation() -> impl proptest::strategy::Strategy<Value = Operation> {
    let step = || prop_oneof![6 => 0..12_u32, 2 => 45..55_u32, 1 => 60..70_u32];
    let charge = (episode(), step(), any::<[bool; 2]>())
        .prop_map(|(episode, step, wanted)| charge(episode, step, wanted));
    let account = || 0..3_u8;
    let episodes = || vec(episode(), 0..4);
    prop_oneof![
        2 => (account(), 0..3_u64).prop_map(|(account, n)| Operation::Open { account, budget: 30 * n }),
        1 => account().prop_map(|account| Operation::Balance { account }),
        3 => (account(), episodes(), 0..12_u32)
            .prop_map(|(account, episodes, units)| Operation::OpenLeases { account, episodes, units }),
        2 => (account(), episodes())
            .prop_map(|(account, episodes)| Operation::Settle { account, episodes }),
        12 => vec((account(), vec(charge, 0..6)), 0..4).prop_map(Operation::Charge),
        1 => Just(Operation::Reopen),
    ]
}

/// Returns the ledger's answer as text.
fn answer(ledger: &mut dyn Ledger, case: u32, operation: &Operation) -> String {
    let name = |account: &u8| format!("case {case}, account {account}");
    match operation {
        Operation::Open { account, budget } => {
            format!("{:?}", ledger.open(&name(account), terms(*budget)))
        }
        Operation::Balance { account } => format!("{:?}", ledger.balance(&name(account))),
        Operation::OpenLeases { account, episodes, units } => {
            format!("{:?}", ledger.open_leases(&name(account), episodes, *units))
        }
        Operation::Settle { account, episodes } => {
            format!("{:?}", ledger.settle(&name(account), episodes))
        }
        Operation::Charge(requests) => {
            let requests: Vec<_> = requests
                .iter()
                .map(|(account, charges)| request(&name(account), charges))
                .collect();
            format!("{:?}", ledger.charge(&requests))
        }
        Operation::Reopen => String::new(),
    }
}

pub(crate) fn it_agrees_with_a_ledger_in_memory(fixture: TestLedger) {
    let fixture = std::cell::RefCell::new((fixture, 0_u32));
    let config = Config { cases: N_CASES, failure_persistence: None, ..Config::default() };
    let outcome = TestRunner::new(config).run(&vec(operation(), 1..80), |operations| {
        let (fixture, case) = &mut *fixture.borrow_mut();
        *case += 1;
        let mut model = MemoryLedger::default();
        for (idx, operation) in operations.iter().enumerate() {
            if matches!(operation, Operation::Reopen) {
                fixture.close();
            }
            let expected = answer(&mut model, *case, operation);
            let got = answer(fixture.ledger(), *case, operation);
            if got != expected {
                let what = format!("operation {idx}: expected {expected}, got {got}");
                return Err(TestCaseError::fail(what));
            }
        }
        Ok(())
    });
    if let Err(failed) = outcome {
        panic!("{failed}");
    }
}
