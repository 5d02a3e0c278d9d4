//! The learner's side of the advice budget: an account for the run, leases for its rounds, and the comparison of what
//! episodes claim with what the account was charged.

mod audit;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tandem_core::Episode;
use tandem_net::{AuthChannel, Backoff, ClientConfig, ClientConfigError, Operation, retry, within};
use tandem_proto::pb;
use tandem_proto::pb::teacher_client::TeacherClient;
use tandem_telemetry::events::AdviceAccountOpened;
use tokio_util::sync::{CancellationToken, DropGuard};
use tonic::{Code, Status};
use tracing::warn;

use crate::runtime::Runtime;
use crate::warnings::{Source, Warnings};
use audit::{Audit, Cost, Statement};

/// Deadline of a call.
const CALL_DEADLINE: Duration = Duration::from_secs(5);
/// The pauses before a failed call is repeated.
const BACKOFF: Backoff =
    Backoff { first_pause: Duration::from_millis(100), max_pause: Duration::from_secs(1) };
/// How often it is looked whether the teacher still knows the account: workers whose account is lost wait until it is
/// opened again.
const LOOK_EVERY: Duration = Duration::from_secs(1);

/// What the learner needs of a teacher that does not come from its own configuration.
#[derive(Debug, thiserror::Error)]
pub enum TeacherError {
    /// Not an address.
    #[error("the teacher cannot be called")]
    Address(#[from] ClientConfigError),
    /// The teacher understood and declined; asking again would not help.
    #[error("the teacher refuses to {what}: {reason}")]
    Refused {
        /// What was asked for.
        what: &'static str,
        /// What it said.
        reason: String,
    },
    /// The teacher does not know the account.
    #[error("the teacher does not know the account: {0}")]
    UnknownAccount(String),
    /// The run was stopped while the teacher could not be reached.
    #[error("stopped while waiting for the teacher")]
    Stopped,
}

impl TeacherError {
    /// The error of a call that repetition does not cure.
    fn of(what: &'static str, status: &Status) -> Self {
        let reason = status.message().to_owned();
        match status.code() {
            Code::NotFound => Self::UnknownAccount(reason),
            _ => Self::Refused { what, reason },
        }
    }
}

/// Where a run stands when its account is opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Run {
    /// At its beginning.
    New,
    /// On its way; it has learned from so many units of advice.
    Resumed {
        /// Units.
        spent: u64,
    },
}

/// Units set aside for an episode: the most that it can claim.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Allowance {
    /// The episode's number.
    pub(crate) episode: u64,
    /// Units.
    pub(crate) units: u32,
}

/// What the settled episodes of a round cost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Settled {
    /// Units that count as spent by the run.
    pub(crate) units: u64,
    /// What the episodes claim and what the account was charged for them, when the claim cannot be true.
    pub(crate) mismatch: Option<Mismatch>,
}

/// A claim that the teacher's account contradicts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Mismatch {
    /// Units that the episodes claim.
    pub(crate) claimed: u64,
    /// Units that the account was charged.
    pub(crate) charged: u64,
}

/// An account at a teacher, used from the thread that learns.
#[derive(Debug)]
pub(crate) struct Ledger {
    client: TeacherClient<AuthChannel>,
    runtime: Runtime,
    shutdown: CancellationToken,
    /// What the run file says.
    terms: pb::OpenAccountRequest,
    units_per_episode: u32,
    /// Advised episodes whose leases are open.
    under_way: Vec<u64>,
    /// The budget that an account of this name has unless it was lost and opened anew.
    full_budget: u64,
    audit: Audit,
    /// Whether the teacher was seen not to know the account.
    lost: Arc<AtomicBool>,
    _watch: DropGuard,
}

impl Ledger {
    /// Opens the account that `terms` name, or goes on with it when it exists.
    pub(crate) fn open(
        (dial, address): (&ClientConfig, &str),
        terms: &pb::OpenAccountRequest,
        units_per_episode: u32,
        (run, warnings): (Run, &Warnings),
        (runtime, shutdown): (&Runtime, &CancellationToken),
    ) -> Result<Self, TeacherError> {
        let inside = runtime.enter();
        let client = TeacherClient::new(dial.channel(address)?);
        drop(inside);
        let (lost, stop_watching) = (Arc::new(AtomicBool::new(false)), CancellationToken::new());
        let mut ledger = Self {
            client: client.clone(),
            runtime: runtime.clone(),
            shutdown: shutdown.clone(),
            terms: terms.clone(),
            units_per_episode,
            under_way: Vec::new(),
            full_budget: terms.budget,
            audit: Audit::new(Statement { spent: 0, leased: 0 }, 0, true),
            lost: lost.clone(),
            _watch: stop_watching.clone().drop_guard(),
        };
        match run {
            Run::New => ledger.open_account(terms.budget, 0)?,
            Run::Resumed { spent } => ledger.resume(spent)?,
        }
        let watch = watch_account(client, ledger.terms.name.clone(), lost, warnings.clone());
        runtime.spawn(async move {
            tokio::select! {
                () = watch => (),
                () = stop_watching.cancelled() => (),
            }
        });
        Ok(ledger)
    }

