//! The run's account at the teacher: leases for its rounds, and the comparison of the units that episodes claim with
//! the charges of the account.

mod audit;
mod error;
mod watcher;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tandem_core::task::TaskDifference;
use tandem_core::{Episode, TaskSpec};
use tandem_net::{AuthChannel, Backoff, ClientConfig, Operation, retry};
use tandem_proto::pb::teacher_client::TeacherClient;
use tandem_proto::{decode_task, pb};
use tandem_telemetry::TeacherView;
use tandem_telemetry::events::AdviceAccountOpened;
use tokio::sync::watch;
use tokio_util::sync::{CancellationToken, DropGuard};
use tonic::Status;
use tracing::warn;

use crate::checkpoint::RenamedAccount;
use crate::runtime::Runtime;
use crate::shared::Clock;
use crate::warnings::{Source, Warnings};
use audit::{Audit, Cost, Statement};
pub(crate) use error::TeacherError;
use watcher::{AccountWatcher, warn_of_other_policy};

/// Deadline of a call.
const CALL_DEADLINE: Duration = Duration::from_secs(5);
/// Pauses before a failed call is repeated.
const BACKOFF: Backoff =
    Backoff { first_pause: Duration::from_millis(100), max_pause: Duration::from_secs(1) };

/// The start of a run, for the opening of its account.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum RunStart {
    /// A new run.
    New,
    /// Again, because it ended before its first checkpoint.
    Restarted,
    /// From a checkpoint.
    Resumed {
        /// Units of advice of the episodes that it has learned.
        spent: u64,
    },
}

/// The units reserved for an episode, which is the most that it can claim.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Allowance {
    /// The episode's number.
    pub(crate) episode: u64,
    /// Units.
    pub(crate) units: u32,
}

/// The cost of a round's episodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Settlement {
    /// Units that count as spent.
    pub(crate) units: u64,
    /// Set if the claims of the episodes cannot be true.
    pub(crate) mismatch: Option<Mismatch>,
}

/// Claims that the teacher's account contradicts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Mismatch {
    /// Units that the episodes claim.
    pub(crate) claimed: u64,
    /// Units charged to the account.
    pub(crate) charged: u64,
}

/// Options for [`AdviceAccount::open`].
pub(crate) struct AccountOptions<'a> {
    /// Token and TLS of the calls.
    pub(crate) client_config: &'a ClientConfig,
    /// The teacher's address.
    pub(crate) address: &'a str,
    /// The task of one arm of the run.
    pub(crate) one_arm: &'a TaskSpec,
    /// Name, budget and strategy, from the run file.
    pub(crate) terms: pb::OpenAccountRequest,
    /// The start of the run.
    pub(crate) start: RunStart,
    /// The account of the run's checkpoint, if it has another name than the run.
    pub(crate) renamed: Option<RenamedAccount>,
    /// The digest of the teacher's policy when the run began, if it is known.
    pub(crate) first_policy: Option<String>,
    /// True if the teacher has advised by another policy, too, in earlier parts of the run.
    pub(crate) had_other_policy: bool,
    /// Receives the state of the teacher.
    pub(crate) view: watch::Sender<TeacherView>,
    /// Measures for how long the teacher has not answered.
    pub(crate) clock: Clock,
}

/// The run's account at the teacher, used by the learning thread.
#[derive(Debug)]
pub(crate) struct AdviceAccount {
    client: TeacherClient<AuthChannel>,
    runtime: Runtime,
    shutdown: CancellationToken,
    /// The run's name.
    run: String,
    /// The account's name, and the run's budget and strategy.
    terms: pb::OpenAccountRequest,
    /// Advised episodes whose leases are open.
    open_episodes: Vec<u64>,
    /// The most units that each of them can use.
    units_per_episode: u32,
    /// The budget of an account of this name that was never lost.
    full_budget: u64,
    audit: Audit,
    /// The digest of the teacher's policy when the run began.
    policy: String,
    /// True after the teacher reported that it does not know the account.
    lost: Arc<AtomicBool>,
    _watch: DropGuard,
}

