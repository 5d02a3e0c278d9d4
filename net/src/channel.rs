//! A channel to a service that sends the token and reports failures in one line.

use std::error::Error;
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use http::header::{AUTHORIZATION, HeaderValue};
use tandem_core::text::{causes, error_chain};
use tonic::body::Body;
use tonic::transport::Channel;
use tonic::{Code, Status};
use tower::Service;

use crate::metrics::{MeasuredCall, Metrics, Side, labels_of};
use crate::tls_probe::FirstByte;
use crate::trace::TraceContext;
use crate::wrong_service::unknown_call;

/// Part of the message of a call to an address at which no process listens.
pub const NOTHING_LISTENS: &str = "nothing listens there";

/// A channel that connects on first use, reconnects after a loss, and sends the token, if there is one, with each call.
///
/// A call that does not reach the service, or that the service rejects for its token, fails with a status whose message
/// names the address and the remedy: `UNAVAILABLE`, which may pass, or `UNAUTHENTICATED`, which is final. A call that
/// the service does not know fails with `UNIMPLEMENTED` and a message that names the service at that address.
#[derive(Debug, Clone)]
pub struct AuthChannel {
    channel: Channel,
    target: Arc<Target>,
}

/// The service that a channel calls.
#[derive(Debug)]
pub(crate) struct Target {
    /// The address as the caller gave it.
    pub(crate) address: String,
    /// Set if the channel uses TLS.
    pub(crate) uses_tls: bool,
    /// The header with the token.
    pub(crate) authorization: Option<HeaderValue>,
    /// The first byte that the latest connection received.
    pub(crate) first_byte: FirstByte,
    /// The metrics that record calls.
    pub(crate) metrics: Metrics,
}

impl AuthChannel {
    pub(crate) fn new(channel: Channel, target: Target) -> Self {
        Self { channel, target: Arc::new(target) }
    }
}

impl Service<http::Request<Body>> for AuthChannel {
    type Response = http::Response<Body>;
    type Error = Status;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, Status>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Status>> {
        self.channel.poll_ready(context).map_err(|error| self.target.unavailable(error))
    }

    fn call(&mut self, mut request: http::Request<Body>) -> Self::Future {
        if let Some(authorization) = &self.target.authorization {
            request.headers_mut().insert(AUTHORIZATION, authorization.clone());
        }
        if let Some(trace) = request.extensions().get::<TraceContext>().copied() {
            trace.add_to(request.headers_mut());
        }
        let path = request.uri().path().to_owned();
        let mut measured =
            MeasuredCall::start(&self.target.metrics, Side::Client, labels_of(&path));
        let (call, target) = (self.channel.call(request), Arc::clone(&self.target));
        Box::pin(async move {
            let rejected = match call.await {
                Ok(response) => match target.rejection(&path, &response) {
                    None => return Ok(measured.measure(response)),
                    Some(status) => status,
                },
                Err(error) => target.unavailable(error),
            };
            measured.end(rejected.code());
            Err(rejected)
        })
    }
}

impl Target {
    /// Returns the status of a call that was rejected for its token or its path; `None` when it was accepted.
    fn rejection(&self, path: &str, response: &http::Response<Body>) -> Option<Status> {
        let address = &self.address;
        if let Some(status) = unknown_call(address, path, response) {
            return Some(status);
        }
        Status::from_header_map(response.headers())
            .filter(|status| status.code() == Code::Unauthenticated)
            .map(|_| {
                Status::unauthenticated(match self.authorization {
                    Some(_) => format!(
                        "{address} does not accept the token: name the file with the service's own token in --token-file"
                    ),
                    None => format!("{address} requires a token: name its file in --token-file"),
                })
            })
    }

    /// Returns the status of a call that did not reach the service.
    fn unavailable(&self, error: tonic::transport::Error) -> Status {
        let (address, chain) = (&self.address, error_chain(&error));
        let message = match (self.uses_tls, self.first_byte.is_tls()) {
            (true, Some(false)) => format!(
                "{address} does not speak TLS: leave --tls-ca out, or start it with --tls-cert and --tls-key"
            ),
            (false, Some(true)) => {
                format!("{address} speaks TLS: name its authority's certificate in --tls-ca")
            }
            (true, _) if is_certificate_rejected(&error) => {
                format!("{address} is not trusted, see --tls-ca: {chain}")
            }
            _ if is_connection_refused(&error) => {
                format!("{address} does not answer: {NOTHING_LISTENS}")
            }
            _ => format!("{address} does not answer: {chain}"),
        };
        match Status::from_error(Box::new(error)).code() {
            code @ (Code::Cancelled | Code::DeadlineExceeded) => Status::new(code, message),
            _ => Status::unavailable(message),
        }
    }
}

/// Returns whether the machine at the address has rejected the connection because no process listens.
fn is_connection_refused(error: &(dyn Error + 'static)) -> bool {
    let kinds = causes(error).filter_map(|cause| cause.downcast_ref::<std::io::Error>());
    kinds.map(std::io::Error::kind).any(|kind| kind == std::io::ErrorKind::ConnectionRefused)
}

/// Returns whether the client rejected the service's certificate.
fn is_certificate_rejected(error: &(dyn Error + 'static)) -> bool {
    causes(error).any(|cause| {
        // `io::Error::source` skips the wrapped error and returns that error's source.
        let wrapped = cause.downcast_ref::<std::io::Error>().and_then(|error| error.get_ref());
        let tls = match wrapped {
            Some(wrapped) => wrapped.downcast_ref(),
            None => cause.downcast_ref(),
        };
        matches!(tls, Some(rustls::Error::InvalidCertificate(_)))
    })
}
