//! Ledgers of simulated teachers: observed ones, and a faulty one that forgets its verdicts.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard};

use tandem_teacher::budget::{
    Account, AccountTerms, Balance, BudgetError, BudgetHalf, Charge, Lease,
};
use tandem_teacher::ledger::{ChargeRequest, ChargeResult, Ledger, LedgerError, SqliteLedger};

type Open = dyn Fn() -> Box<dyn Ledger>;

/// Opens a ledger for each teacher that starts.
pub(crate) struct Ledgers(Box<Open>);

impl Ledgers {
    /// Creates ledgers that share `ledger`, which outlives the teachers.
    pub(crate) fn shared(ledger: impl Ledger + 'static) -> Self {
        let shared = SharedLedger(Arc::new(Mutex::new(ledger)));
        Self(Box::new(move || Box::new(shared.clone())))
    }

    /// Creates ledgers that open the same file.
    pub(crate) fn in_file() -> Self {
        Self(Box::new(|| Box::new(SqliteLedger::open(Path::new("ledger.db")).expect("a ledger"))))
    }

    /// Opens the ledger of a teacher.
    pub(crate) fn open(&self) -> Box<dyn Ledger> {
        (self.0)()
    }
}

/// A ledger that outlives its teacher.
struct SharedLedger<L>(Arc<Mutex<L>>);

impl<L> Clone for SharedLedger<L> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<L> SharedLedger<L> {
    fn lock(&self) -> MutexGuard<'_, L> {
        self.0.lock().expect("no ledger panics")
    }
}

impl<L: Ledger> Ledger for SharedLedger<L> {
    fn open(&mut self, name: &str, terms: AccountTerms) -> Result<Balance, LedgerError> {
        self.lock().open(name, terms)
    }

    fn balance(&mut self, name: &str) -> Result<Balance, LedgerError> {
        self.lock().balance(name)
    }

    fn open_leases(
        &mut self,
        name: &str,
        episodes: &[u64],
        units_per_episode: u32,
    ) -> Result<(Vec<Lease>, Balance), LedgerError> {
        self.lock().open_leases(name, episodes, units_per_episode)
    }

    fn settle(&mut self, name: &str, episodes: &[u64]) -> Result<Balance, LedgerError> {
        self.lock().settle(name, episodes)
    }

    fn charge(&mut self, requests: &[ChargeRequest]) -> Vec<Result<ChargeResult, LedgerError>> {
        self.lock().charge(requests)
    }
}

/// A faulty ledger that charges a step for every request, as if it were new.
#[derive(Default)]
pub(crate) struct ForgetfulLedger {
    accounts: BTreeMap<String, Account>,
    /// Next step number that no episode has used.
    next_step: u32,
}

impl ForgetfulLedger {
    fn account(&mut self, name: &str) -> Result<&mut Account, LedgerError> {
        let unknown = || BudgetError::UnknownAccount(name.to_owned());
        Ok(self.accounts.get_mut(name).ok_or_else(unknown)?)
    }

    fn charge_request(&mut self, request: &ChargeRequest) -> Result<ChargeResult, LedgerError> {
        let first_step = self.next_step;
        self.next_step += u32::try_from(request.charges.len()).expect("few charges");
        let account = self.account(&request.account)?;
        let charge = |(step, charge): (u32, &Charge)| account.charge(Charge { step, ..*charge });
        let verdicts = (first_step..).zip(&request.charges).map(charge).collect();
        let repeated = vec![false; request.charges.len()];
        Ok(ChargeResult { verdicts, repeated, left: account.left() })
    }
}

impl Ledger for ForgetfulLedger {
    fn open(&mut self, name: &str, terms: AccountTerms) -> Result<Balance, LedgerError> {
        Ok(self.accounts.entry(name.to_owned()).or_insert_with(|| Account::new(terms)).balance())
    }

    fn balance(&mut self, name: &str) -> Result<Balance, LedgerError> {
        Ok(self.account(name)?.balance())
    }

    fn open_leases(
        &mut self,
        name: &str,
        episodes: &[u64],
        units_per_episode: u32,
    ) -> Result<(Vec<Lease>, Balance), LedgerError> {
        let account = self.account(name)?;
        Ok((account.open_leases(episodes, units_per_episode), account.balance()))
    }

    fn settle(&mut self, name: &str, episodes: &[u64]) -> Result<Balance, LedgerError> {
        let account = self.account(name)?;
        account.settle(episodes);
        Ok(account.balance())
    }

