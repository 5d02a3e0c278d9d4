//! Accounts on a Redis server, where several teachers share them.
//!
//! Nothing is kept here: every operation is a script that the server runs from beginning to end, and all keys of an
//! account have one hash tag. [`crate::budget::Account`] says what the scripts in `redis/` do; the tests hold them to
//! it. A script may be run again when its answer was lost.
//!
//! What survives is the server's matter. With an append-only file a killed server loses next to nothing, and after a
//! loss of power, or when a replica takes over, the last second may be missing (`appendfsync everysec`). What was
//! forgotten is then as [`super::SqliteLedger`] says of charges. Without such a file everything since the last snapshot
//! is lost, hence the warning.

mod server;

use super::{
    Bill, Charge, Ledger, LedgerError, OpenError, Receipt, check_budget, check_terms,
    is_beyond_episode, printable, unknown_account,
};
use crate::budget::{Balance, Half, Lease, Terms, Verdict};
use crate::strategy::UnknownStrategy;
use server::{Call, Reply, Script, Server};

/// Steps whose verdicts share a field.
const STEPS_PER_FIELD: u32 = 64;

/// Accounts on a Redis server.
#[derive(Debug)]
pub struct RedisLedger {
    server: Server,
}

impl RedisLedger {
    /// Connects to the server at `url`, `redis://[USER:PASSWORD@]HOST[:PORT][/DB]`.
    ///
    /// # Errors
    /// When the URL is no such URL, or the server cannot be reached or does not let us in.
    pub fn open(url: &str) -> Result<Self, OpenError> {
        let mut server = Server::at(url)?;
        let refused = |server: &Server, source: redis::RedisError| OpenError::Server {
            server: server.name().to_owned(),
            source: printable(&source.to_string()).into(),
        };
        let survey = server.survey().map_err(|error| refused(&server, error))?;
        tracing::info!(ledger = server.name(), accounts = survey.n_accounts, "ledger opened");
        if !survey.appends {
            tracing::warn!(
                ledger = server.name(),
                "the server has no append-only file: what it is not asked to save is lost when it ends; see its setting appendonly"
            );
        }
        if survey.evicts {
            tracing::warn!(
                ledger = server.name(),
                "the server drops keys when its memory is full: set its maxmemory-policy to noeviction"
            );
        }
        Ok(Self { server })
    }

    /// Makes one call.
    fn call(&mut self, call: Call) -> Result<Reply, LedgerError> {
        let mut replies = self.calls(&[call])?;
        replies.pop().ok_or_else(|| self.garbled("no reply"))
    }

    fn calls(&mut self, calls: &[Call]) -> Result<Vec<Reply>, LedgerError> {
        self.server.run(calls).map_err(|error| self.unavailable(error))
    }

    fn unavailable(&self, error: redis::RedisError) -> LedgerError {
        let what = format!("cannot use {}", self.server.name());
        LedgerError::Unavailable { what, source: Some(Box::new(error)) }
    }

    /// What the reply says of account `name`.
    fn balance_in(&self, name: &str, reply: &Reply) -> Result<Balance, LedgerError> {
        let [budget, strategy, spent, leased] = match reply.fields.as_slice() {
            [] => return Err(unknown_account(name)),
            [Some(budget), Some(strategy), Some(spent), Some(leased)] => {
                [budget, strategy, spent, leased]
            }
            _ => return Err(self.garbled("an account without a budget")),
        };
        let units = |text: &String| text.parse::<u64>().map_err(|_not_a_number| self.garbled(text));
        let strategy = strategy.parse().map_err(|error: UnknownStrategy| self.garbled(&error.0))?;
        let (budget, spent, leased) = (units(budget)?, units(spent)?, units(leased)?);
        let handed_out = spent.checked_add(leased).and_then(|units| budget.checked_sub(units));
        let left = handed_out.ok_or_else(|| self.garbled("more spent than the budget"))?;
        Ok(Balance { terms: Terms { budget, strategy }, spent, leased, left })
    }

    fn receipt(&self, bill: &Bill, reply: &Reply) -> Result<Receipt, LedgerError> {
        let balance = self.balance_in(&bill.account, reply)?;
        if let Some(charge_idx) = reply.refused.first() {
            let charge_idx = usize::try_from(*charge_idx).unwrap_or(usize::MAX);
            return Err(LedgerError::BeyondEnd { charge_idx });
        }
        let verdict = |number: &u64| match number {
            0 => Ok(Verdict::Uncharged),
            1 => Ok(Verdict::Charged(Half::First)),
            2 => Ok(Verdict::Charged(Half::Second)),
            _ => Err(self.garbled("a verdict that there is not")),
        };
        let verdicts = reply.numbers.iter().map(verdict).collect::<Result<Vec<_>, _>>()?;
        if verdicts.len() != bill.charges.len() {
            return Err(self.garbled("not one verdict a charge"));
        }
        Ok(Receipt { verdicts, left: balance.left })
    }

    /// The server holds or says what no ledger has written.
    fn garbled(&self, what: &str) -> LedgerError {
        let what = format!("{} holds what is no ledger: {what:?}", self.server.name());
        LedgerError::Unavailable { what, source: None }
    }
}

impl Ledger for RedisLedger {
    fn open(&mut self, name: &str, terms: Terms) -> Result<Balance, LedgerError> {
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
        let units = units.map_err(|_too_large| self.garbled("a lease that is too large"))?;
        let leases = episodes.iter().zip(units.as_chunks::<2>().0);
        let leases = leases.map(|(episode, [units, early_units])| Lease {
            episode: *episode,
            units: *units,
            early_units: *early_units,
        });
        let leases: Vec<Lease> = leases.collect();
        if leases.len() != episodes.len() {
            return Err(self.garbled("not one lease an episode"));
        }
        Ok((leases, balance))
    }

    fn settle(&mut self, name: &str, episodes: &[u64]) -> Result<Balance, LedgerError> {
        let reply = self.call(Call::new(Script::Settle, name).args(episodes))?;
        self.balance_in(name, &reply)
    }

    fn charge(&mut self, bills: &[Bill]) -> Vec<Result<Receipt, LedgerError>> {
        let calls: Vec<Call> = bills.iter().map(charge_call).collect();
        match self.server.run(&calls) {
            Ok(replies) => {
                let paid = bills.iter().zip(&replies);
                paid.map(|(bill, reply)| self.receipt(bill, reply)).collect()
            }
            Err(error) => {
                let failed = |_| Err(self.unavailable(error.clone()));
                bills.iter().map(failed).collect()
            }
        }
    }
}

/// See `redis/charge.lua`.
fn charge_call(bill: &Bill) -> Call {
    let mut call = Call::new(Script::Charge, &bill.account);
    for Charge { episode, step, wish } in &bill.charges {
        let digit = |yes: bool| if yes { '1' } else { '0' };
        call = call
            .arg(episode)
            .arg(format_args!("{episode}:{}", step / STEPS_PER_FIELD))
            .arg(step % STEPS_PER_FIELD + 1)
            .arg(format_args!("{}{}", digit(wish.first), digit(wish.second)))
            .arg(digit(is_beyond_episode(*step)));
    }
    call
}
