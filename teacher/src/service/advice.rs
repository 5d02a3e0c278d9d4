//! The calls `Advise` and `AdviseStream`.

use std::pin::Pin;
use std::task::{Context, Poll};

use tandem_net::TraceContext;
use tandem_proto::{decode_account_name, encode_advice, pb};
use tokio_stream::{Stream, StreamExt as _};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::{Status, Streaming};
use tracing::{Instrument as _, Span};

use super::convert::decode_queries;
use super::refused;
use super::thread::AdvisorHandle;
use crate::advisor::{Advice, AdviceRequest};
use crate::error::Error;

/// The responses of a stream, in the order of their requests.
pub(super) type AdviceStream =
    Pin<Box<dyn Stream<Item = Result<pb::AdviseResponse, Status>> + Send>>;

/// Answers one request.
pub(super) async fn advise(
    advisor: &AdvisorHandle,
    request: pb::AdviseRequest,
) -> Result<pb::AdviseResponse, Status> {
    let span = span_of(&request);
    let answer = async {
        let refused = |error| refused(advisor, &error);
        let request = decode(advisor, request).map_err(refused)?;
        let advice = advisor.advise(request).await;
        advice.map(|advice| encode(&advice)).map_err(refused)
    };
    answer.instrument(span).await
}

/// Returns the span of a request; none if it has no trace context. The header of a stream would not do: its requests
/// belong to many traces.
fn span_of(request: &pb::AdviseRequest) -> Span {
    let Ok(parent) = request.traceparent.parse::<TraceContext>() else { return Span::none() };
    let span = parent.child("server", 0).span(Some(parent), "Advise", "server");
    span.in_scope(|| tracing::debug!(steps = request.steps.len(), "advice requested"));
    span
}

/// Answers `requests` one at a time, as they are read. Flow control bounds the number of pending messages.
///
/// The stream ends with its first error: after a refused request, or, once `shutdown` is cancelled, after the pending
/// answer.
pub(super) fn advise_stream(
    advisor: AdvisorHandle,
    requests: Streaming<pb::AdviseRequest>,
    shutdown: CancellationToken,
) -> AdviceStream {
    let requests = UntilCancelled { requests, cancelled: Box::pin(shutdown.cancelled_owned()) };
    Box::pin(requests.then(move |request| {
        let advisor = advisor.clone();
        async move { advise(&advisor, request?).await }
    }))
}

fn decode(advisor: &AdvisorHandle, request: pb::AdviseRequest) -> Result<AdviceRequest, Error> {
    let account = decode_account_name("account", request.account)?;
    let queries = decode_queries(request.steps, &advisor.info().students)?;
    Ok(AdviceRequest { account, queries })
}

fn encode(advice: &Advice) -> pb::AdviseResponse {
    pb::AdviseResponse {
        steps: advice.steps.iter().map(encode_advice).collect(),
        budget_left: advice.budget_left,
    }
}

/// Requests until shutdown, so that a client with an open stream does not keep the service alive.
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