impl AdviceAccount {
    /// Opens the account, or continues with it if it exists.
    ///
    /// # Errors
    /// When the address is malformed, the teacher refuses or is for another task, or the run is stopped meanwhile.
    pub(crate) fn open(
        options: AccountOptions<'_>,
        warnings: &Warnings,
        runtime: &Runtime,
        shutdown: &CancellationToken,
    ) -> Result<Self, TeacherError> {
        let AccountOptions { client_config, address, one_arm, mut terms, .. } = options;
        let AccountOptions { start, renamed, view, clock, .. } = options;
        let AccountOptions { first_policy, had_other_policy, .. } = options;
        let inside = runtime.enter();
        let client = TeacherClient::new(client_config.channel(address)?);
        drop(inside);
        let (lost, stop_watching) = (Arc::new(AtomicBool::new(false)), CancellationToken::new());
        let (run, mut full_budget) = (terms.name.clone(), terms.budget);
        if let Some(RenamedAccount { name, budget }) = renamed {
            (terms.name, full_budget) = (name, budget);
        }
        let mut account = Self {
            client: client.clone(),
            runtime: runtime.clone(),
            shutdown: shutdown.clone(),
            run,
            terms,
            open_episodes: Vec::new(),
            units_per_episode: 0,
            full_budget,
            audit: Audit::new(Statement { spent: 0, leased: 0 }, 0, true),
            policy: String::new(),
            lost: lost.clone(),
            _watch: stop_watching.clone().drop_guard(),
        };
        let policy = account.check_task(one_arm)?;
        account.policy = first_policy.unwrap_or_else(|| policy.clone());
        warn_of_other_policy(warnings, &policy, &account.policy, had_other_policy);
        account.begin(start, warnings)?;
        let first = account.policy.clone();
        let watcher = AccountWatcher::new((client, first), lost, (warnings.clone(), view), clock);
        let watch = watcher.watch(account.terms.name.clone());
        runtime.spawn(async move {
            tokio::select! {
                () = watch => (),
                () = stop_watching.cancelled() => (),
            }
        });
        Ok(account)
    }

    /// Opens the account, or continues with it.
    fn begin(&mut self, start: RunStart, warnings: &Warnings) -> Result<(), TeacherError> {
        let budget = self.terms.budget;
        match start {
            RunStart::New => {
                let found = self.open_account(budget, 0)?;
                self.warn_if_used(found, warnings);
                Ok(())
            }
            // If the teacher lost the account meanwhile, it was opened again with what was left.
            RunStart::Restarted => {
                let found = self.balance()?.map_or(budget, |found| found.budget.min(budget));
                self.open_account(found, 0).map(drop)
            }
            RunStart::Resumed { spent } => self.resume(spent),
        }
    }

    /// Warns of an account that an earlier run has used: a new run gets the verdicts on the steps of the earlier one,
    /// and the rest of its budget.
    fn warn_if_used(&self, found: Statement, warnings: &Warnings) {
        let Statement { spent, leased } = found;
        if spent == 0 && leased == 0 {
            return;
        }
        let name = &self.terms.name;
        let warning = format!(
            "the teacher's account {name:?} was used before, {spent} units are spent: a run of the same name decides \
             on this run's advice, give this one another name"
        );
        warnings.set_first(Source::Account, &warning);
    }

    /// Checks that the teacher advises on the task of one arm, and returns the digest of its policy.
    fn check_task(&self, one_arm: &TaskSpec) -> Result<String, TeacherError> {
        let described = self.call("describe its task", |mut client| async move {
            client.describe(pb::DescribeRequest {}).await
        })?;
        // Teachers of earlier versions have built-in tasks and send only their names.
        let task = match described.task_description {
            Some(description) => Some(decode_task(description)?),
            None => described.task.parse().ok().map(|task| TaskSpec::built_in(task, 1)),
        };
        let name_differs = || TaskDifference {
            field: "name".to_owned(),
            first: format!("{:?}", one_arm.name()),
            second: format!("{:?}", described.task),
        };
        match task.map_or_else(|| Some(name_differs()), |task| one_arm.difference(&task)) {
            Some(difference) => Err(TeacherError::OtherTask(difference)),
            None => Ok(described.policy_digest),
        }
    }

    /// Returns the name under which workers ask for advice.
    pub(crate) fn name(&self) -> &str {
        &self.terms.name
    }

    /// Returns the account if it has another name than the run.
    pub(crate) fn renamed(&self) -> Option<RenamedAccount> {
        let (name, budget) = (&self.terms.name, self.full_budget);
        (*name != self.run).then(|| RenamedAccount { name: name.clone(), budget })
    }

    /// Returns the digest of the teacher's policy when the run began, if it is known.
    pub(crate) fn policy(&self) -> Option<&str> {
        Some(self.policy.as_str()).filter(|digest| !digest.is_empty())
    }

