//! The client of the learner.

use std::time::Duration;

use tandem_core::TaskSpec;
use tandem_core::work::{PublishedActor, RunTerms, SlotOrder};
use tandem_net::{AuthChannel, MAX_MESSAGE_BYTES, Operation, TraceContext, retry};
use tandem_proto::{DecodeError, pb};
use tonic::{Code, Request, Response, Status};

use crate::config::{Timeouts, WorkerConfig};
use crate::error::{CallError, Error, expect_same};
use crate::player::PlayedSlot;

const JOIN: Operation = Operation { peer: "learner", purpose: "join the run" };
const NEXT_WORK: Operation = Operation { peer: "learner", purpose: "ask for work" };
const FETCH: Operation = Operation { peer: "learner", purpose: "fetch parameters" };
const SUBMIT: Operation = Operation { peer: "learner", purpose: "deliver episodes" };

type Rpc = pb::learner_client::LearnerClient<AuthChannel>;

/// The learner's response to a request for work.
#[derive(Debug)]
pub(crate) enum Work {
    /// A slot to play.
    Slot(SlotOrder),
    /// No work now: ask again.
    Wait,
    /// The run has ended, for this reason.
    Finished(String),
    /// The learner stops before the end of the run, for this reason.
    Interrupted(String),
}

/// The client of a run's learner. Calls are repeated until the learner answers.
///
/// Calls return `None` if the learner does not know their subject, as after a restart.
#[derive(Debug)]
pub(crate) struct LearnerClient {
    client: Rpc,
    timeouts: Timeouts,
}

impl LearnerClient {
    /// Creates a client, which connects on its first call.
    pub(crate) fn new(config: &WorkerConfig, timeouts: Timeouts) -> Result<Self, Error> {
        let channel = config.client.channel(&config.learner);
        let channel = channel.map_err(|source| Error::Address { role: "learner", source })?;
        let client = Rpc::new(channel)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        Ok(Self { client, timeouts })
    }

    /// Announces a worker called `name`; returns its number and the run's terms.
    pub(crate) async fn join(&self, name: &str) -> Result<(u64, RunTerms), Error> {
        let request = pb::JoinRequest {
            worker: name.to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
        };
        let call = |mut client: Rpc, request| async move { client.join(request).await };
        let response = self.call(JOIN, self.timeouts.call, request, call).await;
        let response = response.map_err(|status| Error::protocol(JOIN, status))?;
        let terms = required("terms", response.terms).and_then(tandem_proto::decode_run_terms);
        Ok((response.worker_id, terms.map_err(|error| Error::protocol(JOIN, error))?))
    }

    /// Returns the next work, unless the learner does not know the worker.
    pub(crate) async fn next_work(&self, worker_id: u64) -> Result<Option<Work>, Error> {
        let request = pb::NextWorkRequest { worker_id };
        let call = |mut client: Rpc, request| async move { client.next_work(request).await };
        let response = self.call(NEXT_WORK, self.timeouts.work, request, call).await;
        let Some(response) = if_known(NEXT_WORK, response)? else { return Ok(None) };
        decode_work(response).map(Some).map_err(|error| Error::protocol(NEXT_WORK, error))
    }

    /// Returns the actor of `version` for `task`, unless the learner no longer has that version.
    pub(crate) async fn parameters(
        &self,
        version: u64,
        task: &TaskSpec,
    ) -> Result<Option<PublishedActor>, Error> {
        let request = pb::GetParametersRequest { version };
        let call = |mut client: Rpc, request| async move { client.get_parameters(request).await };
        let response = self.call(FETCH, self.timeouts.call, request, call).await;
        let Some(response) = if_known(FETCH, response)? else { return Ok(None) };
        let decode = || {
            let published = tandem_proto::decode_actor(&response, task)?;
            expect_same("parameters of version", version, published.version)?;
            Ok::<_, CallError>(published)
        };
        decode().map(Some).map_err(|error| Error::protocol(FETCH, error))
    }

    /// Delivers the episodes of a slot within the span `trace`. Returns false if the learner does not know the worker.
    pub(crate) async fn submit(
        &self,
        worker_id: u64,
        slot: u64,
        played: &PlayedSlot,
        trace: TraceContext,
    ) -> Result<bool, Error> {
        let episodes = played.episodes.iter().map(tandem_proto::encode_episode).collect();
        let environment_check = environment_report(played);
        let request = pb::SubmitEpisodesRequest { worker_id, slot, episodes, environment_check };
        let call = |mut client: Rpc, request| async move {
            let mut request = Request::new(request);
            request.extensions_mut().insert(trace);
            client.submit_episodes(request).await
        };
        let response = self.call(SUBMIT, self.timeouts.call, request, call).await;
        Ok(if_known(SUBMIT, response)?.is_some())
    }

    /// Repeats a call until the learner answers.
    async fn call<R: Clone, T, F>(
        &self,
        operation: Operation,
        deadline: Duration,
        request: R,
        call: impl Fn(Rpc, R) -> F,
    ) -> Result<T, Status>
    where
        F: Future<Output = Result<Response<T>, Status>>,
    {
        let attempt = || call(self.client.clone(), request.clone());
        let response = retry(self.timeouts.backoff, deadline, operation, attempt).await;
        response.map(Response::into_inner)
    }
}

/// Returns the check of the environments and the failures of their server, if there is anything to report.
fn environment_report(played: &PlayedSlot) -> Option<pb::EnvironmentCheck> {
    if played.check.is_none() && played.failures.n == 0 {
        return None;
    }
    let difference = played.check.and_then(|check| check.difference);
    Some(pb::EnvironmentCheck {
        n_episodes: played.check.map_or(0, |check| check.n_episodes),
        difference: difference.map_or_else(String::new, |it| it.to_string()),
        failures: played.failures.n,
        failure: played.failures.latest.clone(),
    })
}

fn decode_work(response: pb::NextWorkResponse) -> Result<Work, DecodeError> {
    use pb::next_work_response::Work as Message;
    Ok(match required("work", response.work)? {
        Message::Slot(slot) => Work::Slot(tandem_proto::decode_slot(slot)?),
        Message::Wait(pb::Wait {}) => Work::Wait,
        Message::Finished(pb::Finished { reason, interrupted: false }) => Work::Finished(reason),
        Message::Finished(pb::Finished { reason, .. }) => Work::Interrupted(reason),
    })
}

fn required<T>(field: &str, message: Option<T>) -> Result<T, DecodeError> {
    message.ok_or_else(|| DecodeError::new(field, "a message", "none"))
}

/// Returns a response, or `None` if the learner does not know the subject of the request.
fn if_known<T>(operation: Operation, response: Result<T, Status>) -> Result<Option<T>, Error> {
    match response {
        Ok(response) => Ok(Some(response)),
        Err(status) if status.code() == Code::NotFound => Ok(None),
        Err(status) => Err(Error::protocol(operation, status)),
    }
}
