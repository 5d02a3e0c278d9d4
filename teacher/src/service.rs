//! The gRPC service `tandem.v1.Teacher` around an [`Advisor`].

mod advice;
mod convert;
mod failures;
mod metrics;
mod thread;

use std::path::PathBuf;
use std::pin::Pin;
use std::time::Duration;

use tandem_net::{Incoming, Pacing, SHUTDOWN_GRACE, ServerConfig};
use tandem_proto::pb::teacher_server::{Teacher, TeacherServer};
use tandem_proto::{decode_account_name, pb};
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

use crate::advisor::Advisor;
use crate::budget::{AccountTerms, BudgetError};
use crate::error::Error;
use crate::ledger::{self, LedgerError};
use crate::policy;
use crate::remote_policy::RemoteError;
use advice::{AdviceStream, advise, advise_stream};
use convert::{check_episodes, describe, encode_balance, encode_lease};
use metrics::TeacherMetrics;
use thread::{AdvisorHandle, AdvisorThread};

/// The largest request: some thousands of steps.
const MAX_REQUEST_BYTES: usize = 4 << 20;
/// The time limit for the answer to a call, shorter than a learner's deadline.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(4);

/// The configuration of a teacher service.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Config {
    /// The teacher's policy; see [`policy::load`].
    pub policy: PathBuf,
    /// The critic of a policy that is an ONNX model.
    pub critic: Option<PathBuf>,
    /// The location of the ledger; see [`ledger::open`].
    pub ledger: String,
}

/// Loads the policy and opens the ledger of `config`.
///
/// # Errors
/// When the policy cannot be loaded, or the ledger cannot be opened.
pub fn open(config: &Config) -> Result<Advisor, Error> {
    let policy = policy::load(&config.policy, config.critic.as_deref())?;
    Advisor::new(policy, ledger::open(&config.ledger)?)
}

/// Serves the teacher of `config`, with the access control of `server_config`, until `shutdown` is cancelled.
///
/// # Errors
/// When the policy cannot be loaded, the ledger cannot be opened, or the server fails.
pub async fn serve(
    config: Config,
    incoming: impl Into<Incoming>,
    server_config: &ServerConfig,
    shutdown: CancellationToken,
) -> Result<(), Error> {
    serve_advisor(open(&config)?, incoming, server_config, shutdown, Pacing::Concurrent).await
}

/// Serves `advisor`, with the access control of `server_config`, until `shutdown` is cancelled.
///
/// The advisor runs on its own thread, or under [`Pacing::Lockstep`] as a task. If it panics, pending calls fail and
/// the service ends.
///
/// # Errors
/// When the server fails, or the advisor has panicked.
pub async fn serve_advisor(
    advisor: Advisor,
    incoming: impl Into<Incoming>,
    server_config: &ServerConfig,
    shutdown: CancellationToken,
    pacing: Pacing,
) -> Result<(), Error> {
    serve_boxed(advisor, incoming.into(), server_config, shutdown, pacing).await
}

/// Boxes the service, so that it is compiled in this crate only and not in every crate that serves.
fn serve_boxed(
    advisor: Advisor,
    incoming: Incoming,
    server_config: &ServerConfig,
    shutdown: CancellationToken,
    pacing: Pacing,
) -> Pin<Box<dyn Future<Output = Result<(), Error>> + Send + '_>> {
    Box::pin(async move {
        let stop = shutdown.child_token();
        let metrics = TeacherMetrics::register(server_config.metrics());
        let (thread, advisor) =
            AdvisorThread::spawn(advisor, ANSWER_TIMEOUT, stop.clone(), pacing, metrics)
                .map_err(Error::Thread)?;
        let service = TeacherService { advisor, stop: stop.clone() };
        let teacher = TeacherServer::new(service).max_decoding_message_size(MAX_REQUEST_BYTES);
        let router = server_config.router(teacher, tandem_proto::FILE_DESCRIPTOR_SET).await?;
        tandem_net::serve(router, incoming, stop).await?;
        thread.join(SHUTDOWN_GRACE).await
    })
}

/// The implementation of the generated server trait.
struct TeacherService {
    advisor: AdvisorHandle,
    /// Cancelled on shutdown and when the advisor panics.
    stop: CancellationToken,
}

#[tonic::async_trait]
impl Teacher for TeacherService {
    type AdviseStreamStream = AdviceStream;

    async fn describe(
        &self,
        _: Request<pb::DescribeRequest>,
    ) -> Result<Response<pb::DescribeResponse>, Status> {
        Ok(Response::new(describe(self.advisor.info())))
    }

    async fn open_account(
        &self,
        request: Request<pb::OpenAccountRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        let request = request.into_inner();
        let account = open_account(&self.advisor, request)
            .await
            .map_err(|error| refused(&self.advisor, &error))?;
        Ok(Response::new(account))
    }

    async fn get_account(
        &self,
        request: Request<pb::GetAccountRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        let account = get_account(&self.advisor, request.into_inner()).await;
        let account = account.map_err(|error| refused(&self.advisor, &error))?;
        Ok(Response::new(account))
    }

    async fn advise(
        &self,
        request: Request<pb::AdviseRequest>,
    ) -> Result<Response<pb::AdviseResponse>, Status> {
        advise(&self.advisor, request.into_inner()).await.map(Response::new)
    }

