//! A ledger on a Redis server, which several teachers can share.
//!
//! The process keeps no accounts: each operation is a script that the server runs atomically, and all keys of an
//! account have one hash tag. [`crate::budget::Account`] defines the scripts in `redis/`; the tests compare them with
//! it. A script may be run again if its reply was lost.
//!
//! Durability depends on the server. With an append-only file a killed server loses next to nothing. A power cut may
//! lose the last second (`appendfsync everysec`; with `always`, nothing), and a failover the operations that the
//! replica has not received. Unlike [`super::SqliteLedger`], which may lose charges only, the server may lose any
//! operation:
//!
//! - An account is unknown then. A learner opens it anew, with the units that its learned episodes leave.
//! - An episode whose lease is lost spends units that are left, in the order of arrival, and may exceed its lease.
//!   Advice then depends on timing.
//! - Units of a settlement that is lost stay leased, and no other episode can spend them.
//! - Lost charges have the consequences that [`super::SqliteLedger`] documents.
//!
//! Without an append-only file everything since the last snapshot is lost, and the ledger logs a warning.

mod server;

use super::{
    ChargeRequest, ChargeResult, Ledger, LedgerError, OpenError, check_budget, check_strategy,
    check_terms, printable, unknown_account,
};
use crate::budget::{AccountTerms, Balance, BudgetHalf, Charge, Lease};
use crate::strategy::UnknownStrategy;
use server::{Call, Reply, Script, Server};

/// Steps whose verdicts share a field of the hash.
const STEPS_PER_FIELD: u32 = 64;
/// The number that the script adds to a verdict that it found.
const KNOWN_OFFSET: u64 = 10;

/// A ledger on a Redis server.
#[derive(Debug)]
pub struct RedisLedger {
    server: Server,
    /// The reason why the last script that writes failed, if it did.
    warning: Option<String>,
}

impl RedisLedger {
    /// Connects to the server at `url`, `redis://[USER:PASSWORD@]HOST[:PORT][/DB]`.
    ///
    /// # Errors
    /// When the URL is invalid, or the server cannot be reached or refuses access.
    pub fn open(url: &str) -> Result<Self, OpenError> {
        let mut server = Server::new(url)?;
        let refused = |server: &Server, source: redis::RedisError| OpenError::Server {
            server: server.name().to_owned(),
            source: printable(&source.to_string()).into(),
        };
        let properties = server.properties().map_err(|error| refused(&server, error))?;
        tracing::info!(ledger = server.name(), accounts = properties.n_accounts, "ledger opened");
        if !properties.has_append_only_file {
            tracing::warn!(
                ledger = server.name(),
                "the server has no append-only file and loses all changes since its last snapshot when it ends; see its setting appendonly"
            );
        }
        if properties.evicts_keys {
            tracing::warn!(
                ledger = server.name(),
                "the server drops keys when its memory is full: set its maxmemory-policy to noeviction"
            );
        }
        Ok(Self { server, warning: None })
    }

    /// Runs one script.
    fn call(&mut self, call: Call) -> Result<Reply, LedgerError> {
        let replies = self.calls(&[call]);
        let mut replies = replies.map_err(|error| self.unavailable(error))?;
        replies.pop().ok_or_else(|| self.invalid("no reply"))
    }

    /// Runs scripts, and stores the failure of those that write as the warning. A script that had nothing to write says
    /// nothing about the next one.
    fn calls(&mut self, calls: &[Call]) -> Result<Vec<Reply>, redis::RedisError> {
        let outcome = self.server.run(calls);
        match &outcome {
            Ok(replies) => {
                if calls.iter().zip(replies).any(|(call, reply)| has_written(call, reply)) {
                    self.report(None);
                }
            }
            Err(error) => {
                if calls.iter().any(|call| call.script() != Script::Balance) {
                    self.report(Some(error));
                }
            }
        }
        outcome
    }

    /// Stores the outcome of scripts that write as the warning, and logs when it differs from the previous one.
    fn report(&mut self, error: Option<&redis::RedisError>) {
        let name = self.server.name();
        let of = |error: &redis::RedisError| {
            format!("cannot write {name}: {}", printable(&error.to_string()))
        };
        let warning = error.map(of);
        match (&self.warning, &warning) {
            (None, Some(warning)) => tracing::error!("nothing can be charged: {warning}"),
            (Some(_), None) => tracing::info!(ledger = name, "the ledger can be written again"),
            _ => {}
        }
        self.warning = warning;
    }

    fn unavailable(&self, error: redis::RedisError) -> LedgerError {
        let what = format!("cannot use {}", self.server.name());
        LedgerError::Unavailable { what, source: Some(Box::new(error)) }
    }

    /// Returns the balance of account `name` from a reply.
    fn balance_in(&self, name: &str, reply: &Reply) -> Result<Balance, LedgerError> {
        let [budget, strategy, spent, leased] = match reply.fields.as_slice() {
            [] => return Err(unknown_account(name)),
            [Some(budget), Some(strategy), Some(spent), Some(leased)] => {
                [budget, strategy, spent, leased]
            }
            _ => return Err(self.invalid("an account without a budget")),
        };
        let units = |text: &String| text.parse::<u64>().map_err(|_not_a_number| self.invalid(text));
        let strategy = strategy.parse().map_err(|error: UnknownStrategy| self.invalid(&error.0))?;
        let (budget, spent, leased) = (units(budget)?, units(spent)?, units(leased)?);
        let left = spent.checked_add(leased).and_then(|assigned| budget.checked_sub(assigned));
        let left = left.ok_or_else(|| self.invalid("more spent than the budget"))?;
        Ok(Balance { terms: AccountTerms { budget, strategy }, spent, leased, left })
    }

