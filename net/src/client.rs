//! The configuration of a client, and the channels it opens.

use std::fmt;
use std::future::Future;
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use http::Uri;
use http::header::HeaderValue;
use hyper_util::client::legacy::connect::HttpConnector;
use hyper_util::rt::TokioIo;
use tonic::transport::{Certificate, ClientTlsConfig, Endpoint};
use tower::ServiceExt as _;

use crate::access::Token;
use crate::channel::{AuthChannel, Target};
use crate::connection::Connection;
use crate::metrics::Metrics;
use crate::tls::{self, TlsError};
use crate::tls_probe::{FirstByte, SniffedStream};

/// The interval of keep-alive probes, and the time after which an unanswered probe closes the connection.
const KEEP_ALIVE: Duration = Duration::from_secs(10);
/// The deadline of a connection attempt, and of the TLS handshake after it.
const CONNECT: Duration = Duration::from_secs(5);

/// The largest HTTP/2 frame that a service may send, in bytes: the parameters of an actor (0.86 MB) fit into one frame
/// and are written at once.
const FRAME_BYTES: u32 = 1 << 20;

type Connecting = Pin<Box<dyn Future<Output = io::Result<Connection>> + Send>>;
type Connector = Arc<dyn Fn(Uri) -> Connecting + Send + Sync>;

/// An error that prevents an address from being called.
#[derive(Debug, thiserror::Error)]
pub enum ClientConfigError {
    /// The text is not an address.
    #[error("{0:?} is not an address: expected HOST:PORT, http://HOST:PORT or https://HOST:PORT")]
    InvalidAddress(String),
    /// The address requires TLS, and no authority is trusted.
    #[error("{0} requires TLS: name its authority's certificate in --tls-ca")]
    NoAuthority(String),
    /// TLS cannot be used with this address.
    #[error("{address} cannot be called by TLS")]
    Tls {
        /// The address as given.
        address: String,
        /// The cause.
        source: tonic::transport::Error,
    },
}

/// The configuration with which services are called: the token, the trusted authority and the network.
///
/// The default sends no token, trusts no authority and connects through the system's sockets.
#[derive(Clone, Default)]
pub struct ClientConfig {
    authorization: Option<HeaderValue>,
    authority: Option<Certificate>,
    connector: Option<Connector>,
    metrics: Metrics,
}

impl ClientConfig {
    /// Sends `token` with every call.
    ///
    /// # Panics
    /// Never: every token is a valid header value.
    #[must_use]
    pub fn with_token(mut self, token: &Token) -> Self {
        let mut value = HeaderValue::try_from(token.header()).expect("a token is printable ASCII");
        value.set_sensitive(true);
        self.authorization = Some(value);
        self
    }

    /// Uses TLS, and trusts services whose certificate is signed by one of the certificates in `authority` (PEM).
    ///
    /// # Errors
    /// When `authority` has no certificate, or one that cannot be used.
    pub fn with_authority(mut self, authority: &[u8]) -> Result<Self, TlsError> {
        tls::check_authority(authority)?;
        self.authority = Some(Certificate::from_pem(authority));
        Ok(self)
    }

    /// Records calls in `metrics`.
    #[must_use]
    pub fn with_metrics(mut self, metrics: Metrics) -> Self {
        self.metrics = metrics;
        self
    }

    /// Returns the metrics of the client's process.
    #[must_use]
    pub const fn metrics(&self) -> &Metrics {
        &self.metrics
    }

