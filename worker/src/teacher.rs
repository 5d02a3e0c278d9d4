//! The client of the teacher.

use tandem_core::{StepQuery, TaskSpec};
use tandem_net::{AuthChannel, MAX_MESSAGE_BYTES, Operation, Retrier, TraceContext, within};
use tandem_proto::pb;
use tonic::{Code, Status};

use crate::config::{Timeouts, WorkerConfig};
use crate::error::{CallError, Error, expect_same};
use crate::player::AdviceReply;
use crate::request_stream::RequestStream;

const ADVISE: Operation = Operation { peer: "teacher", purpose: "ask the teacher" };

type Rpc = pb::teacher_client::TeacherClient<AuthChannel>;

/// The client of a run's teacher, which is asked over one stream. Requests are repeated until the teacher answers.
#[derive(Debug)]
pub(crate) struct TeacherClient {
    client: Rpc,
    timeouts: Timeouts,
    stream: Option<RequestStream<pb::AdviseRequest, pb::AdviseResponse>>,
}

impl TeacherClient {
    /// Creates a client, which connects on its first call; `None` if the configuration names no teacher.
    pub(crate) fn new(config: &WorkerConfig, timeouts: Timeouts) -> Result<Option<Self>, Error> {
        let Some(address) = &config.teacher else { return Ok(None) };
        let channel = config.client.channel(address);
        let channel = channel.map_err(|source| Error::Address { role: "teacher", source })?;
        let client = Rpc::new(channel)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        Ok(Some(Self { client, timeouts, stream: None }))
    }

    /// Returns the teacher's advice on `queries`, charged to `account`, within the span `trace`. A repeated request is
    /// not charged again.
    pub(crate) async fn advise(
        &mut self,
        account: &str,
        task: &TaskSpec,
        queries: &[StepQuery],
        trace: TraceContext,
    ) -> Result<AdviceReply, Error> {
        let steps = queries.iter().map(tandem_proto::encode_query).collect();
        let request = pb::AdviseRequest {
            account: account.to_owned(),
            steps,
            traceparent: trace.to_string(),
        };
        let response = self.exchange_until_answered(request).await;
        let response = response.map_err(|status| Error::protocol(ADVISE, status))?;
        let decode = || {
            expect_same("steps", queries.len() as u64, response.steps.len() as u64)?;
            let decode = |advice| tandem_proto::decode_advice(advice, task);
            let steps = response.steps.into_iter().map(decode).collect::<Result<_, _>>()?;
            Ok::<_, CallError>(AdviceReply { steps, budget_left: response.budget_left })
        };
        decode().map_err(|error| Error::protocol(ADVISE, error))
    }

    async fn exchange_until_answered(
        &mut self,
        request: pb::AdviseRequest,
    ) -> Result<pb::AdviseResponse, Status> {
        let mut retrier = Retrier::new(self.timeouts.backoff, ADVISE);
        loop {
            let outcome = within(self.timeouts.advice, self.exchange(request.clone())).await;
            if let Some(outcome) = retrier.settle(outcome).await {
                return outcome;
            }
        }
    }

    /// Sends one request and waits for its response.
    async fn exchange(&mut self, request: pb::AdviseRequest) -> Result<pb::AdviseResponse, Status> {
        let (client, stream) = (&mut self.client, self.stream.take());
        let exchanged = RequestStream::exchange(ADVISE.peer, stream, request, |requests| {
            client.advise_stream(requests)
        });
        let (response, stream) = exchanged.await.map_err(with_transient_failures)?;
        self.stream = Some(stream);
        Ok(response)
    }
}

/// Marks failures that other processes resolve as transient: the learner reopens an account that the teacher has lost, and
/// a policy server may be restarted with the policy that the teacher started with.
fn with_transient_failures(status: Status) -> Status {
    match status.code() {
        Code::NotFound | Code::FailedPrecondition => Status::unavailable(status.message()),
        _ => status,
    }
}
