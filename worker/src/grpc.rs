//! The learner and the teacher as a worker sees them: calls with a deadline whose failures say what to do next.

use std::time::Duration;

use tandem_core::work::{PublishedActor, RunTerms, SlotOrder};
use tandem_core::{Episode, Layout, StepAdvice, StepQuery};
use tandem_net::Link;
use tandem_proto::{DecodeError, pb};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status, Streaming};

use crate::retry::Patience;

/// Largest message accepted: a slot's episodes and a large actor fit many times over.
const MAX_MESSAGE_BYTES: usize = 64 << 20;
/// Requests under way on an advice stream. There is one at a time; nobody waits for room.
const STREAM_CAPACITY: usize = 1;

/// Why a call brought no answer.
#[derive(Debug, thiserror::Error)]
pub(crate) enum CallError {
    /// The peer is away or overloaded; waiting and asking again helps.
    #[error("no answer")]
    Away(#[source] Status),
    /// The peer does not know what was asked about, as after a restart.
    #[error("not known there")]
    Unknown(#[source] Status),
    /// The peer refuses; waiting does not help.
    #[error("refused")]
    Refused(#[source] Status),
    /// The answer cannot be read; waiting does not help.
    #[error("the answer cannot be read")]
    Malformed(#[from] DecodeError),
    /// The answer is to another question; waiting does not help.
    #[error("the answer does not fit the question: expected {expected}, got {got}")]
    Unfitting {
        /// What was asked about.
        expected: String,
        /// What came.
        got: String,
    },
}

impl From<Status> for CallError {
    fn from(status: Status) -> Self {
        match status.code() {
            Code::NotFound => Self::Unknown(status),
            Code::InvalidArgument
            | Code::FailedPrecondition
            | Code::OutOfRange
            | Code::AlreadyExists
            | Code::PermissionDenied
            | Code::Unauthenticated
            | Code::Unimplemented
            | Code::DataLoss => Self::Refused(status),
            _ => Self::Away(status),
        }
    }
}

/// Waits for `call` no longer than `deadline`.
async fn within<T>(
    deadline: Duration,
    call: impl Future<Output = Result<T, Status>>,
) -> Result<T, Status> {
    let lapsed = || Status::deadline_exceeded(format!("no answer within {deadline:?}"));
    tokio::time::timeout(deadline, call).await.unwrap_or_else(|_elapsed| Err(lapsed()))
}

/// What the learner wants done next.
#[derive(Debug)]
pub(crate) enum Work {
    /// Play this.
    Slot(SlotOrder),
    /// Ask again.
    Wait,
    /// The run has ended, for this reason.
    Finished(String),
    /// The learner ends before the run does, for this reason.
    Interrupted(String),
}

/// The learner's side of a run.
#[derive(Debug, Clone)]
pub(crate) struct Learner {
    client: pb::learner_client::LearnerClient<Link>,
    patience: Patience,
}

impl Learner {
    pub(crate) fn new(link: Link, patience: Patience) -> Self {
        let client = pb::learner_client::LearnerClient::new(link)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        Self { client, patience }
    }

    /// Announces a worker called `name`; gives its number and the run's terms.
    pub(crate) async fn join(&mut self, name: &str) -> Result<(u64, RunTerms), CallError> {
        let request = pb::JoinRequest {
            worker: name.to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
        };
        let answer = within(self.patience.answer, self.client.join(request)).await?.into_inner();
        let terms = answer.terms.ok_or_else(|| missing("terms"))?;
        Ok((answer.worker_id, tandem_proto::decode_run_terms(terms)?))
    }

    pub(crate) async fn next_work(&mut self, worker_id: u64) -> Result<Work, CallError> {
        use pb::next_work_response::Work as Message;
        let request = pb::NextWorkRequest { worker_id };
        let answer = within(self.patience.work, self.client.next_work(request)).await?.into_inner();
        Ok(match answer.work.ok_or_else(|| missing("work"))? {
            Message::Slot(slot) => Work::Slot(tandem_proto::decode_slot(slot)?),
            Message::Wait(pb::Wait {}) => Work::Wait,
            Message::Finished(pb::Finished { reason, interrupted: false }) => {
                Work::Finished(reason)
            }
            Message::Finished(pb::Finished { reason, .. }) => Work::Interrupted(reason),
        })
    }

    /// The actor of `version`, for `layout`.
    pub(crate) async fn parameters(
        &mut self,
        version: u64,
        layout: Layout,
    ) -> Result<PublishedActor, CallError> {
        let request = pb::GetParametersRequest { version };
        let answer =
            within(self.patience.answer, self.client.get_parameters(request)).await?.into_inner();
        let published = tandem_proto::decode_actor(&answer, layout)?;
        expect_same("parameters of version", version, published.version)?;
        Ok(published)
    }

    pub(crate) async fn submit(
        &mut self,
        worker_id: u64,
        slot: u64,
        episodes: &[Episode],
    ) -> Result<(), CallError> {
        let episodes = episodes.iter().map(tandem_proto::encode_episode).collect();
        let request = pb::SubmitEpisodesRequest { worker_id, slot, episodes };
        within(self.patience.answer, self.client.submit_episodes(request)).await?;
        Ok(())
    }
}

fn missing(field: &str) -> DecodeError {
    DecodeError::new(field, "a message", "none")
}

fn expect_same(what: &str, expected: u64, got: u64) -> Result<(), CallError> {
    if expected == got {
        return Ok(());
    }
    Err(CallError::Unfitting { expected: format!("{what} {expected}"), got: got.to_string() })
}

/// The teacher's side of a run, asked over one stream.
#[derive(Debug)]
pub(crate) struct Teacher {
    client: pb::teacher_client::TeacherClient<Link>,
    patience: Patience,
    stream: Option<AdviceStream>,
}

#[derive(Debug)]
struct AdviceStream {
    requests: mpsc::Sender<pb::AdviseRequest>,
    answers: Streaming<pb::AdviseResponse>,
}

impl Teacher {
    pub(crate) fn new(link: Link, patience: Patience) -> Self {
        let client = pb::teacher_client::TeacherClient::new(link)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        Self { client, patience, stream: None }
    }

    /// The teacher's verdicts on `queries`, charged to `account`. Asking again charges nothing more.
    pub(crate) async fn advise(
        &mut self,
        account: &str,
        layout: Layout,
        queries: &[StepQuery],
    ) -> Result<Vec<StepAdvice>, CallError> {
        let steps = queries.iter().map(tandem_proto::encode_query).collect();
        let request = pb::AdviseRequest { account: account.to_owned(), steps };
        // A stream that failed or was abandoned half-way is not put back: its next answer could be to an older question.
        let stream = self.stream.take();
        let (stream, answer) = within(self.patience.advice, self.exchange(stream, request)).await?;
        self.stream = Some(stream);
        expect_same("steps", queries.len() as u64, answer.steps.len() as u64)?;
        let decode = |advice| tandem_proto::decode_advice(advice, layout);
        Ok(answer.steps.into_iter().map(decode).collect::<Result<_, _>>()?)
    }

    async fn exchange(
        &mut self,
        stream: Option<AdviceStream>,
        request: pb::AdviseRequest,
    ) -> Result<(AdviceStream, pb::AdviseResponse), Status> {
        let mut stream = match stream {
            Some(stream) => {
                stream.requests.send(request).await.map_err(|_unsent| closed())?;
                stream
            }
            None => self.open(request).await?,
        };
        let answer = stream.answers.message().await?.ok_or_else(closed)?;
        Ok((stream, answer))
    }

    /// Opens a stream with its first request: some servers answer nothing at all before they have one.
    async fn open(&mut self, first: pb::AdviseRequest) -> Result<AdviceStream, Status> {
        let (requests, outgoing) = mpsc::channel(STREAM_CAPACITY);
        requests.send(first).await.map_err(|_unsent| closed())?;
        let answers = self.client.advise_stream(ReceiverStream::new(outgoing)).await?.into_inner();
        Ok(AdviceStream { requests, answers })
    }
}

fn closed() -> Status {
    Status::unavailable("the teacher closed the advice stream")
}
