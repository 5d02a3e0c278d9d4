//! The advice budget: accounts, leases and charges, as plain data.
//!
//! An account never spends more than its budget. It remembers its verdict on each step, so a step is charged at most
//! once and a repeated request gets the same verdict. Units are numbered in the order in which they are assigned, which
//! for leases is the order of the episodes. Therefore the advised steps, and the half of the budget that pays for each
//! of them, do not depend on the order in which the steps of different episodes arrive.

mod account;
mod transaction;
mod verdict_bits;

pub use account::Account;
pub(crate) use account::LeaseRecord;
pub(crate) use transaction::{Changes, Transaction};
pub(crate) use verdict_bits::{VerdictBits, VerdictIndex};

pub use crate::strategy::BudgetHalf;
use crate::strategy::Strategy;

/// The largest budget of an account, in units.
pub const MAX_BUDGET: u64 = 1_000_000_000_000;

/// The budget and the strategy of an account. They never change.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AccountTerms {
    /// Units of advice, at most [`MAX_BUDGET`]: the paper's `n_b`.
    pub budget: u64,
    /// Decides which steps are worth a unit.
    pub strategy: Strategy,
}

/// The state of an account, in units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Balance {
    /// Budget and strategy.
    pub terms: AccountTerms,
    /// Units charged.
    pub spent: u64,
    /// Unspent units of open leases.
    pub leased: u64,
    /// `budget − spent − leased`.
    pub left: u64,
}

/// Units reserved for one episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Lease {
    /// The episode's number.
    pub episode: u64,
    /// Units reserved.
    pub units: u32,
    /// The number of these units that lie in the first half of the budget. They are spent first.
    pub early_units: u32,
}

/// Some of the halves of a budget.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BudgetHalves {
    /// True if the first half is among them.
    pub first: bool,
    /// True if the second half is among them.
    pub second: bool,
}

impl BudgetHalves {
    /// Neither half.
    pub const NONE: Self = Self { first: false, second: false };
    /// Both halves.
    pub const BOTH: Self = Self { first: true, second: true };

    /// Returns true if `half` is among them.
    #[must_use]
    pub const fn contains(self, half: BudgetHalf) -> bool {
        match half {
            BudgetHalf::First => self.first,
            BudgetHalf::Second => self.second,
        }
    }

    /// Returns the halves that are among these or among `others`.
    #[must_use]
    pub const fn union(self, others: Self) -> Self {
        Self { first: self.first || others.first, second: self.second || others.second }
    }
}

/// One step that may cost a unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Charge {
    /// The episode's number.
    pub episode: u64,
    /// The step, from 0.
    pub step: u32,
    /// The halves of the budget in which the strategy would override an arm, so that the step is worth a unit.
    pub wanted_in: BudgetHalves,
}

/// The reason why an account cannot be opened or used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BudgetError {
    /// No account has this name.
    #[error("unknown account {0:?}: open it first")]
    UnknownAccount(String),
    /// The account is open with another budget or strategy.
    #[error(
        "account {name:?} is open with budget {} and strategy {}, not with budget {} and strategy {}",
        open.budget, open.strategy, requested.budget, requested.strategy
    )]
    OtherTerms {
        /// The account's name.
        name: String,
        /// The terms of the account.
        open: AccountTerms,
        /// The terms of the request.
        requested: AccountTerms,
    },
    /// The budget exceeds [`MAX_BUDGET`].
    #[error("budget: expected 0 to {MAX_BUDGET}, got {0}")]
    BudgetTooLarge(u64),
}

#[cfg(test)]
mod tests;
