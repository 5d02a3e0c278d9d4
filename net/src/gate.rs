//! A service as it is offered: who may call it, and health, reflection and keep-alive beside it.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::time::Duration;

use tandem_proto::FILE_DESCRIPTOR_SET;
use tonic::body::Body;
use tonic::server::NamedService;
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::server::Router as TonicRouter;
use tonic::transport::{Identity, Server, ServerTlsConfig};
use tonic::{Request, Status};
use tonic_health::ServingStatus;
use tower::Service;
use tower::layer::util::{Identity as NoLayer, Stack};

use crate::access::{AccessError, Token, is_exposed};
use crate::connection::{Caller, Noting};
use crate::prepared::Sending;
use crate::tls::{self, TlsError};

/// How often a silent connection is probed, and how long a probe may stay unanswered before the connection is closed.
const KEEP_ALIVE: Duration = Duration::from_secs(10);
/// How long a client may take to agree on TLS.
const HANDSHAKE: Duration = Duration::from_secs(10);
/// Calls that one connection may have open; further ones wait on the client's side.
const MAX_STREAMS_PER_CONNECTION: u32 = 1024;

/// Why a service cannot be offered.
#[derive(Debug, thiserror::Error)]
pub enum GateError {
    /// The descriptors for reflection cannot be read.
    #[error("cannot describe the service")]
    Reflection(#[from] tonic_reflection::server::Error),
    /// The certificate or its key cannot be used.
    #[error("the certificate or its key cannot be used")]
    Tls(#[source] tonic::transport::Error),
}

/// A service with what is offered beside it, ready to be served to what is [`Incoming`](crate::Incoming).
pub type Router = TonicRouter<Stack<Noting, NoLayer>>;

/// Who may call a service, and how.
#[derive(Clone, Default)]
pub struct Gate {
    token: Option<Token>,
    identity: Option<Identity>,
}

impl Gate {
    /// Lets in only those who show `token`. Health can be asked without it.
    #[must_use]
    pub fn with_token(mut self, token: Token) -> Self {
        self.token = Some(token);
        self
    }

    /// Speaks TLS only, with this certificate chain and key (PEM).
    ///
    /// # Errors
    /// When one of them cannot be used, or they do not belong together.
    pub fn with_certificate(mut self, certificate: &[u8], key: &[u8]) -> Result<Self, TlsError> {
        tls::check_identity(certificate, key)?;
        self.identity = Some(Identity::from_pem(certificate, key));
        Ok(self)
    }

    /// Whether calls cross the network readable to others, the token with them.
    #[must_use]
    pub const fn is_plain(&self) -> bool {
        self.identity.is_none()
    }

    /// Refuses an address that other machines can reach while nobody needs a token.
    ///
    /// # Errors
    /// When `address` is not of the loopback and there is no token.
    pub fn check_address(&self, address: SocketAddr) -> Result<(), AccessError> {
        if is_exposed(address) && self.token.is_none() {
            return Err(AccessError::Unprotected(address));
        }
        Ok(())
    }

    /// What lets calls in.
    #[must_use]
    pub fn guard(&self) -> Guard {
        Guard { token: self.token.clone() }
    }

    /// `service` behind the guard, with health, and both versions of reflection behind the guard.
    ///
    /// # Errors
    /// When the certificate cannot be used.
    pub async fn router<S>(&self, service: S) -> Result<Router, GateError>
    where
        S: Service<http::Request<Body>, Response = http::Response<Body>, Error = Infallible>
            + NamedService
            + Clone
            + Send
            + Sync
            + 'static,
        S::Future: Send + 'static,
    {
        let (reporter, health) = tonic_health::server::health_reporter();
        reporter.set_service_status(S::NAME, ServingStatus::Serving).await;
        let reflection = || {
            tonic_reflection::server::Builder::configure()
                .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
                .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
        };
        let mut server = Server::builder()
            .http2_keepalive_interval(Some(KEEP_ALIVE))
            .http2_keepalive_timeout(Some(KEEP_ALIVE))
            .max_concurrent_streams(MAX_STREAMS_PER_CONNECTION);
        if let Some(identity) = &self.identity {
            let tls = ServerTlsConfig::new().identity(identity.clone()).timeout(HANDSHAKE);
            server = server.tls_config(tls).map_err(GateError::Tls)?;
        }
        Ok(server
            .layer(Noting)
            .add_service(InterceptedService::new(Sending(service), self.guard()))
            .add_service(health)
            .add_service(InterceptedService::new(reflection().build_v1()?, self.guard()))
            .add_service(InterceptedService::new(reflection().build_v1alpha()?, self.guard())))
    }
}

/// Lets calls in that show the token, if there is one.
#[derive(Debug, Clone)]
pub struct Guard {
    token: Option<Token>,
}

impl Interceptor for Guard {
    fn call(&mut self, request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(token) = &self.token {
            match request.metadata().get("authorization") {
                Some(shown) if token.is_shown_by(shown.as_bytes()) => {}
                Some(_) => return Err(Status::unauthenticated("the token is not this service's")),
                None => {
                    let message = "a token is needed: authorization: Bearer TOKEN";
                    return Err(Status::unauthenticated(message));
                }
            }
        }
        if let Some(caller) = request.extensions().get::<Caller>() {
            caller.authenticated();
        }
        Ok(request)
    }
}