    fn charge(&mut self, requests: &[ChargeRequest]) -> Vec<Result<ChargeResult, LedgerError>> {
        requests.iter().map(|request| self.charge_request(request)).collect()
    }
}

/// The observed answers of a ledger in a simulation.
#[derive(Debug, Clone, Default)]
pub(crate) struct LedgerRecord {
    verdicts: BTreeMap<(String, u64, u32), Option<BudgetHalf>>,
    spent: BTreeMap<String, u64>,
    /// Number of repeated requests for a step.
    pub(crate) n_repeats: u64,
    /// Violated invariants.
    pub(crate) violations: Vec<String>,
}

impl LedgerRecord {
    /// Returns the observed accounts.
    pub(crate) fn accounts(&self) -> Vec<&str> {
        self.spent.keys().map(String::as_str).collect()
    }

    /// Counts the charged steps of `account`.
    pub(crate) fn n_charged(&self, account: &str) -> u64 {
        let is_charged = |((name, ..), verdict): &(&(String, u64, u32), &Option<BudgetHalf>)| {
            name == account && verdict.is_some()
        };
        self.verdicts.iter().filter(is_charged).count() as u64
    }

    fn note_balance(&mut self, name: &str, balance: &Balance) {
        let Balance { terms, spent, leased, left } = *balance;
        if spent.checked_add(leased).and_then(|out| out.checked_add(left)) != Some(terms.budget) {
            self.violations.push(format!("the balance of {name} does not add up: {balance:?}"));
        }
        let before = self.spent.insert(name.to_owned(), spent).unwrap_or(0);
        if spent < before {
            self.violations.push(format!("{name} had spent {before}, now {spent}"));
        }
    }

    fn note_verdict(&mut self, account: &str, charge: &Charge, verdict: Option<BudgetHalf>) {
        let key = (account.to_owned(), charge.episode, charge.step);
        let Some(before) = self.verdicts.insert(key, verdict) else { return };
        self.n_repeats += 1;
        if before != verdict {
            let Charge { episode, step, .. } = charge;
            self.violations.push(format!(
                "step {step} of episode {episode} was {before:?}, asked again it is {verdict:?}"
            ));
        }
    }
}

/// A record shared with the simulation.
pub(crate) type SharedRecord = Arc<Mutex<LedgerRecord>>;

/// A ledger whose answers are recorded.
pub(crate) struct ObservedLedger {
    ledger: Box<dyn Ledger>,
    record: SharedRecord,
}

impl ObservedLedger {
    pub(crate) fn new(ledger: Box<dyn Ledger>, record: SharedRecord) -> Self {
        Self { ledger, record }
    }

    /// Records the balance of account `name` after an operation.
    fn observed(&self, name: &str, balance: Balance) -> Balance {
        self.record.lock().expect("not poisoned").note_balance(name, &balance);
        balance
    }
}

impl Ledger for ObservedLedger {
    fn open(&mut self, name: &str, terms: AccountTerms) -> Result<Balance, LedgerError> {
        let balance = self.ledger.open(name, terms)?;
        Ok(self.observed(name, balance))
    }

    fn balance(&mut self, name: &str) -> Result<Balance, LedgerError> {
        let balance = self.ledger.balance(name)?;
        Ok(self.observed(name, balance))
    }

    fn open_leases(
        &mut self,
        name: &str,
        episodes: &[u64],
        units_per_episode: u32,
    ) -> Result<(Vec<Lease>, Balance), LedgerError> {
        let (leases, balance) = self.ledger.open_leases(name, episodes, units_per_episode)?;
        Ok((leases, self.observed(name, balance)))
    }

    fn settle(&mut self, name: &str, episodes: &[u64]) -> Result<Balance, LedgerError> {
        let balance = self.ledger.settle(name, episodes)?;
        Ok(self.observed(name, balance))
    }

    fn charge(&mut self, requests: &[ChargeRequest]) -> Vec<Result<ChargeResult, LedgerError>> {
        let results = self.ledger.charge(requests);
        for (request, result) in requests.iter().zip(&results) {
            let Ok(result) = result else { continue };
            let mut record = self.record.lock().expect("not poisoned");
            for (charge, verdict) in request.charges.iter().zip(&result.verdicts) {
                record.note_verdict(&request.account, charge, *verdict);
            }
            drop(record);
            if let Ok(balance) = self.ledger.balance(&request.account) {
                self.observed(&request.account, balance);
            }
        }
        results
    }
}