    /// Connects through `connector` instead of the system's sockets.
    #[must_use]
    pub fn with_connector<F>(mut self, connector: impl Fn(Uri) -> F + Send + Sync + 'static) -> Self
    where
        F: Future<Output = io::Result<Connection>> + Send + 'static,
    {
        self.connector = Some(Arc::new(move |uri| Box::pin(connector(uri))));
        self
    }

    /// Returns a channel to `address`, `HOST:PORT` or a URI whose scheme determines whether TLS is used.
    ///
    /// The channel connects on its first call. It must be created within a tokio runtime.
    ///
    /// # Errors
    /// When `address` is malformed, or requires TLS while no authority is trusted.
    pub fn channel(&self, address: &str) -> Result<AuthChannel, ClientConfigError> {
        let uri = self.uri(address)?;
        let uses_tls = uri.scheme_str() == Some("https");
        let endpoint = self.endpoint(uri, address)?;
        let first_byte = FirstByte::default();
        let connector = self.connector.clone().unwrap_or_else(sockets);
        let seen = first_byte.clone();
        let connect = tower::service_fn(move |uri| {
            let (connecting, first_byte) = (connector(uri), seen.clone());
            async move {
                first_byte.clear();
                let connection = tokio::time::timeout(CONNECT, connecting)
                    .await
                    .map_err(|_elapsed| io::Error::from(io::ErrorKind::TimedOut))??;
                Ok::<_, io::Error>(TokioIo::new(SniffedStream::new(connection, first_byte)))
            }
        });
        let channel = endpoint.connect_with_connector_lazy(connect);
        let authorization = self.authorization.clone();
        let address = address.to_owned();
        let metrics = self.metrics.clone();
        let target = Target { address, uses_tls, authorization, first_byte, metrics };
        Ok(AuthChannel::new(channel, target))
    }

    fn endpoint(&self, uri: Uri, address: &str) -> Result<Endpoint, ClientConfigError> {
        let uses_tls = uri.scheme_str() == Some("https");
        let endpoint = Endpoint::from(uri)
            .http2_keep_alive_interval(KEEP_ALIVE)
            .keep_alive_timeout(KEEP_ALIVE)
            .keep_alive_while_idle(true)
            .max_frame_size(FRAME_BYTES);
        if !uses_tls {
            return Ok(endpoint);
        }
        let authority = self.authority.clone();
        let authority =
            authority.ok_or_else(|| ClientConfigError::NoAuthority(address.to_owned()))?;
        let tls = ClientTlsConfig::new().ca_certificate(authority).timeout(CONNECT);
        endpoint
            .tls_config(tls)
            .map_err(|source| ClientConfigError::Tls { address: address.to_owned(), source })
    }

    /// Parses `address` into a URI with a scheme, a host and a port.
    fn uri(&self, address: &str) -> Result<Uri, ClientConfigError> {
        let scheme = if self.authority.is_some() { "https" } else { "http" };
        let with_scheme = match address.contains("://") {
            true => address.to_owned(),
            false => format!("{scheme}://{address}"),
        };
        let is_complete = |uri: &Uri| {
            matches!(uri.scheme_str(), Some("http" | "https"))
                && uri.host().is_some_and(|host| !host.is_empty())
                && uri.port_u16().is_some_and(|port| port != 0)
                && uri.path() == "/"
        };
        let uri = with_scheme.parse().ok().filter(is_complete);
        uri.ok_or_else(|| ClientConfigError::InvalidAddress(address.to_owned()))
    }
}

/// Returns a connector that uses the system's sockets.
fn sockets() -> Connector {
    let mut sockets = HttpConnector::new();
    sockets.enforce_http(false);
    sockets.set_nodelay(true);
    sockets.set_keepalive(Some(KEEP_ALIVE));
    sockets.set_connect_timeout(Some(CONNECT));
    Arc::new(move |uri| {
        let connecting = sockets.clone().oneshot(uri);
        Box::pin(async move {
            let stream = connecting.await.map_err(io::Error::other)?;
            Ok(Connection::new(stream.into_inner()))
        })
    })
}

impl fmt::Debug for ClientConfig {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("ClientConfig")
            .field("token", &self.authorization.is_some())
            .field("tls", &self.authority.is_some())
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_has_a_host_and_a_port() {
        let config = ClientConfig::default();
        let uri = |address: &str| config.uri(address).map(|uri| uri.to_string()).ok();
        for (address, expected) in [
            ("127.0.0.1:7000", "http://127.0.0.1:7000/"),
            ("[::1]:7000", "http://[::1]:7000/"),
            ("learner:7000", "http://learner:7000/"),
            ("http://learner:7000", "http://learner:7000/"),
            ("https://learner:7000/", "https://learner:7000/"),
        ] {
            assert_eq!(uri(address).as_deref(), Some(expected), "{address}");
        }
        for refused in [
            "",
            "learner",
            ":7000",
            "learner:",
            "learner:0",
            "learner:70000",
            "::1",
            "a b:7000",
            "ftp://learner:7000",
            "unix:///run/learner",
            "http://learner",
            "learner:7000/path",
        ] {
            assert_eq!(uri(refused), None, "{refused}");
        }
    }

    #[test]
    fn tls_requires_a_trusted_authority() {
        let refused =
            ClientConfig::default().channel("https://learner:7000").expect_err("no authority");
        assert!(matches!(refused, ClientConfigError::NoAuthority(_)), "{refused}");
        assert!(refused.to_string().contains("--tls-ca"), "{refused}");
    }
}
