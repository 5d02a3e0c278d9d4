//! A connection that shows the token, and says in one line what is wrong when a call does not get through.

use std::error::Error;
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use http::header::{AUTHORIZATION, HeaderValue};
use tandem_core::text;
use tonic::body::Body;
use tonic::transport::Channel;
use tonic::{Code, Status};
use tower::Service;

use crate::elsewhere::{explain, is_unknown_call};
use crate::heard::Heard;

/// A connection that is made when first used, and made again whenever it is lost; it shows the token, if there is one.
///
/// A call that does not reach the service, or that the service's guard sends back, fails with a status whose message
/// names the address and what to do about it: `UNAVAILABLE`, which may pass, or `UNAUTHENTICATED`, which does not. So
/// does a call that the service does not know, `UNIMPLEMENTED`: it says which service the address is.
#[derive(Debug, Clone)]
pub struct Link {
    channel: Channel,
    peer: Arc<Peer>,
}

/// Who is called, and how.
#[derive(Debug)]
pub(crate) struct Peer {
    /// As it was given.
    pub(crate) address: String,
    /// Whether TLS is spoken.
    pub(crate) by_tls: bool,
    /// The header that shows the token.
    pub(crate) authorization: Option<HeaderValue>,
    /// What came first over the connection.
    pub(crate) heard: Heard,
}

impl Link {
    pub(crate) fn new(channel: Channel, peer: Peer) -> Self {
        Self { channel, peer: Arc::new(peer) }
    }
}

type Answer = Result<http::Response<Body>, Status>;

impl Service<http::Request<Body>> for Link {
    type Response = http::Response<Body>;
    type Error = Status;
    type Future = Pin<Box<dyn Future<Output = Answer> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Status>> {
        self.channel.poll_ready(context).map_err(|error| self.peer.unreachable(error))
    }

    fn call(&mut self, mut request: http::Request<Body>) -> Self::Future {
        if let Some(authorization) = &self.peer.authorization {
            request.headers_mut().insert(AUTHORIZATION, authorization.clone());
        }
        let (path, probe) = (request.uri().path().to_owned(), self.channel.clone());
        let (calling, peer) = (self.channel.call(request), Arc::clone(&self.peer));
        Box::pin(async move {
            match calling.await {
                Ok(response) if is_unknown_call(&response) => {
                    Err(explain(&peer.address, &path, probe).await)
                }
                Ok(response) => peer.let_in(response),
                Err(error) => Err(peer.unreachable(error)),
            }
        })
    }
}

impl Peer {
    /// The response, unless it says that the token is missing or wrong.
    fn let_in(&self, response: http::Response<Body>) -> Answer {
        match Status::from_header_map(response.headers()) {
            Some(status) if status.code() == Code::Unauthenticated => {
                let address = &self.address;
                Err(Status::unauthenticated(match self.authorization {
                    Some(_) => format!(
                        "{address} does not accept the token: name the file with the service's own token in --token-file"
                    ),
                    None => format!("{address} wants a token: name its file in --token-file"),
                }))
            }
            _ => Ok(response),
        }
    }

    /// What to tell when a call did not get through.
    fn unreachable(&self, error: tonic::transport::Error) -> Status {
        let (address, causes) = (&self.address, text::error_chain(&error));
        let message = match (self.by_tls, self.heard.is_tls()) {
            (true, Some(false)) => format!(
                "{address} does not speak TLS: leave --tls-ca out, or start it with --tls-cert and --tls-key"
            ),
            (false, Some(true)) => {
                format!("{address} speaks TLS: name its authority's certificate in --tls-ca")
            }
            (true, _) if is_certificate_refused(&error) => {
                format!("{address} is not trusted, see --tls-ca: {causes}")
            }
            _ => format!("{address} does not answer: {causes}"),
        };
        match Status::from_error(Box::new(error)).code() {
            code @ (Code::Cancelled | Code::DeadlineExceeded) => Status::new(code, message),
            _ => Status::unavailable(message),
        }
    }
}

/// Whether the service's certificate is what is wrong.
fn is_certificate_refused(error: &(dyn Error + 'static)) -> bool {
    text::causes(error).any(|cause| {
        // An I/O error's source is the source of what it wraps, not what it wraps.
        let wrapped = cause.downcast_ref::<std::io::Error>().and_then(|error| error.get_ref());
        let tls = match wrapped {
            Some(wrapped) => wrapped.downcast_ref(),
            None => cause.downcast_ref(),
        };
        matches!(tls, Some(rustls::Error::InvalidCertificate(_)))
    })
}
