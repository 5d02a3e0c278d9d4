//! Answers to requests for advice, one by one and as a stream.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use tandem_core::StepQuery;
use tandem_proto::{decode_account_name, encode_advice, pb};
use tokio_stream::{Stream, StreamExt as _};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::{Status, Streaming};

use super::messages::decode_queries;
use super::status;
use crate::advisor::{Advice, Advisor};
use crate::error::Error;

/// Steps answered on the spot, for two arms within some 250 microseconds; more are computed on a thread for
/// blocking work.
const MAX_STEPS_ON_THE_SPOT: usize = 8;

/// Answers in the order of their requests.
pub(super) type AnswerStream =
    Pin<Box<dyn Stream<Item = Result<pb::AdviseResponse, Status>> + Send>>;

/// The answer to one request.
pub(super) async fn answer(
    advisor: Arc<Advisor>,
    request: pb::AdviseRequest,
) -> Result<pb::AdviseResponse, Status> {
    let (account, queries) = decode(&advisor, request).map_err(|error| status(&error))?;
    let advice = if queries.len() <= MAX_STEPS_ON_THE_SPOT {
        advisor.advise(&account, &queries)
    } else {
        tokio::task::spawn_blocking(move || advisor.advise(&account, &queries))
            .await
            .map_err(|gone| Status::unavailable(gone.to_string()))?
    };
    advice.map(|advice| encode(&advice)).map_err(|error| status(&error))
}

/// The answers to `requests`, computed one at a time as they are read: flow control bounds what waits on either side.
///
/// The stream ends after the first request that cannot be answered, and when `shutdown` is cancelled.
pub(super) fn answer_all(
    advisor: Arc<Advisor>,
    requests: Streaming<pb::AdviseRequest>,
    shutdown: CancellationToken,
) -> AnswerStream {
    let answers = requests.then(move |request| {
        let advisor = Arc::clone(&advisor);
        async move { answer(advisor, request?).await }
    });
    Box::pin(UntilCancelled {
        answers: Some(Box::pin(answers)),
        cancelled: Box::pin(shutdown.cancelled_owned()),
    })
}

fn decode(
    advisor: &Advisor,
    request: pb::AdviseRequest,
) -> Result<(String, Vec<StepQuery>), Error> {
    let account = decode_account_name("account", request.account)?;
    Ok((account, decode_queries(request.steps, advisor.layout().task)?))
}

fn encode(advice: &Advice) -> pb::AdviseResponse {
    pb::AdviseResponse {
        steps: advice.steps.iter().map(encode_advice).collect(),
        budget_left: advice.budget_left,
    }
}

/// Answers until the service shall end, so that a client that keeps its stream open does not keep the service alive.
struct UntilCancelled {
    /// `None` once the stream has ended.
    answers: Option<AnswerStream>,
    cancelled: Pin<Box<WaitForCancellationFutureOwned>>,
}

impl Stream for UntilCancelled {
    type Item = Result<pb::AdviseResponse, Status>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        if self.answers.is_some() && self.cancelled.as_mut().poll(context).is_ready() {
            self.answers = None;
            return Poll::Ready(Some(Err(Status::unavailable("the teacher is shutting down"))));
        }
        let Some(answers) = self.answers.as_mut() else {
            return Poll::Ready(None);
        };
        let next = answers.as_mut().poll_next(context);
        if matches!(next, Poll::Ready(None | Some(Err(_)))) {
            self.answers = None;
        }
        next
    }
}