    /// Reserves `units_per_episode` for each of a round's advised episodes, or what is left, in their order, and
    /// returns the reserved units. `spent` counts the units of the episodes learned so far. No other lease may be open.
    pub(crate) fn open_leases(
        &mut self,
        episodes: Vec<u64>,
        units_per_episode: u32,
        spent: u64,
    ) -> Result<Vec<Allowance>, TeacherError> {
        if episodes.is_empty() {
            return Ok(Vec::new());
        }
        self.units_per_episode = units_per_episode;
        let mut n_losses = 0;
        let opened = loop {
            match self.call_open_leases(&episodes) {
                Err(TeacherError::UnknownAccount(_)) => self.reopen(spent, &mut n_losses)?,
                opened => break opened?,
            }
        };
        self.open_episodes.extend(episodes);
        if let Some(account) = &opened.account {
            let units = opened.leases.iter().map(|lease| u64::from(lease.units)).sum();
            self.audit.leases_opened(units, statement(account));
        }
        Ok(self.allowances(&opened.leases))
    }

    /// Returns the units that the episodes of `leases` can claim. In a reopened account workers may have been charged
    /// before the lease existed, so leases limit nothing.
    fn allowances(&self, leases: &[pb::Lease]) -> Vec<Allowance> {
        let allowance =
            |lease: &pb::Lease| Allowance { episode: lease.episode, units: lease.units };
        if self.audit.is_whole() { leases.iter().map(allowance).collect() } else { Vec::new() }
    }

    /// Releases the unspent units of finished episodes and returns what the episodes cost. `spent` counts the units of
    /// the episodes learned so far, without these. No other lease may be open.
    pub(crate) fn settle(
        &mut self,
        episodes: &[Episode],
        spent: u64,
    ) -> Result<Settlement, TeacherError> {
        let numbers: Vec<u64> = episodes.iter().map(|episode| episode.number).collect();
        self.open_episodes.retain(|number| !numbers.contains(number));
        let request =
            pb::SettleLeasesRequest { account: self.terms.name.clone(), episodes: numbers };
        let settled = self.call("settle leases", move |mut client| {
            let request = request.clone();
            async move { client.settle_leases(request).await }
        });
        let claimed = episodes.iter().map(|episode| u64::from(episode.advice_charged)).sum();
        match settled {
            Err(TeacherError::UnknownAccount(_)) => {
                self.reopen(spent + claimed, &mut 0)?;
                Ok(Settlement { units: claimed, mismatch: None })
            }
            settled => {
                let Cost { units, instead } = self.audit.settled(claimed, statement(&settled?));
                let mismatch = instead.map(|charged| Mismatch { claimed, charged });
                Ok(Settlement { units, mismatch })
            }
        }
    }

    /// Returns true if the teacher has reported that it does not know the account.
    pub(crate) fn is_lost(&self) -> bool {
        self.lost.load(Ordering::Relaxed)
    }

    /// Opens the account again if the teacher has lost it. `spent` counts the units of the episodes learned so far.
    pub(crate) fn restore_if_lost(&mut self, spent: u64) -> Result<(), TeacherError> {
        if self.lost.swap(false, Ordering::Relaxed) {
            self.reopen(spent, &mut 0)?;
        }
        Ok(())
    }

    /// Opens an account that the teacher has lost, and the leases of open episodes, as often as the teacher loses it
    /// again meanwhile. Pauses first unless `n_losses`, which counts the losses in a row, is 0.
    fn reopen(&mut self, spent: u64, n_losses: &mut u32) -> Result<(), TeacherError> {
        loop {
            if *n_losses > 0 {
                let pause = BACKOFF.pause_after(*n_losses);
                self.unless_stopped(async move { tokio::time::sleep(pause).await })?;
            }
            *n_losses = n_losses.saturating_add(1);
            self.open_or_reopen(spent)?;
            match self.renew_leases() {
                Err(TeacherError::UnknownAccount(_)) => (),
                renewed => return renewed,
            }
        }
    }

