//! Ledgers, which store accounts.
//!
//! [`crate::budget`] defines the operations on an account; a ledger makes them durable. [`open()`] selects a ledger by
//! its location: [`MemoryLedger`] keeps accounts for the life of the process, [`SqliteLedger`] in a file that one
//! teacher owns, and [`RedisLedger`] on a server that several teachers share.

mod memory;
mod redis;
mod sqlite;

use std::path::{Path, PathBuf};

use crate::budget::{
    AccountTerms, Balance, BudgetError, BudgetHalf, Charge, Lease, MAX_BUDGET, Transaction,
};
use crate::strategy::Strategy;

pub use memory::MemoryLedger;
pub use redis::RedisLedger;
pub use sqlite::SqliteLedger;

/// The charges of one request for advice to one account. Either all of them are made, in their order, or none.
#[derive(Debug, Clone, PartialEq)]
pub struct ChargeRequest {
    /// The account's name.
    pub account: String,
    /// The strategy by which the charges were decided. It is not the account's if a server has lost the account and
    /// another teacher has opened it anew.
    pub strategy: Strategy,
    /// Steps of an episode of a run, which has a lease.
    pub episode_steps: u32,
    /// At least one step.
    pub charges: Vec<Charge>,
}

/// The answer to a [`ChargeRequest`].
#[derive(Debug, Clone, PartialEq)]
pub struct ChargeResult {
    /// The verdict on each charge: the half of the budget whose unit the step cost, or `None` if it cost nothing.
    pub verdicts: Vec<Option<BudgetHalf>>,
    /// For each charge, true if its verdict is that of an earlier charge for the same step.
    pub repeated: Vec<bool>,
    /// Units that are neither spent nor leased after the charges.
    pub left: u64,
}

/// The reason why a ledger refuses an operation.
#[derive(Debug, thiserror::Error)]
pub enum LedgerError {
    /// The account is unknown or has other terms. Nothing has changed.
    #[error(transparent)]
    Budget(#[from] BudgetError),
    /// The account has another strategy than the one by which the charges were decided. Nothing has changed. The caller
    /// may repeat the request with charges that are decided by this strategy.
    #[error("account {account:?} now has strategy {strategy}: ask again")]
    OtherStrategy {
        /// The account's name.
        account: String,
        /// The account's strategy.
        strategy: Strategy,
    },
    /// A step lies beyond the end of an episode that has a lease. Nothing has changed.
    #[error("charge {charge_idx} is for a step beyond the end of an episode that has a lease")]
    BeyondEnd {
        /// The index of the charge in its request.
        charge_idx: usize,
    },
    /// The file or the server cannot be used. The caller may repeat the operation: if it was done after all, it is not
    /// done twice.
    #[error("the ledger cannot be used now: {what}{}", cause(source.as_deref()))]
    Unavailable {
        /// The attempt that failed.
        what: String,
        /// The underlying error, if there is one.
        source: Option<Box<dyn std::error::Error + Send + Sync>>,
    },
}

/// Accounts by name.
///
/// An operation that has returned survives the end of the process at any moment, unless the implementation documents
/// otherwise. Every operation may be repeated.
pub trait Ledger: Send {
    /// Opens account `name`, or returns it if it is open with the same terms.
    ///
    /// # Errors
    /// When it is open with other terms, or the budget is too large.
    fn open(&mut self, name: &str, terms: AccountTerms) -> Result<Balance, LedgerError>;

    /// Returns the balance of account `name`.
    ///
    /// # Errors
    /// When the account is not open.
    fn balance(&mut self, name: &str) -> Result<Balance, LedgerError>;

    /// Reserves units for `episodes`, in their order; see [`crate::budget::Account::open_leases`].
    ///
    /// # Errors
    /// When the account is not open.
    fn open_leases(
        &mut self,
        name: &str,
        episodes: &[u64],
        units_per_episode: u32,
    ) -> Result<(Vec<Lease>, Balance), LedgerError>;

    /// Returns the unspent units of `episodes` to the budget; see [`crate::budget::Account::settle`].
    ///
    /// # Errors
    /// When the account is not open.
    fn settle(&mut self, name: &str, episodes: &[u64]) -> Result<Balance, LedgerError>;

    /// Executes `requests` in their order, and returns one result for each; see [`crate::budget::Account::charge`].
    ///
    /// A refused request does not affect the others, unless the ledger cannot be used.
    fn charge(&mut self, requests: &[ChargeRequest]) -> Vec<Result<ChargeResult, LedgerError>>;

    /// Returns the reason why the last attempt to write failed, for ledgers that answer [`Self::balance`] nevertheless.
    fn warning(&self) -> Option<&str> {
        None
    }

