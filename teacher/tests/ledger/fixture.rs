//! A ledger of any kind, with shorthands for operations on it.

use tandem_teacher::budget::{AccountTerms, Balance, BudgetHalf, BudgetHalves, Charge, Lease};
use tandem_teacher::ledger::{ChargeRequest, ChargeResult, Ledger, MemoryLedger};
use tandem_teacher::{Strategy, ledger};
use tempfile::TempDir;

use crate::ledger_tests::redis_server::RedisServer;

/// True if a step is worth a unit of the first, and of the second half of the budget.
pub(crate) type Wanted = [bool; 2];
pub(crate) type Verdict = Option<BudgetHalf>;

pub(crate) const BOTH: Wanted = [true, true];
pub(crate) const NEITHER: Wanted = [false, false];
pub(crate) const FIRST: Verdict = Some(BudgetHalf::First);
pub(crate) const SECOND: Verdict = Some(BudgetHalf::Second);
pub(crate) const NOTHING: Verdict = None;

/// A ledger that can be closed and opened again.
pub(crate) struct TestLedger {
    open: Option<Box<dyn Ledger>>,
    storage: Storage,
}

/// The storage of the accounts while the ledger is closed.
enum Storage {
    /// A ledger in memory is never closed.
    Memory,
    File(TempDir),
    Server(RedisServer),
}

impl TestLedger {
    pub(crate) fn memory() -> Self {
        Self { open: Some(Box::new(MemoryLedger::default())), storage: Storage::Memory }
    }

    pub(crate) fn sqlite() -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        Self { open: None, storage: Storage::File(directory) }
    }

    /// Returns `None` if Redis is not installed and not required.
    pub(crate) fn redis() -> Option<Self> {
        Some(Self { open: None, storage: Storage::Server(RedisServer::start()?) })
    }

    pub(crate) fn ledger(&mut self) -> &mut dyn Ledger {
        let location = match &self.storage {
            Storage::Memory => "memory".to_owned(),
            Storage::File(directory) => {
                directory.path().join("ledger.sqlite").to_str().expect("UTF-8").to_owned()
            }
            Storage::Server(server) => server.url(),
        };
        let open = || ledger::open(&location).expect("a ledger");
        self.open.get_or_insert_with(open).as_mut()
    }

    /// Closes the ledger. The next operation opens it again.
    pub(crate) fn close(&mut self) {
        if !matches!(self.storage, Storage::Memory) {
            self.open = None;
        }
    }

    pub(crate) fn open(&mut self, name: &str, budget: u64) -> Balance {
        self.ledger().open(name, terms(budget)).expect("an account")
    }

    pub(crate) fn leases(&mut self, name: &str, episodes: &[u64], units: u32) -> Vec<Lease> {
        self.ledger().open_leases(name, episodes, units).expect("leases").0
    }

    pub(crate) fn settle(&mut self, name: &str, episodes: &[u64]) -> (u64, u64, u64) {
        state_of(&self.ledger().settle(name, episodes).expect("settled"))
    }

    /// Returns the units spent, leased and left.
    pub(crate) fn state(&mut self, name: &str) -> (u64, u64, u64) {
        state_of(&self.ledger().balance(name).expect("an account"))
    }

    pub(crate) fn charge(&mut self, name: &str, charges: &[Charge]) -> Vec<Option<BudgetHalf>> {
        self.pay(name, charges).expect("paid").verdicts
    }

    pub(crate) fn pay(
        &mut self,
        name: &str,
        charges: &[Charge],
    ) -> Result<ChargeResult, ledger::LedgerError> {
        self.ledger().charge(&[request(name, charges)]).pop().expect("one outcome")
    }
}

pub(crate) fn terms(budget: u64) -> AccountTerms {
    AccountTerms { budget, strategy: Strategy::EarlyThenMistakeQ { threshold: 0.1 } }
}

pub(crate) fn request(account: &str, charges: &[Charge]) -> ChargeRequest {
    let (strategy, charges) = (terms(0).strategy, charges.to_vec());
    ChargeRequest { account: account.to_owned(), strategy, episode_steps: 50, charges }
}

pub(crate) fn charge(episode: u64, step: u32, wanted: Wanted) -> Charge {
    let [first, second] = wanted;
    Charge { episode, step, wanted_in: BudgetHalves { first, second } }
}

/// Returns a charge for the same step that wants a unit exactly of the other halves.
pub(crate) fn inverted(charge: &Charge) -> Charge {
    let BudgetHalves { first, second } = charge.wanted_in;
    Charge { wanted_in: BudgetHalves { first: !first, second: !second }, ..*charge }
}

pub(crate) fn lease(episode: u64, units: u32, early_units: u32) -> Lease {
    Lease { episode, units, early_units }
}

fn state_of(balance: &Balance) -> (u64, u64, u64) {
    (balance.spent, balance.leased, balance.left)
}
