//! Answers that are encoded once and sent to many.

use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};

use http::{HeaderMap, HeaderValue};
use http_body_util::{BodyExt as _, Full};
use prost::Message;
use prost::bytes::{BufMut as _, Bytes, BytesMut};
use tonic::Response;
use tonic::body::Body;
use tonic::server::NamedService;
use tower::Service;

/// Bytes before a message: whether it is compressed, and its length.
const PREFIX_BYTES: usize = 5;

/// An answer as it crosses the wire. A copy shares its bytes: however many it is being sent to, it is in memory once.
#[derive(Debug, Clone)]
pub struct Prepared(Bytes);

impl Prepared {
    /// Encodes `message`.
    ///
    /// # Panics
    /// When it has 4 GiB or more.
    #[must_use]
    pub fn of(message: &impl Message) -> Self {
        let n_bytes = message.encoded_len();
        let mut frame = BytesMut::with_capacity(PREFIX_BYTES + n_bytes);
        frame.put_u8(0);
        frame.put_u32(u32::try_from(n_bytes).expect("messages are shorter than 4 GiB"));
        message.encode(&mut frame).expect("a buffer grows");
        Self(frame.freeze())
    }

    /// The answer to a call of a service behind a [`Gate`](crate::Gate), which sends it in place of an empty one.
    #[must_use]
    pub fn answer<M: Default>(self) -> Response<M> {
        let mut response = Response::new(M::default());
        response.extensions_mut().insert(self);
        response
    }

    fn into_body(self) -> Body {
        let mut trailers = HeaderMap::new();
        trailers.insert("grpc-status", HeaderValue::from_static("0"));
        Body::new(Full::new(self.0).with_trailers(std::future::ready(Some(Ok(trailers)))))
    }
}

/// A service whose answers may be [`Prepared`].
#[derive(Debug, Clone)]
pub(crate) struct Sending<S>(pub(crate) S);

impl<S: NamedService> NamedService for Sending<S> {
    const NAME: &'static str = S::NAME;
}

impl<S> Service<http::Request<Body>> for Sending<S>
where
    S: Service<http::Request<Body>, Response = http::Response<Body>>,
    S::Future: Send + 'static,
{
    type Response = http::Response<Body>;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, S::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.0.poll_ready(context)
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        let answering = self.0.call(request);
        Box::pin(async move {
            let mut response = answering.await?;
            if let Some(prepared) = response.extensions_mut().remove::<Prepared>() {
                *response.body_mut() = prepared.into_body();
            }
            Ok(response)
        })
    }
}

#[cfg(test)]
mod tests {
    use tandem_proto::pb;

    use super::*;

    #[tokio::test]
    async fn an_answer_has_its_length_its_bytes_and_says_that_all_is_well() {
        let message = pb::GetParametersRequest { version: 300 };
        let body = Prepared::of(&message).into_body().collect().await.unwrap();
        assert_eq!(body.trailers().unwrap()["grpc-status"], "0");
        let bytes = body.to_bytes();
        assert_eq!(bytes[..5], [0, 0, 0, 0, 3]);
        assert_eq!(bytes[5..], message.encode_to_vec());
    }

    #[test]
    fn copies_share_their_bytes() {
        let prepared = Prepared::of(&pb::Parameters { actor: vec![7; 1000], ..Default::default() });
        assert_eq!(prepared.clone().0.as_ptr(), prepared.0.as_ptr());
    }
}