    fn charge_result(
        &self,
        request: &ChargeRequest,
        reply: &Reply,
    ) -> Result<ChargeResult, LedgerError> {
        let balance = self.balance_in(&request.account, reply)?;
        check_strategy(request, balance.terms.strategy)?;
        if let Some(charge_idx) = reply.refused.first() {
            let charge_idx = usize::try_from(*charge_idx).unwrap_or(usize::MAX);
            return Err(LedgerError::BeyondEnd { charge_idx });
        }
        let verdict = |number: &u64| match number % KNOWN_OFFSET {
            0 => Ok(None),
            1 => Ok(Some(BudgetHalf::First)),
            2 => Ok(Some(BudgetHalf::Second)),
            _ => Err(self.invalid("an unknown verdict")),
        };
        let verdicts = reply.numbers.iter().map(verdict).collect::<Result<Vec<_>, _>>()?;
        if verdicts.len() != request.charges.len() {
            return Err(self.invalid("not one verdict for each charge"));
        }
        let repeated = reply.numbers.iter().map(|number| *number >= KNOWN_OFFSET).collect();
        Ok(ChargeResult { verdicts, repeated, left: balance.left })
    }

    /// Returns the error for a reply or a value that no ledger writes.
    fn invalid(&self, what: &str) -> LedgerError {
        let what = format!("{} has invalid data: {what:?}", self.server.name());
        LedgerError::Unavailable { what, source: None }
    }
}

impl Ledger for RedisLedger {
    fn open(&mut self, name: &str, terms: AccountTerms) -> Result<Balance, LedgerError> {
        check_budget(terms)?;
        let call = Call::new(Script::Open, name).arg(terms.budget).arg(terms.strategy);
        let reply = self.call(call)?;
        let balance = self.balance_in(name, &reply)?;
        check_terms(name, balance.terms, terms)?;
        Ok(balance)
    }

    fn balance(&mut self, name: &str) -> Result<Balance, LedgerError> {
        let reply = self.call(Call::new(Script::Balance, name))?;
        self.balance_in(name, &reply)
    }

    fn open_leases(
        &mut self,
        name: &str,
        episodes: &[u64],
        units_per_episode: u32,
    ) -> Result<(Vec<Lease>, Balance), LedgerError> {
        let call = Call::new(Script::OpenLeases, name).arg(units_per_episode).args(episodes);
        let reply = self.call(call)?;
        let balance = self.balance_in(name, &reply)?;
        let units = reply.numbers.iter().map(|units| u32::try_from(*units));
        let units = units.collect::<Result<Vec<_>, _>>();
        let units = units.map_err(|_too_large| self.invalid("a lease that is too large"))?;
        let leases = episodes.iter().zip(units.as_chunks::<2>().0);
        let leases = leases.map(|(episode, [units, early_units])| Lease {
            episode: *episode,
            units: *units,
            early_units: *early_units,
        });
        let leases: Vec<Lease> = leases.collect();
        if leases.len() != episodes.len() {
            return Err(self.invalid("not one lease for each episode"));
        }
        Ok((leases, balance))
    }

    fn settle(&mut self, name: &str, episodes: &[u64]) -> Result<Balance, LedgerError> {
        let reply = self.call(Call::new(Script::Settle, name).args(episodes))?;
        self.balance_in(name, &reply)
    }

    fn charge(&mut self, requests: &[ChargeRequest]) -> Vec<Result<ChargeResult, LedgerError>> {
        let calls: Vec<Call> = requests.iter().map(charge_call).collect();
        match self.calls(&calls) {
            Ok(replies) => {
                let answered = requests.iter().zip(&replies);
                answered.map(|(request, reply)| self.charge_result(request, reply)).collect()
            }
            Err(error) => {
                let failed = |_| Err(self.unavailable(error.clone()));
                requests.iter().map(failed).collect()
            }
        }
    }

    fn warning(&self) -> Option<&str> {
        self.warning.as_deref()
    }
}

/// Returns true if the script of `call` has written something before it replied.
fn has_written(call: &Call, reply: &Reply) -> bool {
    match call.script() {
        Script::Open => true,
        Script::Balance => false,
        Script::OpenLeases | Script::Settle => !reply.fields.is_empty(),
        Script::Charge => reply.numbers.iter().any(|number| *number < KNOWN_OFFSET),
    }
}

/// Encodes the arguments of `redis/charge.lua`.
fn charge_call(request: &ChargeRequest) -> Call {
    let mut call = Call::new(Script::Charge, &request.account).arg(request.strategy);
    for charge in &request.charges {
        let Charge { episode, step, wanted_in } = charge;
        let digit = |yes: bool| if yes { '1' } else { '0' };
        let first = digit(wanted_in.first);
        let second = digit(wanted_in.second);
        call = call
            .arg(episode)
            .arg(format_args!("{episode}:{}", step / STEPS_PER_FIELD))
            .arg(step % STEPS_PER_FIELD + 1)
            .arg(format_args!("{first}{second}"))
            .arg(digit(*step >= request.episode_steps));
    }
    call
}
