//! The budget of advice: accounts, leases and charges, as plain data.
//!
//! An account never spends more than its budget, and a step of an episode is charged at most once: its verdict is
//! remembered, so that asking again gives the same one. Units are numbered in the order in which they are handed
//! out, which for leases is the order of the episodes: which steps are advised, and in which half of the budget,
//! does not depend on the order in which the episodes' steps arrive.

mod account;
mod verdicts;

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

pub use account::Account;

use crate::strategy::Strategy;

/// The largest budget that an account may have.
pub const MAX_BUDGET: u64 = 1_000_000_000_000;

/// What an account is opened for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Terms {
    /// Units of advice, at most [`MAX_BUDGET`].
    pub budget: u64,
    /// How they are spent.
    pub strategy: Strategy,
}

/// How an account stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Balance {
    /// What it was opened for.
    pub terms: Terms,
    /// Units charged.
    pub spent: u64,
    /// Units set aside for open episodes and not yet spent.
    pub leased: u64,
    /// `budget − spent − leased`.
    pub left: u64,
}

/// Units set aside for one episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Lease {
    /// The episode's number.
    pub episode: u64,
    /// Units set aside.
    pub units: u32,
    /// How many of them, the first to be spent, lie in the first half of the budget.
    pub early_units: u32,
}

/// In which half of the budget a unit lies. A unit is of the first half when more than half of the budget is left
/// before it is handed out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Half {
    /// The half that is handed out first.
    First,
    /// The other one.
    Second,
}

/// Whether a step is worth a unit of either half.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wish {
    /// Worth a unit of the first half.
    pub first: bool,
    /// Worth a unit of the second half.
    pub second: bool,
}

impl Wish {
    const fn covers(self, half: Half) -> bool {
        match half {
            Half::First => self.first,
            Half::Second => self.second,
        }
    }
}

/// What a step cost; the same however often it is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// Nothing: it was not worth a unit, or there was none.
    Uncharged,
    /// One unit, of this half.
    Charged(Half),
}

/// Why an account cannot be opened or found.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BudgetError {
    /// Nobody opened it.
    #[error("unknown account {0:?}: open it first")]
    UnknownAccount(String),
    /// It was opened for something else.
    #[error(
        "account {name:?} is open with budget {} and strategy {}, not with budget {} and strategy {}",
        open.budget, open.strategy, asked.budget, asked.strategy
    )]
    OtherTerms {
        /// The account.
        name: String,
        /// What it was opened for.
        open: Terms,
        /// What it was asked to be.
        asked: Terms,
    },
    /// More than any account may have.
    #[error("budget: expected 0 to {MAX_BUDGET}, got {0}")]
    BudgetTooLarge(u64),
}

/// All accounts by name.
#[derive(Debug, Clone, Default)]
pub struct Ledger {
    accounts: BTreeMap<String, Account>,
}

impl Ledger {
    /// Opens account `name`, or finds it open on the same terms.
    ///
    /// # Errors
    /// When it is open on other terms, or the budget exceeds [`MAX_BUDGET`].
    pub fn open(&mut self, name: &str, terms: Terms) -> Result<Balance, BudgetError> {
        if terms.budget > MAX_BUDGET {
            return Err(BudgetError::BudgetTooLarge(terms.budget));
        }
        match self.accounts.entry(name.to_owned()) {
            Entry::Vacant(vacant) => Ok(vacant.insert(Account::new(terms)).balance()),
            Entry::Occupied(account) if account.get().terms() == terms => {
                Ok(account.get().balance())
            }
            Entry::Occupied(account) => Err(BudgetError::OtherTerms {
                name: name.to_owned(),
                open: account.get().terms(),
                asked: terms,
            }),
        }
    }

    /// The account called `name`.
    ///
    /// # Errors
    /// When nobody opened it.
    pub fn account(&self, name: &str) -> Result<&Account, BudgetError> {
        self.accounts.get(name).ok_or_else(|| BudgetError::UnknownAccount(name.to_owned()))
    }

    /// The account called `name`, to charge it.
    ///
    /// # Errors
    /// When nobody opened it.
    pub fn account_mut(&mut self, name: &str) -> Result<&mut Account, BudgetError> {
        self.accounts.get_mut(name).ok_or_else(|| BudgetError::UnknownAccount(name.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TERMS: Terms = Terms { budget: 10, strategy: Strategy::EarlyAdvising };

    #[test]
    fn an_account_is_opened_once() {
        let mut ledger = Ledger::default();
        let fresh = Balance { terms: TERMS, spent: 0, leased: 0, left: 10 };
        assert_eq!(ledger.open("run", TERMS), Ok(fresh));
        ledger.account_mut("run").unwrap().charge(1, 0, Wish { first: true, second: true });
        assert_eq!(ledger.open("run", TERMS), Ok(Balance { spent: 1, left: 9, ..fresh }));
    }

    #[test]
    fn other_terms_are_refused_with_both_named() {
        let mut ledger = Ledger::default();
        ledger.open("run", TERMS).unwrap();
        let asked = Terms { budget: 11, strategy: Strategy::MistakeQ { threshold: 0.05 } };
        let message = ledger.open("run", asked).unwrap_err().to_string();
        let expected = "account \"run\" is open with budget 10 and strategy ea, not with budget 11 and strategy mc-q:0.05";
        assert_eq!(message, expected);
    }

    #[test]
    fn the_largest_budget_is_ten_to_the_twelve() {
        let mut ledger = Ledger::default();
        assert!(ledger.open("run", Terms { budget: MAX_BUDGET, ..TERMS }).is_ok());
        let too_large = Terms { budget: MAX_BUDGET + 1, ..TERMS };
        assert_eq!(
            ledger.open("more", too_large),
            Err(BudgetError::BudgetTooLarge(MAX_BUDGET + 1))
        );
        assert_eq!(
            ledger.account("more").unwrap_err(),
            BudgetError::UnknownAccount("more".to_owned())
        );
    }
}
