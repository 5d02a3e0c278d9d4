//! Where accounts are kept: one trait, whatever remembers them.
//!
//! What an operation means is said by [`crate::budget`]; a ledger makes it durable and lets several clients at it.
//! [`open()`] picks one by name: [`MemoryLedger`] forgets, [`SqliteLedger`] keeps accounts in a file that one teacher
//! owns, [`RedisLedger`] on a server that several teachers share.

mod memory;
mod redis;
mod sqlite;

use std::path::{Path, PathBuf};

use tandem_core::layout::EPISODE_STEPS;

use crate::budget::{Account, Balance, BudgetError, Lease, MAX_BUDGET, Terms, Verdict, Wish};

pub use memory::MemoryLedger;
pub use redis::RedisLedger;
pub use sqlite::SqliteLedger;

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

/// Why a ledger does not do what it is asked.
#[derive(Debug, thiserror::Error)]
pub enum LedgerError {
    /// The account is unknown, or not as asked for. Nothing has changed.
    #[error(transparent)]
    Budget(#[from] BudgetError),
    /// A step lies beyond the end of an episode that has a lease. Nothing has changed.
    #[error("charge {charge_idx} is for a step beyond the end of an episode that has a lease")]
    BeyondEnd {
        /// Which of the bill's charges.
        charge_idx: usize,
    },
    /// What remembers the accounts cannot be reached or written. Asking again may help and does no harm: if the
    /// operation was done after all, it is not done twice.
    #[error("the ledger cannot be used now: {what}{}", because(source.as_deref()))]
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

    /// Why nothing can be charged, if the last attempt to write failed. For ledgers that answer [`Self::balance`] all the
    /// same.
    fn warning(&self) -> Option<&str> {
        None
    }
}

/// Why a ledger cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The name means no ledger.
    #[error(
        "expected memory, redis://[USER:PASSWORD@]HOST[:PORT][/DB] or a file as the ledger: {0}"
    )]
    NotAPlace(String),
    /// Another ledger has the file open, in another process or in this one. It may be free a moment later.
    #[error(
        "another teacher uses the ledger {0:?}: end that one, or give this one a ledger of its own"
    )]
    InUse(PathBuf),
    /// No ledger can be kept under this name.
    #[error("cannot keep a ledger at {path:?}: {what}")]
    BadPath {
        /// The name.
        path: PathBuf,
        /// What is wrong with it.
        what: String,
    },
    /// The file cannot be read or written.
    #[error("cannot open the ledger {path:?}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file is something else.
    #[error("{path:?} is no ledger but {found}: move it away or name another file")]
    NotALedger {
        /// The file.
        path: PathBuf,
        /// What it is.
        found: &'static str,
    },
    /// Another version of this program made the file.
    #[error(
        "the ledger {path:?} has version {found}, this program reads versions 1 to {newest}: use the program that wrote it, or name another file"
    )]
    Version {
        /// The file.
        path: PathBuf,
        /// Its version.
        found: i64,
        /// The newest version that can be read.
        newest: i64,
    },
    /// The file was a ledger.
    #[error(
        "the ledger {path:?} is damaged ({what}): put a copy in its place, or move it away to begin with no accounts"
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// How that shows.
        what: String,
    },
    /// The server cannot be reached or does not let us in.
    #[error("cannot use the ledger {server}")]
    Server {
        /// Where it should be, without the password.
        server: String,
        /// Why.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
}

/// Opens the ledger called `place`: `memory`, `redis://[USER:PASSWORD@]HOST[:PORT][/DB]`, or else a file, which is
/// made when there is none.
///
/// # Errors
/// When the name means nothing, when the file is not a ledger of this version or is in use, or when the server cannot
/// be reached.
pub fn open(place: &str) -> Result<Box<dyn Ledger>, OpenError> {
    if place == "memory" {
        tracing::info!("accounts are kept in memory and forgotten when this process ends");
        return Ok(Box::new(MemoryLedger::default()));
    }
    if place.starts_with("redis://") {
        return Ok(Box::new(RedisLedger::open(place)?));
    }
    if let Some((scheme, _)) = place.split_once("://") {
        let told = if scheme == "rediss" {
            "rediss:// is not spoken here, reach a server with TLS through a tunnel".to_owned()
        } else {
            format!("there is no ledger of the kind {scheme:?}")
        };
        return Err(OpenError::NotAPlace(told));
    }
    if place.is_empty() {
        return Err(OpenError::NotAPlace("the name is empty".to_owned()));
    }
    Ok(Box::new(SqliteLedger::open(Path::new(place))?))
}

/// Refuses a budget that no account may have.
fn check_budget(terms: Terms) -> Result<(), BudgetError> {
    if terms.budget > MAX_BUDGET {
        return Err(BudgetError::BudgetTooLarge(terms.budget));
    }
    Ok(())
}

/// Refuses to open account `name` on other terms than those it is open on.
fn check_terms(name: &str, open: Terms, asked: Terms) -> Result<(), BudgetError> {
    if open != asked {
        return Err(BudgetError::OtherTerms { name: name.to_owned(), open, asked });
    }
    Ok(())
}

fn unknown_account(name: &str) -> LedgerError {
    BudgetError::UnknownAccount(name.to_owned()).into()
}

/// Makes all of `charges`, or refuses all of them.
fn charge_all(account: &mut Account, charges: &[Charge]) -> Result<Receipt, LedgerError> {
    if let Some(charge_idx) = charges.iter().position(|charge| is_beyond(account, charge)) {
        return Err(LedgerError::BeyondEnd { charge_idx });
    }
    let charge = |charge: &Charge| account.charge(charge.episode, charge.step, charge.wish);
    let verdicts = charges.iter().map(charge).collect();
    Ok(Receipt { verdicts, left: account.left() })
}

/// Episodes of a run, which have leases, have [`EPISODE_STEPS`] steps; how long others are is their owner's matter.
fn is_beyond(account: &Account, charge: &Charge) -> bool {
    is_beyond_episode(charge.step) && account.has_lease(charge.episode)
}

fn is_beyond_episode(step: u32) -> bool {
    usize::try_from(step).map_or(true, |step| step >= EPISODE_STEPS)
}

/// What an error's source adds to its message.
fn because(source: Option<&(dyn std::error::Error + Send + Sync)>) -> String {
    source.map(|source| format!(": {}", printable(&source.to_string()))).unwrap_or_default()
}

/// Characters of a foreign text that are shown.
const MAX_SHOWN_CHARS: usize = 300;

/// The beginning of a text that comes from a file or a server, on one line and without control characters.
fn printable(text: &str) -> String {
    let mut shown = String::new();
    for character in text.chars().take(MAX_SHOWN_CHARS) {
        match character {
            '"' | '\'' | '\\' => shown.push(character),
            _ => shown.extend(character.escape_debug()),
        }
    }
    shown
}