    /// The name under which workers ask.
    pub(crate) fn account(&self) -> &str {
        &self.terms.name
    }

    /// Sets units aside for a round's advised episodes, in their order, and gives them. `spent` is what the run has
    /// learned from.
    pub(crate) fn open_leases(
        &mut self,
        episodes: Vec<u64>,
        spent: u64,
    ) -> Result<Vec<Allowance>, TeacherError> {
        if episodes.is_empty() {
            return Ok(Vec::new());
        }
        let opened = match self.call_open_leases(&episodes) {
            Err(TeacherError::UnknownAccount(_)) => {
                self.find_account(spent)?;
                self.renew_leases()?;
                self.call_open_leases(&episodes)?
            }
            opened => opened?,
        };
        self.under_way.extend(episodes);
        if let Some(account) = &opened.account {
            let units = opened.leases.iter().map(|lease| u64::from(lease.units)).sum();
            self.audit.leases_opened(units, statement(account));
        }
        Ok(self.allowances(&opened.leases))
    }

    /// What the episodes of `leases` can claim. In an account that was opened anew workers may have been charged before
    /// the lease was there, so leases bound nothing.
    fn allowances(&self, leases: &[pb::Lease]) -> Vec<Allowance> {
        let allowance =
            |lease: &pb::Lease| Allowance { episode: lease.episode, units: lease.units };
        if self.audit.is_whole() { leases.iter().map(allowance).collect() } else { Vec::new() }
    }

    /// Returns the unspent units of finished episodes to the budget and gives what they cost. `spent` is what the run
    /// has learned from, them not counted. No other episode may be under way.
    pub(crate) fn settle(
        &mut self,
        episodes: &[Episode],
        spent: u64,
    ) -> Result<Settled, TeacherError> {
        let numbers: Vec<u64> = episodes.iter().map(|episode| episode.number).collect();
        self.under_way.retain(|number| !numbers.contains(number));
        let request =
            pb::SettleLeasesRequest { account: self.terms.name.clone(), episodes: numbers };
        let settled = self.call("settle leases", move |mut client| {
            let request = request.clone();
            async move { client.settle_leases(request).await }
        });
        let claimed = episodes.iter().map(|episode| u64::from(episode.advice_charged)).sum();
        match settled {
            Err(TeacherError::UnknownAccount(_)) => {
                self.find_account(spent + claimed)?;
                self.renew_leases()?;
                Ok(Settled { units: claimed, mismatch: None })
            }
            settled => {
                let Cost { units, instead } = self.audit.settled(claimed, statement(&settled?));
                let mismatch = instead.map(|charged| Mismatch { claimed, charged });
                Ok(Settled { units, mismatch })
            }
        }
    }

    /// Whether the teacher was seen not to know the account.
    pub(crate) fn is_lost(&self) -> bool {
        self.lost.load(Ordering::Relaxed)
    }

    /// Opens the account again when the teacher has lost it. `spent` is what the run has learned from.
    pub(crate) fn mend(&mut self, spent: u64) -> Result<(), TeacherError> {
        if self.lost.swap(false, Ordering::Relaxed) {
            self.find_account(spent)?;
            self.renew_leases()?;
        }
        Ok(())
    }

    /// Finds the account, or opens one under another name when more is left in it than the run may spend: a ledger
    /// that was put back to an earlier state. Nobody asks under the old name yet.
    fn resume(&mut self, spent: u64) -> Result<(), TeacherError> {
        let left = self.terms.budget.saturating_sub(spent);
        match self.balance()? {
            Some(found) if units_left(&found) > left => {
                let name = format!("{}.from-{spent}", self.terms.name);
                warn!(
                    account = self.terms.name,
                    name, left, "spending is forgotten, another account"
                );
                self.terms.name = name;
                self.full_budget = left;
                self.open_account(left, spent)
            }
            _ => self.find_account(spent),
        }
    }

