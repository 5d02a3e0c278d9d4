//! Connections to services.

use std::fmt;
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use hyper_util::rt::TokioIo;
use tonic::metadata::Ascii;
use tonic::metadata::MetadataValue;
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint};
use tonic::{Request, Status};

use crate::access::Token;
use crate::incoming::Connection;

/// How often an idle connection is checked, and how long the check may take.
const KEEP_ALIVE: Duration = Duration::from_secs(10);
/// How long a connection attempt may take.
const CONNECT: Duration = Duration::from_secs(5);

/// A connection that is made when first used, and made again whenever it is lost; it shows the token, if there is one.
pub type Link = InterceptedService<Channel, Bearer>;

type Connecting = Pin<Box<dyn Future<Output = std::io::Result<Connection>> + Send>>;
type Connector = Arc<dyn Fn(http::Uri) -> Connecting + Send + Sync>;

/// Why an address cannot be called.
#[derive(Debug, thiserror::Error)]
pub enum DialError {
    /// Not an address.
    #[error("{address:?} is not an address")]
    Address {
        /// What was given.
        address: String,
        /// Why it is none.
        source: tonic::transport::Error,
    },
    /// The certificates cannot be used.
    #[error("the certificate authority's certificates cannot be used")]
    Tls(#[source] tonic::transport::Error),
}

/// How services are called: over which network, with which token, trusting whom.
#[derive(Clone, Default)]
pub struct Dial {
    token: Option<MetadataValue<Ascii>>,
    authority: Option<Certificate>,
    connector: Option<Connector>,
}

impl Dial {
    /// Shows `token` with every call.
    ///
    /// # Panics
    /// Never: a token fits into a header.
    #[must_use]
    pub fn with_token(mut self, token: &Token) -> Self {
        let mut value: MetadataValue<Ascii> =
            token.header().parse().expect("a token is printable ASCII");
        value.set_sensitive(true);
        self.token = Some(value);
        self
    }

    /// Speaks TLS with services whose certificates `authority` (PEM) has signed.
    #[must_use]
    pub fn with_authority(mut self, authority: &[u8]) -> Self {
        self.authority = Some(Certificate::from_pem(authority));
        self
    }

    /// Connects through `connector` and not through the system's sockets.
    #[must_use]
    pub fn through<F>(mut self, connector: impl Fn(http::Uri) -> F + Send + Sync + 'static) -> Self
    where
        F: Future<Output = std::io::Result<Connection>> + Send + 'static,
    {
        self.connector = Some(Arc::new(move |uri| Box::pin(connector(uri))));
        self
    }

    /// A connection to `address`: `HOST:PORT`, or a URI whose scheme says whether TLS is spoken. Call it inside a
    /// runtime.
    ///
    /// # Errors
    /// When the address is none, or the certificates cannot be used.
    pub fn link(&self, address: &str) -> Result<Link, DialError> {
        let endpoint = self.endpoint(address)?;
        let channel = match self.connector.clone() {
            None => endpoint.connect_lazy(),
            Some(connector) => {
                endpoint.connect_with_connector_lazy(tower::service_fn(move |uri| {
                    let connecting = connector(uri);
                    async move { connecting.await.map(TokioIo::new) }
                }))
            }
        };
        Ok(InterceptedService::new(channel, Bearer { token: self.token.clone() }))
    }

    fn endpoint(&self, address: &str) -> Result<Endpoint, DialError> {
        let scheme = if self.authority.is_some() { "https" } else { "http" };
        let uri = if address.contains("://") {
            address.to_owned()
        } else {
            format!("{scheme}://{address}")
        };
        let is_tls = uri.starts_with("https://");
        let endpoint = Endpoint::from_shared(uri)
            .map_err(|source| DialError::Address { address: address.to_owned(), source })?
            .connect_timeout(CONNECT)
            .tcp_nodelay(true)
            .tcp_keepalive(Some(KEEP_ALIVE))
            .http2_keep_alive_interval(KEEP_ALIVE)
            .keep_alive_timeout(KEEP_ALIVE)
            .keep_alive_while_idle(true);
        match &self.authority {
            Some(authority) if is_tls => endpoint
                .tls_config(ClientTlsConfig::new().ca_certificate(authority.clone()))
                .map_err(DialError::Tls),
            _ => Ok(endpoint),
        }
    }
}

impl fmt::Debug for Dial {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("Dial")
            .field("token", &self.token.is_some())
            .field("tls", &self.authority.is_some())
            .finish_non_exhaustive()
    }
}

/// Puts the token, if there is one, on every call.
#[derive(Debug, Clone)]
pub struct Bearer {
    token: Option<MetadataValue<Ascii>>,
}

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(token) = &self.token {
            request.metadata_mut().insert("authorization", token.clone());
        }
        Ok(request)
    }
}
