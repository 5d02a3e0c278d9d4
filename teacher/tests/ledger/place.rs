//! Where the tests keep accounts, and words to say what they do with them.

use tandem_teacher::budget::{Balance, Half, Lease, Terms, Verdict, Wish};
use tandem_teacher::ledger::{Bill, Charge, Ledger, MemoryLedger, Receipt};
use tandem_teacher::{Strategy, ledger};
use tempfile::TempDir;

use crate::redis_server::RedisServer;

pub(crate) const BOTH: Wish = Wish { first: true, second: true };
pub(crate) const NEITHER: Wish = Wish { first: false, second: false };
pub(crate) const FIRST: Verdict = Verdict::Charged(Half::First);
pub(crate) const SECOND: Verdict = Verdict::Charged(Half::Second);
pub(crate) const NOTHING: Verdict = Verdict::Uncharged;

/// A ledger that can be closed and opened again.
pub(crate) struct Place {
    open: Option<Box<dyn Ledger>>,
    keeper: Keeper,
}

/// What remembers the accounts while the ledger is closed.
enum Keeper {
    /// Nothing: a ledger in memory stays open.
    Nobody,
    File(TempDir),
    Server(RedisServer),
}

impl Place {
    pub(crate) fn memory() -> Self {
        Self { open: Some(Box::new(MemoryLedger::default())), keeper: Keeper::Nobody }
    }

    pub(crate) fn sqlite() -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        Self { open: None, keeper: Keeper::File(directory) }
    }

    /// None where there is no Redis, and nobody insists on it.
    pub(crate) fn redis() -> Option<Self> {
        Some(Self { open: None, keeper: Keeper::Server(RedisServer::start()?) })
    }

    pub(crate) fn ledger(&mut self) -> &mut dyn Ledger {
        let place = match &self.keeper {
            Keeper::Nobody => "memory".to_owned(),
            Keeper::File(directory) => {
                directory.path().join("ledger.sqlite").to_str().expect("UTF-8").to_owned()
            }
            Keeper::Server(server) => server.url(),
        };
        let open = || ledger::open(&place).expect("a ledger");
        self.open.get_or_insert_with(open).as_mut()
    }

    /// Closes the ledger; who asks next opens it again.
    pub(crate) fn close(&mut self) {
        if !matches!(self.keeper, Keeper::Nobody) {
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

    /// What is spent, leased and left.
    pub(crate) fn state(&mut self, name: &str) -> (u64, u64, u64) {
        state_of(&self.ledger().balance(name).expect("an account"))
    }

    pub(crate) fn charge(&mut self, name: &str, charges: &[Charge]) -> Vec<Verdict> {
        self.pay(name, charges).expect("paid").verdicts
    }

    pub(crate) fn pay(
        &mut self,
        name: &str,
        charges: &[Charge],
    ) -> Result<Receipt, ledger::LedgerError> {
        self.ledger().charge(&[bill(name, charges)]).pop().expect("one outcome")
    }
}

pub(crate) fn terms(budget: u64) -> Terms {
    Terms { budget, strategy: Strategy::EarlyThenMistakeQ { threshold: 0.1 } }
}

pub(crate) fn bill(account: &str, charges: &[Charge]) -> Bill {
    Bill { account: account.to_owned(), charges: charges.to_vec() }
}

pub(crate) fn charge(episode: u64, step: u32, wish: Wish) -> Charge {
    Charge { episode, step, wish }
}

pub(crate) fn lease(episode: u64, units: u32, early_units: u32) -> Lease {
    Lease { episode, units, early_units }
}

fn state_of(balance: &Balance) -> (u64, u64, u64) {
    (balance.spent, balance.leased, balance.left)
}
