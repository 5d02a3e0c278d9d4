//! Ledgers that are watched while a simulation runs, and one that does not do what a ledger must.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard};

use tandem_teacher::budget::{
    Account, AccountTerms, Balance, BudgetError, BudgetHalf, Charge, Lease,
};
use tandem_teacher::ledger::{ChargeRequest, ChargeResult, Ledger, LedgerError, SqliteLedger};

type Open = dyn Fn() -> Box<dyn Ledger>;

/// Opens the ledger of each teacher that starts.
pub(crate) struct Ledgers(Box<Open>);

impl Ledgers {
    /// All teachers use `ledger`, which survives them.
    pub(crate) fn kept(ledger: impl Ledger + 'static) -> Self {
        let kept = Kept(Arc::new(Mutex::new(ledger)));
        Self(Box::new(move || Box::new(kept.clone())))
    }

    /// Each teacher opens the ledger's file.
    pub(crate) fn in_file() -> Self {
        Self(Box::new(|| Box::new(SqliteLedger::open(Path::new("ledger.db")).expect("a ledger"))))
    }

    /// The ledger for a teacher.
    pub(crate) fn open(&self) -> Box<dyn Ledger> {
        (self.0)()
    }
}

/// A ledger that survives its teacher.
struct Kept<L>(Arc<Mutex<L>>);

impl<L> Clone for Kept<L> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<L> Kept<L> {
    fn lock(&self) -> MutexGuard<'_, L> {
        self.0.lock().expect("no ledger panics")
    }
}

impl<L: Ledger> Ledger for Kept<L> {
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

    fn charge(&mut self, bills: &[ChargeRequest]) -> Vec<Result<ChargeResult, LedgerError>> {
        self.lock().charge(bills)
    }
}

/// Charges a step whenever it is asked about, as if it had never been asked about before.
#[derive(Default)]
pub(crate) struct ForgetfulLedger {
    accounts: BTreeMap<String, Account>,
    /// Never used before by any episode.
    next_step: u32,
}

impl ForgetfulLedger {
    fn account(&mut self, name: &str) -> Result<&mut Account, LedgerError> {
        let unknown = || BudgetError::UnknownAccount(name.to_owned());
        Ok(self.accounts.get_mut(name).ok_or_else(unknown)?)
    }

    fn charge_bill(&mut self, bill: &ChargeRequest) -> Result<ChargeResult, LedgerError> {
        let first_step = self.next_step;
        self.next_step += u32::try_from(bill.charges.len()).expect("a bill is short");
        let account = self.account(&bill.account)?;
        let charge = |(step, charge): (u32, &Charge)| account.charge(Charge { step, ..*charge });
        let verdicts = (first_step..).zip(&bill.charges).map(charge).collect();
        Ok(ChargeResult { verdicts, left: account.left() })
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

    fn charge(&mut self, bills: &[ChargeRequest]) -> Vec<Result<ChargeResult, LedgerError>> {
        bills.iter().map(|bill| self.charge_bill(bill)).collect()
    }
}

/// What a ledger was seen to do in a simulation.
#[derive(Debug, Clone, Default)]
pub(crate) struct Book {
    verdicts: BTreeMap<(String, u64, u32), Option<BudgetHalf>>,
    spent: BTreeMap<String, u64>,
    /// Steps asked about again.
    pub(crate) n_repeats: u64,
    /// What a ledger must not do.
    pub(crate) complaints: Vec<String>,
}

impl Book {
    /// Accounts seen.
    pub(crate) fn accounts(&self) -> Vec<&str> {
        self.spent.keys().map(String::as_str).collect()
    }

    /// Steps of `account` that were charged.
    pub(crate) fn n_charged(&self, account: &str) -> u64 {
        let is_charged = |((name, ..), verdict): &(&(String, u64, u32), &Option<BudgetHalf>)| {
            name == account && verdict.is_some()
        };
        self.verdicts.iter().filter(is_charged).count() as u64
    }

    fn note_balance(&mut self, name: &str, balance: &Balance) {
        let Balance { terms, spent, leased, left } = *balance;
        if spent.checked_add(leased).and_then(|out| out.checked_add(left)) != Some(terms.budget) {
            self.complaints.push(format!("the balance of {name} does not add up: {balance:?}"));
        }
        let before = self.spent.insert(name.to_owned(), spent).unwrap_or(0);
        if spent < before {
            self.complaints.push(format!("{name} had spent {before}, now {spent}"));
        }
    }

    fn note_verdict(&mut self, account: &str, charge: &Charge, verdict: Option<BudgetHalf>) {
        let key = (account.to_owned(), charge.episode, charge.step);
        let Some(before) = self.verdicts.insert(key, verdict) else { return };
        self.n_repeats += 1;
        if before != verdict {
            let Charge { episode, step, .. } = charge;
            self.complaints.push(format!(
                "step {step} of episode {episode} was {before:?}, asked again it is {verdict:?}"
            ));
        }
    }
}

/// Who looks at the book from outside.
pub(crate) type SharedBook = Arc<Mutex<Book>>;

/// A ledger of whose answers a book is kept.
pub(crate) struct Watched {
    ledger: Box<dyn Ledger>,
    book: SharedBook,
}

impl Watched {
    pub(crate) fn new(ledger: Box<dyn Ledger>, book: SharedBook) -> Self {
        Self { ledger, book }
    }

    /// Notes how account `name` stands after an operation.
    fn noted(&self, name: &str, balance: Balance) -> Balance {
        self.book.lock().expect("nobody panics").note_balance(name, &balance);
        balance
    }
}

impl Ledger for Watched {
    fn open(&mut self, name: &str, terms: AccountTerms) -> Result<Balance, LedgerError> {
        let balance = self.ledger.open(name, terms)?;
        Ok(self.noted(name, balance))
    }

    fn balance(&mut self, name: &str) -> Result<Balance, LedgerError> {
        let balance = self.ledger.balance(name)?;
        Ok(self.noted(name, balance))
    }

    fn open_leases(
        &mut self,
        name: &str,
        episodes: &[u64],
        units_per_episode: u32,
    ) -> Result<(Vec<Lease>, Balance), LedgerError> {
        let (leases, balance) = self.ledger.open_leases(name, episodes, units_per_episode)?;
        Ok((leases, self.noted(name, balance)))
    }

    fn settle(&mut self, name: &str, episodes: &[u64]) -> Result<Balance, LedgerError> {
        let balance = self.ledger.settle(name, episodes)?;
        Ok(self.noted(name, balance))
    }

    fn charge(&mut self, bills: &[ChargeRequest]) -> Vec<Result<ChargeResult, LedgerError>> {
        let receipts = self.ledger.charge(bills);
        for (bill, receipt) in bills.iter().zip(&receipts) {
            let Ok(receipt) = receipt else { continue };
            let mut book = self.book.lock().expect("nobody panics");
            for (charge, verdict) in bill.charges.iter().zip(&receipt.verdicts) {
                book.note_verdict(&bill.account, charge, *verdict);
            }
            drop(book);
            if let Ok(balance) = self.ledger.balance(&bill.account) {
                self.noted(&bill.account, balance);
            }
        }
        receipts
    }
}
