//! A ledger whose behaviour a test controls.

use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

use crate::budget::{AccountTerms, Balance, Lease};
use crate::ledger::{ChargeRequest, ChargeResult, Ledger, LedgerError, MemoryLedger};

/// The behaviour of a [`GatedLedger`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mode {
    Answer,
    /// Blocks until the mode changes.
    Block,
    Refuse,
    Panic,
}

/// Sets the mode of a [`GatedLedger`], and records its calls to charge.
#[derive(Clone)]
pub(super) struct GateControl(Arc<(Mutex<State>, Condvar)>);

struct State {
    mode: Mode,
    charge_calls: Vec<Vec<usize>>,
}

impl GateControl {
    pub(super) fn new() -> Self {
        let state = State { mode: Mode::Answer, charge_calls: Vec::new() };
        Self(Arc::new((Mutex::new(state), Condvar::new())))
    }

    pub(super) fn set(&self, mode: Mode) {
        self.0.0.lock().unwrap().mode = mode;
        self.0.1.notify_all();
    }

    /// Returns, for each call, the number of charges of each request.
    pub(super) fn charge_calls(&self) -> Vec<Vec<usize>> {
        self.0.0.lock().unwrap().charge_calls.clone()
    }

    /// Waits until the ledger was called to charge `n` times.
    pub(super) async fn charge_called(&self, n: usize) {
        eventually(|| self.charge_calls().len() >= n).await;
    }

    fn enter(&self) -> Result<(), LedgerError> {
        let state = self.0.0.lock().unwrap();
        let state = self.0.1.wait_while(state, |state| state.mode == Mode::Block).unwrap();
        let mode = state.mode;
        drop(state);
        match mode {
            Mode::Answer | Mode::Block => Ok(()),
            Mode::Refuse => {
                Err(LedgerError::Unavailable { what: "the disk is full".to_owned(), source: None })
            }
            Mode::Panic => panic!("a bug, as the test requested"),
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

/// A ledger in memory that obeys a [`GateControl`].
pub(super) struct GatedLedger {
    ledger: MemoryLedger,
    gate: GateControl,
}

impl GatedLedger {
    pub(super) fn new(gate: GateControl) -> Self {
        Self { ledger: MemoryLedger::default(), gate }
    }
}

impl Ledger for GatedLedger {
    fn open(&mut self, name: &str, terms: AccountTerms) -> Result<Balance, LedgerError> {
        self.gate.enter()?;
        self.ledger.open(name, terms)
    }

    fn balance(&mut self, name: &str) -> Result<Balance, LedgerError> {
        self.gate.enter()?;
        self.ledger.balance(name)
    }

    fn open_leases(
        &mut self,
        name: &str,
        episodes: &[u64],
        units_per_episode: u32,
    ) -> Result<(Vec<Lease>, Balance), LedgerError> {
        self.gate.enter()?;
        self.ledger.open_leases(name, episodes, units_per_episode)
    }

    fn settle(&mut self, name: &str, episodes: &[u64]) -> Result<Balance, LedgerError> {
        self.gate.enter()?;
        self.ledger.settle(name, episodes)
    }

    fn charge(&mut self, requests: &[ChargeRequest]) -> Vec<Result<ChargeResult, LedgerError>> {
        let sizes = requests.iter().map(|request| request.charges.len()).collect();
        self.gate.0.0.lock().unwrap().charge_calls.push(sizes);
        match self.gate.enter() {
            Ok(()) => self.ledger.charge(requests),
            Err(_) => requests.iter().map(|_| Err(self.gate.enter().unwrap_err())).collect(),
        }
    }
}