    async fn advise_stream(
        &self,
        request: Request<Streaming<pb::AdviseRequest>>,
    ) -> Result<Response<AdviceStream>, Status> {
        let requests = request.into_inner();
        Ok(Response::new(advise_stream(self.advisor.clone(), requests, self.stop.clone())))
    }

    async fn open_leases(
        &self,
        request: Request<pb::OpenLeasesRequest>,
    ) -> Result<Response<pb::OpenLeasesResponse>, Status> {
        let leases = open_leases(&self.advisor, request.into_inner()).await;
        let leases = leases.map_err(|error| refused(&self.advisor, &error))?;
        Ok(Response::new(leases))
    }

    async fn settle_leases(
        &self,
        request: Request<pb::SettleLeasesRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        let account = settle_leases(&self.advisor, request.into_inner()).await;
        let account = account.map_err(|error| refused(&self.advisor, &error))?;
        Ok(Response::new(account))
    }
}

async fn open_account(
    advisor: &AdvisorHandle,
    request: pb::OpenAccountRequest,
) -> Result<pb::Account, Error> {
    let name = decode_account_name("name", request.name)?;
    let terms = AccountTerms { budget: request.budget, strategy: request.strategy.parse()? };
    let account = name.clone();
    let open = move |advisor: &mut Advisor| {
        let balance = advisor.open_account(&account, terms)?;
        Ok((balance, advisor.warning().unwrap_or_default().to_owned()))
    };
    let (balance, warning) = advisor.run(open).await?;
    tracing::info!(account = name, budget = terms.budget, strategy = %terms.strategy, "account opened");
    Ok(pb::Account { warning, ..encode_balance(name, &balance) })
}

async fn get_account(
    advisor: &AdvisorHandle,
    request: pb::GetAccountRequest,
) -> Result<pb::Account, Error> {
    let name = decode_account_name("name", request.name)?;
    let account = name.clone();
    let read = move |advisor: &mut Advisor| {
        Ok((advisor.balance(&account)?, advisor.warning().unwrap_or_default().to_owned()))
    };
    let (balance, warning) = advisor.run(read).await?;
    Ok(pb::Account { warning, ..encode_balance(name, &balance) })
}

async fn open_leases(
    advisor: &AdvisorHandle,
    request: pb::OpenLeasesRequest,
) -> Result<pb::OpenLeasesResponse, Error> {
    let name = decode_account_name("account", request.account)?;
    check_episodes(&request.episodes)?;
    let (account, units) = (name.clone(), request.units_per_episode);
    let open = move |advisor: &mut Advisor| advisor.open_leases(&account, &request.episodes, units);
    let (leases, balance) = advisor.run(open).await?;
    tracing::debug!(account = name, episodes = leases.len(), left = balance.left, "leases opened");
    Ok(pb::OpenLeasesResponse {
        leases: leases.iter().map(encode_lease).collect(),
        account: Some(encode_balance(name, &balance)),
    })
}

async fn settle_leases(
    advisor: &AdvisorHandle,
    request: pb::SettleLeasesRequest,
) -> Result<pb::Account, Error> {
    let name = decode_account_name("account", request.account)?;
    check_episodes(&request.episodes)?;
    let (account, n_episodes) = (name.clone(), request.episodes.len());
    let settle = move |advisor: &mut Advisor| advisor.settle_leases(&account, &request.episodes);
    let balance = advisor.run(settle).await?;
    tracing::debug!(account = name, episodes = n_episodes, left = balance.left, "leases settled");
    Ok(encode_balance(name, &balance))
}

/// Logs a failure, and maps an error to the status that the client receives.
fn refused(advisor: &AdvisorHandle, error: &Error) -> Status {
    advisor.record_failure(error);
    status(error)
}

/// Maps an error to the status that the client receives.
fn status(error: &Error) -> Status {
    let message = error.to_string();
    match error {
        Error::Request(_)
        | Error::Strategy(_)
        | Error::NoValues { .. }
        | Error::Ledger(
            LedgerError::Budget(BudgetError::BudgetTooLarge(_)) | LedgerError::BeyondEnd { .. },
        ) => Status::invalid_argument(message),
        Error::Ledger(LedgerError::Budget(BudgetError::UnknownAccount(_))) => {
            Status::not_found(message)
        }
        Error::Ledger(LedgerError::Budget(BudgetError::OtherTerms { .. })) => {
            Status::already_exists(message)
        }
        Error::RemotePolicy(RemoteError::Changed { .. }) => Status::failed_precondition(message),
        Error::Ledger(LedgerError::Unavailable { .. } | LedgerError::OtherStrategy { .. })
        | Error::LedgerNeedsRestart
        | Error::Timeout(_)
        | Error::RemotePolicy(RemoteError::Unavailable { .. }) => Status::unavailable(message),
        Error::Policy(_)
        | Error::Onnx(_)
        | Error::SurplusCritic
        | Error::OpenLedger(_)
        | Error::NotOneArm { .. }
        | Error::NotAnArm(_)
        | Error::NotOneValue { .. }
        | Error::NotACritic { .. }
        | Error::NotFinite { .. }
        | Error::RemotePolicy(_)
        | Error::Panicked
        | Error::Thread(_)
        | Error::ServerConfig(_)
        | Error::Transport(_) => Status::internal(message),
    }
}

#[cfg(test)]
mod gated_ledger;
#[cfg(test)]
mod tests;