    /// Goes on with the account, or opens one of what is left when the teacher knows none.
    ///
    /// What episodes under way were charged is not known here, so as much as they may have been is written off: a
    /// budget is never overspent.
    fn find_account(&mut self, spent: u64) -> Result<(), TeacherError> {
        let written_off = self.under_way.len() as u64 * u64::from(self.units_per_episode);
        let left = self.terms.budget.saturating_sub(spent);
        let name = self.terms.name.clone();
        match self.balance()? {
            Some(found) if units_left(&found) <= left => {
                if found.budget < self.terms.budget {
                    let (got, asked) = (found.budget, self.terms.budget);
                    warn!(account = name, budget = got, asked, "going on with a smaller account");
                }
                self.open_account(found.budget.min(self.terms.budget), spent)
            }
            Some(found) => {
                let has = units_left(&found);
                let reason = format!("{name:?} has {has} units left, the run may spend {left}");
                Err(TeacherError::Refused { what: "continue the account", reason })
            }
            None => {
                let budget = left.saturating_sub(written_off);
                warn!(account = name, budget, "the teacher has lost the account, opening it anew");
                self.open_account(budget, spent)
            }
        }
    }

    /// Opens the leases of episodes under way at a teacher that may have forgotten them; it keeps those that it knows.
    fn renew_leases(&self) -> Result<(), TeacherError> {
        if self.under_way.is_empty() {
            return Ok(());
        }
        self.call_open_leases(&self.under_way).map(drop)
    }

    /// Opens the account with `budget`, or finds it open, and begins to compare with it; the run has learned from
    /// `learned` units.
    fn open_account(&mut self, budget: u64, learned: u64) -> Result<(), TeacherError> {
        let terms = pb::OpenAccountRequest { budget, ..self.terms.clone() };
        let account = self.call("open the account", move |mut client| {
            let request = terms.clone();
            async move { client.open_account(request).await }
        })?;
        let pb::Account { name, budget, strategy, spent, .. } = &account;
        AdviceAccountOpened { account: name, budget: *budget, spent: *spent, strategy }.emit();
        let may_spend = self.terms.budget.saturating_sub(learned);
        let ahead = may_spend.saturating_sub(units_left(&account));
        self.audit = Audit::new(statement(&account), ahead, *budget == self.full_budget);
        Ok(())
    }

    /// How the account stands; `None` when the teacher does not know it.
    fn balance(&self) -> Result<Option<pb::Account>, TeacherError> {
        let request = pb::GetAccountRequest { name: self.terms.name.clone() };
        let account = self.call("look at the account", move |mut client| {
            let request = request.clone();
            async move { client.get_account(request).await }
        });
        match account {
            Ok(account) => Ok(Some(account)),
            Err(TeacherError::UnknownAccount(_)) => Ok(None),
            Err(error) => Err(error),
        }
    }

    fn call_open_leases(&self, episodes: &[u64]) -> Result<pb::OpenLeasesResponse, TeacherError> {
        let request = pb::OpenLeasesRequest {
            account: self.terms.name.clone(),
            episodes: episodes.to_vec(),
            units_per_episode: self.units_per_episode,
        };
        self.call("open leases", move |mut client| {
            let request = request.clone();
            async move { client.open_leases(request).await }
        })
    }

    /// Calls until the teacher answers or the run is stopped. What is asked may be asked again.
    fn call<T, F>(
        &self,
        what: &'static str,
        request: impl Fn(TeacherClient<AuthChannel>) -> F + Send + 'static,
    ) -> Result<T, TeacherError>
    where
        T: Send + 'static,
        F: Future<Output = Result<tonic::Response<T>, Status>> + Send,
    {
        let (client, shutdown) = (self.client.clone(), self.shutdown.clone());
        let call = async move {
            let operation = Operation { peer: "teacher", purpose: what };
            let answered =
                retry(BACKOFF, CALL_DEADLINE, operation, move || request(client.clone()));
            tokio::select! {
                answer = answered => answer.map_err(|status| TeacherError::of(what, &status)),
                () = shutdown.cancelled_owned() => Err(TeacherError::Stopped),
            }
        };
        let answer = self.runtime.wait_on(call).unwrap_or(Err(TeacherError::Stopped));
        answer.map(tonic::Response::into_inner)
    }
}

const fn units_left(account: &pb::Account) -> u64 {
    account.budget.saturating_sub(account.spent)
}

const fn statement(account: &pb::Account) -> Statement {
    Statement { spent: account.spent, leased: account.leased }
}

/// Sets `lost` whenever the teacher answers that it does not know the account, and passes on its warning.
async fn watch_account(
    mut client: TeacherClient<AuthChannel>,
    name: String,
    lost: Arc<AtomicBool>,
    warnings: Warnings,
) {
    loop {
        tokio::time::sleep(LOOK_EVERY).await;
        let look = client.get_account(pb::GetAccountRequest { name: name.clone() });
        match within(CALL_DEADLINE, look).await {
            Ok(account) => warnings.set(Source::Teacher, &account.into_inner().warning),
            Err(status) if status.code() == Code::NotFound => lost.store(true, Ordering::Relaxed),
            Err(_) => {}
        }
    }
}
