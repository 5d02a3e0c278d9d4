//! The service `tandem.v1.Teacher`: a thin shell round an [`Advisor`].

mod answers;
mod messages;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use tandem_net::{Gate, Incoming};
use tandem_proto::pb::teacher_server::{Teacher, TeacherServer};
use tandem_proto::{decode_account_name, pb};
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

use crate::advisor::Advisor;
use crate::budget::{BudgetError, Terms};
use crate::error::Error;
use crate::ledger::{LedgerError, MemoryLedger};
use crate::policy::OneArmPolicy;
use answers::{AnswerStream, answer, answer_all};
use messages::{check_episodes, describe, encode_balance, encode_lease};

/// Bytes that a request may have: some thousands of steps.
const MAX_REQUEST_BYTES: usize = 4 << 20;
/// How long calls that are being answered may take to finish once the service shall end.
const SHUTDOWN_GRACE: Duration = Duration::from_secs(5);

/// What a teacher service needs to know.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Config {
    /// The file of the policy that teaches.
    pub policy: PathBuf,
}

/// Serves the teacher of `config` to those whom `gate` lets in, until `shutdown` is cancelled.
///
/// # Errors
/// When the policy cannot teach, or the server fails.
pub async fn serve(
    config: Config,
    incoming: impl Into<Incoming>,
    gate: &Gate,
    shutdown: CancellationToken,
) -> Result<(), Error> {
    let policy = OneArmPolicy::load(&config.policy)?;
    serve_advisor(
        Advisor::new(Box::new(policy), Box::new(MemoryLedger::default()))?,
        incoming,
        gate,
        shutdown,
    )
    .await
}

/// Serves `advisor` to those whom `gate` lets in, until `shutdown` is cancelled.
///
/// # Errors
/// When the server fails.
pub async fn serve_advisor(
    advisor: Advisor,
    incoming: impl Into<Incoming>,
    gate: &Gate,
    shutdown: CancellationToken,
) -> Result<(), Error> {
    let service = TeacherService { advisor: Arc::new(advisor), shutdown: shutdown.clone() };
    let teacher = TeacherServer::new(service).max_decoding_message_size(MAX_REQUEST_BYTES);
    let router = gate.router(teacher).await?;
    let served =
        router.serve_with_incoming_shutdown(incoming.into(), shutdown.clone().cancelled_owned());
    tokio::select! {
        outcome = served => Ok(outcome?),
        () = grace_after(&shutdown) => {
            tracing::warn!("calls still open after the grace period were cut off");
            Ok(())
        }
    }
}

async fn grace_after(shutdown: &CancellationToken) {
    shutdown.cancelled().await;
    tokio::time::sleep(SHUTDOWN_GRACE).await;
}

/// What the generated server calls.
struct TeacherService {
    advisor: Arc<Advisor>,
    shutdown: CancellationToken,
}

#[tonic::async_trait]
impl Teacher for TeacherService {
    type AdviseStreamStream = AnswerStream;

    async fn describe(
        &self,
        _: Request<pb::DescribeRequest>,
    ) -> Result<Response<pb::DescribeResponse>, Status> {
        Ok(Response::new(describe(&self.advisor)))
    }

    async fn open_account(
        &self,
        request: Request<pb::OpenAccountRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        let request = request.into_inner();
        let account = open_account(&self.advisor, request).map_err(|error| status(&error))?;
        Ok(Response::new(account))
    }

    async fn get_account(
        &self,
        request: Request<pb::GetAccountRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        let account =
            get_account(&self.advisor, request.into_inner()).map_err(|error| status(&error))?;
        Ok(Response::new(account))
    }

    async fn advise(
        &self,
        request: Request<pb::AdviseRequest>,
    ) -> Result<Response<pb::AdviseResponse>, Status> {
        answer(Arc::clone(&self.advisor), request.into_inner()).await.map(Response::new)
    }

    async fn advise_stream(
        &self,
        request: Request<Streaming<pb::AdviseRequest>>,
    ) -> Result<Response<AnswerStream>, Status> {
        let advisor = Arc::clone(&self.advisor);
        Ok(Response::new(answer_all(advisor, request.into_inner(), self.shutdown.clone())))
    }

    async fn open_leases(
        &self,
        request: Request<pb::OpenLeasesRequest>,
    ) -> Result<Response<pb::OpenLeasesResponse>, Status> {
        let leases =
            open_leases(&self.advisor, request.into_inner()).map_err(|error| status(&error))?;
        Ok(Response::new(leases))
    }

    async fn settle_leases(
        &self,
        request: Request<pb::SettleLeasesRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        let account =
            settle_leases(&self.advisor, request.into_inner()).map_err(|error| status(&error))?;
        Ok(Response::new(account))
    }
}

fn open_account(advisor: &Advisor, request: pb::OpenAccountRequest) -> Result<pb::Account, Error> {
    let name = decode_account_name("name", request.name)?;
    let terms = Terms { budget: request.budget, strategy: request.strategy.parse()? };
    let balance = advisor.open_account(&name, terms)?;
    tracing::info!(account = name, budget = terms.budget, strategy = %terms.strategy, "account opened");
    Ok(encode_balance(name, &balance))
}

fn get_account(advisor: &Advisor, request: pb::GetAccountRequest) -> Result<pb::Account, Error> {
    let name = decode_account_name("name", request.name)?;
    let balance = advisor.balance(&name)?;
    Ok(encode_balance(name, &balance))
}

fn open_leases(
    advisor: &Advisor,
    request: pb::OpenLeasesRequest,
) -> Result<pb::OpenLeasesResponse, Error> {
    let name = decode_account_name("account", request.account)?;
    check_episodes(&request.episodes)?;
    let (leases, balance) =
        advisor.open_leases(&name, &request.episodes, request.units_per_episode)?;
    tracing::debug!(account = name, episodes = leases.len(), left = balance.left, "leases opened");
    Ok(pb::OpenLeasesResponse {
        leases: leases.iter().map(encode_lease).collect(),
        account: Some(encode_balance(name, &balance)),
    })
}

fn settle_leases(
    advisor: &Advisor,
    request: pb::SettleLeasesRequest,
) -> Result<pb::Account, Error> {
    let name = decode_account_name("account", request.account)?;
    check_episodes(&request.episodes)?;
    let balance = advisor.settle_leases(&name, &request.episodes)?;
    tracing::debug!(
        account = name,
        episodes = request.episodes.len(),
        left = balance.left,
        "leases settled"
    );
    Ok(encode_balance(name, &balance))
}

/// What a client is told of an error.
fn status(error: &Error) -> Status {
    let message = error.to_string();
    match error {
        Error::Request(_)
        | Error::Strategy(_)
        | Error::Ledger(
            LedgerError::Budget(BudgetError::BudgetTooLarge(_)) | LedgerError::BeyondEnd { .. },
        ) => Status::invalid_argument(message),
        Error::Ledger(LedgerError::Budget(BudgetError::UnknownAccount(_))) => {
            Status::not_found(message)
        }
        Error::Ledger(LedgerError::Budget(BudgetError::OtherTerms { .. })) => {
            Status::already_exists(message)
        }
        Error::Ledger(LedgerError::Unavailable { .. }) => {
            tracing::error!(%error, "request failed");
            Status::unavailable(message)
        }
        Error::Policy(_)
        | Error::NotOneArm { .. }
        | Error::NotFinite { .. }
        | Error::Gate(_)
        | Error::Transport(_) => {
            tracing::error!(%error, "request failed");
            Status::internal(message)
        }
    }
}

#[cfg(test)]
mod tests;
