//! A stream of requests to a peer, each of which has one response.

use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Response, Status, Streaming};

/// The capacity of a stream, in requests. One request is open at a time, so the worker never waits for room.
const CAPACITY: usize = 1;

/// An open stream of requests `Q` with responses `A`.
#[derive(Debug)]
pub(crate) struct RequestStream<Q, A> {
    requests: mpsc::Sender<Q>,
    responses: Streaming<A>,
}

impl<Q, A> RequestStream<Q, A> {
    /// Sends a request to `peer`, over `stream` if there is one and over one that `open` opens otherwise. Returns the
    /// response and the stream.
    ///
    /// A stream that failed is gone: its next response could be to an earlier request.
    pub(crate) async fn exchange<F>(
        peer: &str,
        stream: Option<Self>,
        request: Q,
        open: impl FnOnce(ReceiverStream<Q>) -> F,
    ) -> Result<(A, Self), Status>
    where
        F: Future<Output = Result<Response<Streaming<A>>, Status>>,
    {
        let closed = || Status::unavailable(format!("the {peer} closed the stream"));
        let mut stream = match stream {
            Some(stream) => {
                stream.requests.send(request).await.map_err(|_unsent| closed())?;
                stream
            }
            None => {
                // With its first request, because some servers do not answer before they have one.
                let (requests, outgoing) = mpsc::channel(CAPACITY);
                requests.send(request).await.map_err(|_unsent| closed())?;
                let responses = open(ReceiverStream::new(outgoing)).await?.into_inner();
                Self { requests, responses }
            }
        };
        let response = stream.responses.message().await?.ok_or_else(closed)?;
        Ok((response, stream))
    }
}
