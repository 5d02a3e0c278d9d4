//! Answers to requests for advice, one by one and as a stream.

use std::pin::Pin;
use std::task::{Context, Poll};

use tandem_proto::{decode_account_name, encode_advice, pb};
use tokio_stream::{Stream, StreamExt as _};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::{Status, Streaming};

use super::messages::decode_queries;
use super::status;
use super::thread::AdvisorHandle;
use crate::advisor::{Advice, Question};
use crate::error::Error;

/// Answers in the order of their requests.
pub(super) type AnswerStream =
    Pin<Box<dyn Stream<Item = Result<pb::AdviseResponse, Status>> + Send>>;

/// The answer to one request.
pub(super) async fn answer(
    advisor: &AdvisorHandle,
    request: pb::AdviseRequest,
) -> Result<pb::AdviseResponse, Status> {
    let question = decode(advisor, request).map_err(|error| status(&error))?;
    let advice = advisor.advise(question).await;
    advice.map(|advice| encode(&advice)).map_err(|error| status(&error))
}

/// The answers to `requests`, one at a time as they are read: flow control bounds what waits on either side.
///
/// A call ends with its first error: after a request that cannot be answered, and, once `shutdown` is cancelled, after
/// the answer that is under way.
pub(super) fn answer_all(
    advisor: AdvisorHandle,
    requests: Streaming<pb::AdviseRequest>,
    shutdown: CancellationToken,
) -> AnswerStream {
    let requests = UntilCancelled { requests, cancelled: Box::pin(shutdown.cancelled_owned()) };
    Box::pin(requests.then(move |request| {
        let advisor = advisor.clone();
        async move { answer(&advisor, request?).await }
    }))
}

fn decode(advisor: &AdvisorHandle, request: pb::AdviseRequest) -> Result<Question, Error> {
    let account = decode_account_name("account", request.account)?;
    let queries = decode_queries(request.steps, advisor.profile().layout.task)?;
    Ok(Question { account, queries })
}

fn encode(advice: &Advice) -> pb::AdviseResponse {
    pb::AdviseResponse {
        steps: advice.steps.iter().map(encode_advice).collect(),
        budget_left: advice.budget_left,
    }
}

/// Requests until the service shall end, so that a client that keeps its stream open does not keep the service alive.
struct UntilCancelled {
    requests: Streaming<pb::AdviseRequest>,
    cancelled: Pin<Box<WaitForCancellationFutureOwned>>,
}

impl Stream for UntilCancelled {
    type Item = Result<pb::AdviseRequest, Status>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        if self.cancelled.as_mut().poll(context).is_ready() {
            return Poll::Ready(Some(Err(Status::unavailable("the teacher is shutting down"))));
        }
        Pin::new(&mut self.requests).poll_next(context)
    }
}
