//! The configuration of a service: its token and certificate, and the health, reflection and keep-alive it offers.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::time::Duration;

use tonic::body::Body;
use tonic::server::NamedService;
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::server::Router as TonicRouter;
use tonic::transport::{Identity, Server, ServerTlsConfig};
use tonic::{Request, Status};
use tonic_health::ServingStatus;
use tonic_health::server::health_reporter;
use tower::Service;
use tower::layer::util::{Identity as NoLayer, Stack};
use tower::util::MapResponseLayer;

use crate::access::{AccessError, Token, is_exposed};
use crate::connection::{ConnectInfo, MarkRequestLayer};
use crate::encoded_response::EncodedService;
use crate::health::HealthReporter;
use crate::metrics::{Methods, Metrics, RpcLayer};
use crate::tls::{self, TlsError};
use crate::wrong_service::name_service;

/// The interval of keep-alive probes, and the time after which an unanswered probe closes the connection.
const KEEP_ALIVE: Duration = Duration::from_secs(10);
/// The deadline of the TLS handshake.
const HANDSHAKE: Duration = Duration::from_secs(10);
/// The maximum number of open calls per connection; further calls wait at the client.
const MAX_STREAMS_PER_CONNECTION: u32 = 1024;

/// An error that prevents a service from being offered.
#[derive(Debug, thiserror::Error)]
pub enum ServerConfigError {
    /// The descriptors for reflection cannot be read.
    #[error("cannot read the descriptors of the service")]
    Reflection(#[from] tonic_reflection::server::Error),
    /// The certificate or its key cannot be used.
    #[error("the certificate or its key cannot be used")]
    Tls(#[source] tonic::transport::Error),
}

type NameServiceLayer = MapResponseLayer<fn(http::Response<Body>) -> http::Response<Body>>;
type Layers = Stack<RpcLayer, Stack<NameServiceLayer, Stack<MarkRequestLayer, NoLayer>>>;

/// A service with its health and reflection services, ready for [`serve`](crate::serve()).
pub type Router = TonicRouter<Layers>;

/// The configuration of a service: its token, its certificate and its metrics. The default has no token and no
/// certificate.
#[derive(Clone, Default)]
pub struct ServerConfig {
    token: Option<Token>,
    identity: Option<Identity>,
    metrics: Metrics,
}

impl ServerConfig {
    /// Requires `token` in every call except health checks.
    #[must_use]
    pub fn with_token(mut self, token: Token) -> Self {
        self.token = Some(token);
        self
    }

    /// Accepts TLS connections only, with this certificate chain and key (PEM).
    ///
    /// # Errors
    /// When the certificate or the key cannot be used, or they do not belong together.
    pub fn with_certificate(mut self, certificate: &[u8], key: &[u8]) -> Result<Self, TlsError> {
        tls::check_identity(certificate, key)?;
        self.identity = Some(Identity::from_pem(certificate, key));
        Ok(self)
    }

    /// Records calls in `metrics`, where the service also registers metrics of its own.
    #[must_use]
    pub fn with_metrics(mut self, metrics: Metrics) -> Self {
        self.metrics = metrics;
        self
    }

    /// Returns the metrics of the service's process.
    #[must_use]
    pub const fn metrics(&self) -> &Metrics {
        &self.metrics
    }

    /// Returns the token that calls require, if there is one.
    #[must_use]
    pub const fn token(&self) -> Option<&Token> {
        self.token.as_ref()
    }

    /// Returns whether calls, and the token in them, cross the network unencrypted.
    #[must_use]
    pub const fn is_plain(&self) -> bool {
        self.identity.is_none()
    }

    /// Checks that a service on `address` is protected if other machines can reach it.
    ///
    /// # Errors
    /// When `address` is not a loopback address and there is no token.
    pub fn check_address(&self, address: SocketAddr) -> Result<(), AccessError> {
        if is_exposed(address) && self.token.is_none() {
            return Err(AccessError::Unprotected(address));
        }
        Ok(())
    }

    /// Returns the router of `service`: the service and both versions of reflection behind the token check, and health
    /// without it.
    ///
    /// `descriptors` is the encoded `FileDescriptorSet` that reflection offers. Reflection lists only `service` and
    /// health, even if the set describes more services.
    ///
    /// # Errors
    /// When the certificate or the descriptors cannot be used.
    pub async fn router<S>(
        &self,
        service: S,
        descriptors: &[u8],
    ) -> Result<Router, ServerConfigError>
    where
        S: Service<http::Request<Body>, Response = http::Response<Body>, Error = Infallible>
            + NamedService
            + Clone
            + Send
            + Sync
            + 'static,
        S::Future: Send + 'static,
    {
        let (reporter, health) = health_reporter();
        reporter.set_service_status(S::NAME, ServingStatus::Serving).await;
        let router = self
            .layered_server::<S>(descriptors)?
            .add_service(InterceptedService::new(EncodedService(service), self.interceptor()))
            .add_service(health);
        self.with_reflection(router, descriptors, &[S::NAME])
    }

    /// Returns the router of a process `S` that only calls other services, and what sets its health: health without the
    /// token check, and both versions of reflection behind it. The process is serving until the reporter says otherwise.
    ///
    /// # Errors
    /// When the certificate cannot be used.
    pub async fn health_router<S: NamedService>(
        &self,
    ) -> Result<(Router, HealthReporter), ServerConfigError> {
        let (reporter, health) = health_reporter();
        let reporter = HealthReporter::new(reporter, S::NAME);
        reporter.set_serving(true).await;
        let router = self.layered_server::<S>(&[])?.add_service(health);
        Ok((self.with_reflection(router, &[], &[])?, reporter))
    }

    /// Returns a server without services, whose layers measure the calls of `descriptors` and name the service `S` to
    /// callers of others.
    fn layered_server<S: NamedService>(
        &self,
        descriptors: &[u8],
    ) -> Result<Server<Layers>, ServerConfigError> {
        let methods = Methods::of(&[
            descriptors,
            tonic_health::pb::FILE_DESCRIPTOR_SET,
            tonic_reflection::pb::v1::FILE_DESCRIPTOR_SET,
            tonic_reflection::pb::v1alpha::FILE_DESCRIPTOR_SET,
        ]);
        Ok(self
            .server()?
            .layer(MarkRequestLayer)
            .layer(NameServiceLayer::new(name_service::<S>))
            .layer(RpcLayer { metrics: self.metrics.clone(), methods, token: self.token.clone() }))
    }

    /// Adds both versions of reflection, which list `services` and health.
    fn with_reflection(
        &self,
        router: Router,
        descriptors: &[u8],
        services: &[&str],
    ) -> Result<Router, ServerConfigError> {
        let reflection = || {
            let builder = tonic_reflection::server::Builder::configure()
                .register_encoded_file_descriptor_set(descriptors)
                .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
                .with_service_name(tonic_health::pb::health_server::SERVICE_NAME);
            services.iter().fold(builder, |builder, &service| builder.with_service_name(service))
        };
        Ok(router
            .add_service(InterceptedService::new(reflection().build_v1()?, self.interceptor()))
            .add_service(InterceptedService::new(
                reflection().build_v1alpha()?,
                self.interceptor(),
            )))
    }

    fn interceptor(&self) -> TokenInterceptor {
        TokenInterceptor { token: self.token.clone() }
    }

    fn server(&self) -> Result<Server, ServerConfigError> {
        let server = Server::builder()
            .http2_keepalive_interval(Some(KEEP_ALIVE))
            .http2_keepalive_timeout(Some(KEEP_ALIVE))
            .max_concurrent_streams(MAX_STREAMS_PER_CONNECTION);
        let Some(identity) = &self.identity else { return Ok(server) };
        let tls = ServerTlsConfig::new().identity(identity.clone()).timeout(HANDSHAKE);
        server.tls_config(tls).map_err(ServerConfigError::Tls)
    }
}

/// An interceptor that rejects calls without the service's token, if it has one.
#[derive(Debug, Clone)]
pub struct TokenInterceptor {
    token: Option<Token>,
}

impl Interceptor for TokenInterceptor {
    fn call(&mut self, request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(token) = &self.token {
            match request.metadata().get("authorization") {
                Some(header) if token.matches(header.as_bytes()) => {}
                Some(_) => return Err(Status::unauthenticated("the token is wrong")),
                None => {
                    let message = "a token is required: authorization: Bearer TOKEN";
                    return Err(Status::unauthenticated(message));
                }
            }
        }
        if let Some(connection) = request.extensions().get::<ConnectInfo>() {
            connection.mark_authenticated();
        }
        Ok(request)
    }
}
