//! The learner's side of the advice budget: an account for the run, leases for its rounds.

use std::time::Duration;

use tandem_core::Episode;
use tandem_net::{Dial, DialError, Link};
use tandem_proto::pb;
use tandem_proto::pb::teacher_client::TeacherClient;
use tandem_telemetry::events::AdviceAccountOpened;
use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;
use tonic::Code;
use tracing::warn;

use crate::shared::wait_on;

/// Deadline of a call.
const CALL_DEADLINE: Duration = Duration::from_secs(5);
/// First pause before an unreachable teacher is tried again; doubled up to [`LONGEST_PAUSE`].
const FIRST_PAUSE: Duration = Duration::from_millis(100);
const LONGEST_PAUSE: Duration = Duration::from_secs(2);

/// What the learner needs of a teacher that does not come from its own configuration.
#[derive(Debug, thiserror::Error)]
pub enum TeacherError {
    /// Not an address.
    #[error("the teacher cannot be called")]
    Address(#[from] DialError),
    /// The teacher understood and declined; asking again would not help.
    #[error("the teacher refuses: {0}")]
    Refused(String),
    /// The run was stopped while the teacher could not be reached.
    #[error("stopped while waiting for the teacher")]
    Stopped,
}

/// An account at a teacher, used from the thread that learns.
#[derive(Debug)]
pub(crate) struct Ledger {
    client: TeacherClient<Link>,
    runtime: Handle,
    shutdown: CancellationToken,
    account: pb::OpenAccountRequest,
    /// Units spent before this account was opened: a teacher that was restarted has forgotten them.
    spent_before: u64,
    left: u64,
}

impl Ledger {
    /// Opens the account `name`, or goes on with it when it exists. `spent` is what the run has spent so far.
    pub(crate) fn open(
        (dial, address): (&Dial, &str),
        terms: &pb::OpenAccountRequest,
        spent: u64,
        runtime: &Handle,
        shutdown: &CancellationToken,
    ) -> Result<Self, TeacherError> {
        let _inside = runtime.enter();
        let client = TeacherClient::new(dial.link(address)?);
        let mut ledger = Self {
            client,
            runtime: runtime.clone(),
            shutdown: shutdown.clone(),
            account: terms.clone(),
            spent_before: 0,
            left: terms.budget,
        };
        let account = ledger.open_account(terms)?;
        if account.spent < spent {
            let remaining = pb::OpenAccountRequest {
                name: format!("{}.from-{spent}", terms.name),
                budget: terms.budget.saturating_sub(spent),
                strategy: terms.strategy.clone(),
            };
            ledger.spent_before = spent;
            ledger.account = remaining.clone();
            ledger.open_account(&remaining)?;
        }
        Ok(ledger)
    }

    /// The name under which workers ask.
    pub(crate) fn account(&self) -> &str {
        &self.account.name
    }

    /// Units spent by the whole run, and units left, as last heard.
    pub(crate) const fn left(&self) -> u64 {
        self.left
    }

    /// Sets units aside for a round's advised episodes, in their order.
    pub(crate) fn open_leases(
        &mut self,
        episodes: Vec<u64>,
        units_per_episode: u32,
    ) -> Result<(), TeacherError> {
        if episodes.is_empty() {
            return Ok(());
        }
        let request = pb::OpenLeasesRequest {
            account: self.account.name.clone(),
            episodes,
            units_per_episode,
        };
        let response = self.call(move |mut client| {
            let request = request.clone();
            async move { client.open_leases(request).await }
        })?;
        self.note(response.account.as_ref());
        Ok(())
    }

    /// Returns the unspent units of finished episodes.
    pub(crate) fn settle(&mut self, episodes: &[Episode]) -> Result<(), TeacherError> {
        let numbers: Vec<u64> = episodes.iter().map(|episode| episode.number).collect();
        let request =
            pb::SettleLeasesRequest { account: self.account.name.clone(), episodes: numbers };
        let account = self.call(move |mut client| {
            let request = request.clone();
            async move { client.settle_leases(request).await }
        })?;
        self.note(Some(&account));
        Ok(())
    }

    fn open_account(
        &mut self,
        terms: &pb::OpenAccountRequest,
    ) -> Result<pb::Account, TeacherError> {
        let terms = terms.clone();
        let account = self.call(move |mut client| {
            let request = terms.clone();
            async move { client.open_account(request).await }
        })?;
        self.note(Some(&account));
        let pb::Account { name, budget, strategy, spent, .. } = &account;
        AdviceAccountOpened { account: name, budget: *budget, spent: *spent, strategy }.emit();
        Ok(account)
    }

    fn note(&mut self, account: Option<&pb::Account>) {
        if let Some(account) = account {
            self.left = account.budget - account.spent.min(account.budget);
        }
    }

    /// Calls until the teacher answers or the run is stopped. What is asked may be asked again.
    fn call<T, F>(
        &self,
        request: impl Fn(TeacherClient<Link>) -> F + Send + 'static,
    ) -> Result<T, TeacherError>
    where
        T: Send + 'static,
        F: Future<Output = Result<tonic::Response<T>, tonic::Status>> + Send,
    {
        let (client, shutdown) = (self.client.clone(), self.shutdown.clone());
        let call = async move {
            tokio::select! {
                answer = ask_until_answered(client, request) => answer,
                () = shutdown.cancelled_owned() => Err(TeacherError::Stopped),
            }
        };
        wait_on(&self.runtime, call).unwrap_or(Err(TeacherError::Stopped))
    }
}

async fn ask_until_answered<T, F>(
    client: TeacherClient<Link>,
    request: impl Fn(TeacherClient<Link>) -> F + Send,
) -> Result<T, TeacherError>
where
    F: Future<Output = Result<tonic::Response<T>, tonic::Status>> + Send,
{
    let mut pause = FIRST_PAUSE;
    loop {
        let attempt = tokio::time::timeout(CALL_DEADLINE, request(client.clone())).await;
        let status = match attempt {
            Ok(Ok(response)) => return Ok(response.into_inner()),
            Ok(Err(status)) if !is_passing(&status) => {
                return Err(TeacherError::Refused(status.message().to_owned()));
            }
            Ok(Err(status)) => status.message().to_owned(),
            Err(_) => "no answer in time".to_owned(),
        };
        warn!(error = status, "teacher is unreachable, asking again");
        tokio::time::sleep(pause).await;
        pause = (pause * 2).min(LONGEST_PAUSE);
    }
}

/// Whether a call that failed so may go through later.
fn is_passing(status: &tonic::Status) -> bool {
    matches!(
        status.code(),
        Code::Unavailable
            | Code::DeadlineExceeded
            | Code::Cancelled
            | Code::Unknown
            | Code::Aborted
            | Code::ResourceExhausted
    )
}
