//! Responses that are encoded once and sent to many clients.

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

/// The length of the gRPC frame header, in bytes: the compression flag and the message's length.
const PREFIX_BYTES: usize = 5;

/// An encoded response. Clones share its bytes, so it is in memory once, no matter how many clients receive it.
#[derive(Debug, Clone)]
pub struct EncodedResponse(Bytes);

impl EncodedResponse {
    /// Encodes `message`.
    ///
    /// # Panics
    /// When the encoded message has 4 GiB or more.
    #[must_use]
    pub fn encode(message: &impl Message) -> Self {
        let n_bytes = message.encoded_len();
        let mut frame = BytesMut::with_capacity(PREFIX_BYTES + n_bytes);
        frame.put_u8(0);
        frame.put_u32(u32::try_from(n_bytes).expect("messages are shorter than 4 GiB"));
        message.encode(&mut frame).expect("the buffer grows as needed");
        Self(frame.freeze())
    }

    /// Returns the number of bytes of the message.
    #[must_use]
    pub fn message_bytes(&self) -> usize {
        self.0.len() - PREFIX_BYTES
    }

    /// Returns the response to a call: an empty message, which the service's [`Router`](crate::Router) replaces by the
    /// encoded one.
    #[must_use]
    pub fn into_response<M: Default>(self) -> Response<M> {
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

/// A service whose responses may be an [`EncodedResponse`].
#[derive(Debug, Clone)]
pub(crate) struct EncodedService<S>(pub(crate) S);

impl<S: NamedService> NamedService for EncodedService<S> {
    const NAME: &'static str = S::NAME;
}

impl<S> Service<http::Request<Body>> for EncodedService<S>
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
        let call = self.0.call(request);
        Box::pin(async move {
            let mut response = call.await?;
            if let Some(encoded) = response.extensions_mut().remove::<EncodedResponse>() {
                *response.body_mut() = encoded.into_body();
            }
            Ok(response)
        })
    }
}

#[cfg(test)]
mod tests {
    use tonic_health::pb::HealthCheckRequest;

    use super::*;

    #[tokio::test]
    async fn a_body_is_one_frame_with_an_ok_status() {
        let message = HealthCheckRequest { service: "a".to_owned() };
        let encoded = EncodedResponse::encode(&message);
        assert_eq!(encoded.message_bytes(), 3);
        let body = encoded.into_body().collect().await.unwrap();
        assert_eq!(body.trailers().unwrap()["grpc-status"], "0");
        let bytes = body.to_bytes();
        assert_eq!(bytes[..5], [0, 0, 0, 0, 3]);
        assert_eq!(bytes[5..], message.encode_to_vec());
    }

    #[test]
    fn clones_share_their_bytes() {
        let message = HealthCheckRequest { service: "a".repeat(1000) };
        let encoded = EncodedResponse::encode(&message);
        assert_eq!(encoded.clone().0.as_ptr(), encoded.0.as_ptr());
    }
}
