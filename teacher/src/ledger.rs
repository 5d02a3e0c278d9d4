//! Where accounts are kept: one trait, whatever remembers them.
//!
//! What an operation means is said by [`crate::budget`]; a ledger makes it durable and lets several clients at it.

mod memory;

use crate::budget::{Balance, BudgetError, Lease, Terms, Verdict, Wish};

pub use memory::MemoryLedger;

/// One step that may cost a unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Charge {
    /// The step's episode.
    pub episode: u64,
    /// Its number in the episode.
    pub step: u32,
    /// Whether it is worth a unit.
    pub wish: Wish,
}

/// The charges of one request: all of them are made, in their order, or none is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Bill {
    /// The account's name.
    pub account: String,
    /// At least one.
    pub charges: Vec<Charge>,
}

/// What became of a bill.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Receipt {
    /// By charge.
    pub verdicts: Vec<Verdict>,
    /// Units neither spent nor set aside after the bill.
    pub left: u64,
}

/// Why a ledger does not do what it is asked. Nothing has then changed.
#[derive(Debug, thiserror::Error)]
pub enum LedgerError {
    /// The account is unknown, or not as asked for.
    #[error(transparent)]
    Budget(#[from] BudgetError),
    /// A step lies beyond the end of an episode that has a lease.
    #[error("charge {charge_idx} is for a step beyond the end of an episode that has a lease")]
    BeyondEnd {
        /// Which of the bill's charges.
        charge_idx: usize,
    },
    /// What remembers the accounts cannot be reached or written; asking again may help.
    #[error("the ledger cannot be used now: {what}")]
    Unavailable {
        /// What failed.
        what: String,
        /// Why, when something else says so.
        source: Option<Box<dyn std::error::Error + Send + Sync>>,
    },
}

/// All accounts by name. Whatever an operation has answered survives the end of the process, however it ends, unless
/// the implementation says otherwise. Every operation may be repeated.
pub trait Ledger: Send {
    /// Opens account `name`, or finds it open on the same terms.
    ///
    /// # Errors
    /// When it is open on other terms, or the budget is too large.
    fn open(&mut self, name: &str, terms: Terms) -> Result<Balance, LedgerError>;

    /// How account `name` stands.
    ///
    /// # Errors
    /// When nobody opened it.
    fn balance(&mut self, name: &str) -> Result<Balance, LedgerError>;

    /// Sets aside units for `episodes`, in their order; see [`crate::budget::Account::open_leases`].
    ///
    /// # Errors
    /// When nobody opened the account.
    fn open_leases(
        &mut self,
        name: &str,
        episodes: &[u64],
        units_per_episode: u32,
    ) -> Result<(Vec<Lease>, Balance), LedgerError>;

    /// Returns what `episodes` did not spend; see [`crate::budget::Account::settle`].
    ///
    /// # Errors
    /// When nobody opened the account.
    fn settle(&mut self, name: &str, episodes: &[u64]) -> Result<Balance, LedgerError>;

    /// Charges `bills` in their order, each by itself; see [`crate::budget::Account::charge`]. One outcome per bill.
    fn charge(&mut self, bills: &[Bill]) -> Vec<Result<Receipt, LedgerError>>;
}