    /// Returns true if nothing more can be written until another process opens the ledger, which then has every
    /// answered charge.
    fn needs_restart(&self) -> bool {
        false
    }
}

/// The reason why a ledger cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The location does not name a ledger.
    #[error(
        "expected memory, redis://[USER:PASSWORD@]HOST[:PORT][/DB] or a file as the ledger: {0}"
    )]
    InvalidLocation(String),
    /// Another ledger, in this process or in another one, has the file open. A later attempt may succeed.
    #[error(
        "another teacher uses the ledger {0:?}: end that one, or give this one a ledger of its own"
    )]
    InUse(PathBuf),
    /// The path cannot hold a ledger.
    #[error("cannot keep a ledger at {path:?}: {what}")]
    BadPath {
        /// The path.
        path: PathBuf,
        /// The reason.
        what: String,
    },
    /// The file cannot be read or written.
    #[error("cannot open the ledger {path:?}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The underlying error.
        source: std::io::Error,
    },
    /// The file is not a ledger.
    #[error("{path:?} is no ledger but {found}: move it away or name another file")]
    NotALedger {
        /// The file.
        path: PathBuf,
        /// A description of the file.
        found: &'static str,
    },
    /// A newer version of the program wrote the file.
    #[error(
        "the ledger {path:?} has version {found}, this program reads versions 1 to {newest}: use the program that wrote it, or name another file"
    )]
    Version {
        /// The file.
        path: PathBuf,
        /// The version of the file.
        found: i64,
        /// The newest version that this program reads.
        newest: i64,
    },
    /// The contents of the file are inconsistent.
    #[error(
        "the ledger {path:?} is damaged ({what}): put a copy in its place, or move it away to begin with no accounts"
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// The first inconsistency found.
        what: String,
    },
    /// The server cannot be reached or refuses access.
    #[error("cannot use the ledger {server}")]
    Server {
        /// The server's address, without the password.
        server: String,
        /// The underlying error.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
}

/// Opens the ledger at `location`: `memory`, `redis://[USER:PASSWORD@]HOST[:PORT][/DB]`, or the path of a file, which
/// is created if it does not exist.
///
/// # Errors
/// When the location is invalid, when the file is not a ledger of a known version or is in use, or when the server
/// cannot be reached.
pub fn open(location: &str) -> Result<Box<dyn Ledger>, OpenError> {
    if location == "memory" {
        tracing::info!("accounts are kept in memory and lost when this process ends");
        return Ok(Box::new(MemoryLedger::default()));
    }
    if location.starts_with("redis://") {
        return Ok(Box::new(RedisLedger::open(location)?));
    }
    if let Some((scheme, _)) = location.split_once("://") {
        let reason = if scheme == "rediss" {
            "rediss:// is not supported, reach a server with TLS through a tunnel".to_owned()
        } else {
            format!("there is no ledger of the kind {scheme:?}")
        };
        return Err(OpenError::InvalidLocation(reason));
    }
    if location.is_empty() {
        return Err(OpenError::InvalidLocation("the name is empty".to_owned()));
    }
    Ok(Box::new(SqliteLedger::open(Path::new(location))?))
}

/// Refuses a budget that exceeds [`MAX_BUDGET`].
fn check_budget(terms: AccountTerms) -> Result<(), BudgetError> {
    if terms.budget > MAX_BUDGET {
        return Err(BudgetError::BudgetTooLarge(terms.budget));
    }
    Ok(())
}

/// Refuses to open account `name` with other terms than it is open with.
fn check_terms(name: &str, open: AccountTerms, requested: AccountTerms) -> Result<(), BudgetError> {
    if open != requested {
        return Err(BudgetError::OtherTerms { name: name.to_owned(), open, requested });
    }
    Ok(())
}

/// Refuses charges that were decided by another strategy than the account's.
fn check_strategy(request: &ChargeRequest, strategy: Strategy) -> Result<(), LedgerError> {
    if request.strategy != strategy {
        return Err(LedgerError::OtherStrategy { account: request.account.clone(), strategy });
    }
    Ok(())
}

fn unknown_account(name: &str) -> LedgerError {
    BudgetError::UnknownAccount(name.to_owned()).into()
}

/// Makes all charges of `request`, or refuses all of them.
fn charge_all(
    account: &mut Transaction<'_>,
    request: &ChargeRequest,
) -> Result<ChargeResult, LedgerError> {
    check_strategy(request, account.terms().strategy)?;
    let ChargeRequest { charges, episode_steps, .. } = request;
    let is_beyond_end = |charge: &Charge| is_beyond_end(account, charge, *episode_steps);
    if let Some(charge_idx) = charges.iter().position(is_beyond_end) {
        return Err(LedgerError::BeyondEnd { charge_idx });
    }
    let charged =
        charges.iter().map(|charge| (account.has_verdict(*charge), account.charge(*charge)));
    let (repeated, verdicts) = charged.unzip();
    Ok(ChargeResult { verdicts, repeated, left: account.left() })
}

/// Returns true if the step lies beyond the end of an episode with a lease. Episodes of a run have leases and
/// `episode_steps` steps; other episodes may have any length.
fn is_beyond_end(account: &Transaction<'_>, charge: &Charge, episode_steps: u32) -> bool {
    charge.step >= episode_steps && account.has_lease(charge.episode)
}

/// Formats an error's source for its message.
fn cause(source: Option<&(dyn std::error::Error + Send + Sync)>) -> String {
    source.map(|source| format!(": {}", printable(&source.to_string()))).unwrap_or_default()
}

/// The number of characters of a foreign text that are shown.
const MAX_SHOWN_CHARS: usize = 300;

/// Returns the beginning of a text from a file or a server, on one line and with control characters escaped.
pub(crate) fn printable(text: &str) -> String {
    let mut shown = String::new();
    for character in text.chars().take(MAX_SHOWN_CHARS) {
        match character {
            '"' | '\'' | '\\' => shown.push(character),
            _ => shown.extend(character.escape_debug()),
        }
    }
    shown
}
