//! A ledger that does what a test wants.

use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

use crate::budget::{Balance, Lease, Terms};
use crate::ledger::{Bill, Ledger, LedgerError, MemoryLedger, Receipt};

/// What a [`GatedLedger`] does when it is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mode {
    Answer,
    /// Blocks until the mode changes.
    Block,
    Refuse,
    Panic,
}

/// Tells a [`GatedLedger`] what to do, and what it was asked to charge.
#[derive(Clone)]
pub(super) struct Watch(Arc<(Mutex<State>, Condvar)>);

struct State {
    mode: Mode,
    visits: Vec<Vec<usize>>,
}

impl Watch {
    pub(super) fn new() -> Self {
        let state = State { mode: Mode::Answer, visits: Vec::new() };
        Self(Arc::new((Mutex::new(state), Condvar::new())))
    }

    pub(super) fn set(&self, mode: Mode) {
        self.0.0.lock().unwrap().mode = mode;
        self.0.1.notify_all();
    }

    /// By visit, how many charges each bill has.
    pub(super) fn visits(&self) -> Vec<Vec<usize>> {
        self.0.0.lock().unwrap().visits.clone()
    }

    /// Waits until the ledger was asked to charge `n` times.
    pub(super) async fn visited(&self, n: usize) {
        eventually(|| self.visits().len() >= n).await;
    }

    fn pass(&self) -> Result<(), LedgerError> {
        let state = self.0.0.lock().unwrap();
        let state = self.0.1.wait_while(state, |state| state.mode == Mode::Block).unwrap();
        let mode = state.mode;
        drop(state);
        match mode {
            Mode::Answer | Mode::Block => Ok(()),
            Mode::Refuse => {
                Err(LedgerError::Unavailable { what: "the disk is full".to_owned(), source: None })
            }
            Mode::Panic => panic!("a bug, as the test wants it"),
        }
    }
}

/// Waits until `holds`.
pub(super) async fn eventually(holds: impl Fn() -> bool) {
    let waited = async {
        while !holds() {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(Duration::from_secs(60), waited).await.expect("it comes true");
}

/// Accounts in memory behind a gate.
pub(super) struct GatedLedger {
    ledger: MemoryLedger,
    watch: Watch,
}

impl GatedLedger {
    pub(super) fn new(watch: Watch) -> Self {
        Self { ledger: MemoryLedger::default(), watch }
    }
}

impl Ledger for GatedLedger {
    fn open(&mut self, name: &str, terms: Terms) -> Result<Balance, LedgerError> {
        self.watch.pass()?;
        self.ledger.open(name, terms)
    }

    fn balance(&mut self, name: &str) -> Result<Balance, LedgerError> {
        self.watch.pass()?;
        self.ledger.balance(name)
    }

    fn open_leases(
        &mut self,
        name: &str,
        episodes: &[u64],
        units_per_episode: u32,
    ) -> Result<(Vec<Lease>, Balance), LedgerError> {
        self.watch.pass()?;
        self.ledger.open_leases(name, episodes, units_per_episode)
    }

    fn settle(&mut self, name: &str, episodes: &[u64]) -> Result<Balance, LedgerError> {
        self.watch.pass()?;
        self.ledger.settle(name, episodes)
    }

    fn charge(&mut self, bills: &[Bill]) -> Vec<Result<Receipt, LedgerError>> {
        let sizes = bills.iter().map(|bill| bill.charges.len()).collect();
        self.watch.0.0.lock().unwrap().visits.push(sizes);
        match self.watch.pass() {
            Ok(()) => self.ledger.charge(bills),
            Err(_) => bills.iter().map(|_| Err(self.watch.pass().unwrap_err())).collect(),
        }
    }
}