    /// Continues with the account. If it has more units left than the run may spend, because the ledger was restored to
    /// an earlier state, opens another one under a new name; no worker uses the old name yet. Checkpoints keep the new
    /// name.
    fn resume(&mut self, spent: u64) -> Result<(), TeacherError> {
        let left = self.terms.budget.saturating_sub(spent);
        match self.balance()? {
            Some(found) if units_left(&found) > left => {
                let name = format!("{}.from-{spent}", self.run);
                warn!(
                    account = self.terms.name,
                    name, left, "the ledger lost charges, opening another account"
                );
                self.terms.name = name;
                self.full_budget = left;
                self.open_account(left, spent).map(drop)
            }
            _ => self.open_or_reopen(spent),
        }
    }

    /// Continues with the account, or opens it with the remaining budget if the teacher does not know it.
    ///
    /// The charges of open episodes are unknown then, so their largest possible sum is written off: a budget is never
    /// overspent.
    fn open_or_reopen(&mut self, spent: u64) -> Result<(), TeacherError> {
        let written_off = self.open_episodes.len() as u64 * u64::from(self.units_per_episode);
        let left = self.terms.budget.saturating_sub(spent);
        let name = self.terms.name.clone();
        match self.balance()? {
            Some(found) if units_left(&found) <= left => {
                if found.budget < self.full_budget {
                    let (got, asked) = (found.budget, self.full_budget);
                    warn!(account = name, budget = got, asked, "continuing with a smaller account");
                }
                self.open_account(found.budget.min(self.terms.budget), spent).map(drop)
            }
            Some(found) => {
                let has = units_left(&found);
                let reason = format!("{name:?} has {has} units left, the run may spend {left}");
                Err(TeacherError::Refused { what: "continue the account", reason })
            }
            None => {
                let budget = left.saturating_sub(written_off);
                warn!(account = name, budget, "the teacher has lost the account, opening it again");
                self.open_account(budget, spent).map(drop)
            }
        }
    }

    /// Opens the leases of open episodes at a teacher that may have lost them; it keeps those that it knows.
    fn renew_leases(&self) -> Result<(), TeacherError> {
        if self.open_episodes.is_empty() {
            return Ok(());
        }
        self.call_open_leases(&self.open_episodes).map(drop)
    }

    /// Opens the account with `budget`, or finds it open, restarts the audit and returns the account's state. `learned`
    /// counts the units of the episodes learned so far.
    fn open_account(&mut self, budget: u64, learned: u64) -> Result<Statement, TeacherError> {
        let terms = pb::OpenAccountRequest { budget, ..self.terms.clone() };
        let account = self.call("open the account", move |mut client| {
            let request = terms.clone();
            async move { client.open_account(request).await }
        })?;
        let pb::Account { name, budget, strategy, spent, .. } = &account;
        AdviceAccountOpened { account: name, budget: *budget, spent: *spent, strategy }.emit();
        let may_spend = self.terms.budget.saturating_sub(learned);
        let ahead = may_spend.saturating_sub(units_left(&account));
        let found = statement(&account);
        self.audit = Audit::new(found, ahead, *budget == self.full_budget);
        Ok(found)
    }

    /// Returns the balance of the account; `None` if the teacher does not know it.
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

    /// Calls until the teacher answers or the run is stopped. The request must be idempotent.
    fn call<T, F>(
        &self,
        what: &'static str,
        request: impl Fn(TeacherClient<AuthChannel>) -> F + Send + 'static,
    ) -> Result<T, TeacherError>
    where
        T: Send + 'static,
        F: Future<Output = Result<tonic::Response<T>, Status>> + Send,
    {
        let client = self.client.clone();
        let answered = async move {
            let operation = Operation { peer: "teacher", purpose: what };
            retry(BACKOFF, CALL_DEADLINE, operation, move || request(client.clone())).await
        };
        let answer = self.unless_stopped(answered)?;
        answer.map(tonic::Response::into_inner).map_err(|status| TeacherError::of(what, &status))
    }

    /// Waits for `work`, unless the run is stopped first.
    fn unless_stopped<T: Send + 'static>(
        &self,
        work: impl Future<Output = T> + Send + 'static,
    ) -> Result<T, TeacherError> {
        let shutdown = self.shutdown.clone();
        let work = async move {
            tokio::select! {
                done = work => Ok(done),
                () = shutdown.cancelled_owned() => Err(TeacherError::Stopped),
            }
        };
        self.runtime.wait_on(work).unwrap_or(Err(TeacherError::Stopped))
    }
}

const fn units_left(account: &pb::Account) -> u64 {
    account.budget.saturating_sub(account.spent)
}

const fn statement(account: &pb::Account) -> Statement {
    Statement { spent: account.spent, leased: account.leased }
}
