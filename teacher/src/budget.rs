//! The budget of advice: accounts, leases and charges, as plain data.
//!
//! An account never spends more than its budget, and a step of an episode is charged at most once: its verdict is
//! remembered, so that asking again gives the same one. Units are numbered in the order in which they are handed
//! out, which for leases is the order of the episodes: which steps are advised, and in which half of the budget,
//! does not depend on the order in which the episodes' steps arrive.

mod account;
mod verdicts;

pub use account::Account;
pub(crate) use account::{Changes, Checksum, LeaseRecord};
pub(crate) use verdicts::{Word, WordIndex};

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
