//! Connections to services.

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
use crate::connection::Connection;
use crate::heard::{Heard, Listening};
use crate::link::{Link, Peer};
use crate::tls::{self, TlsError};

/// How often an idle connection is checked, and how long the check may take.
const KEEP_ALIVE: Duration = Duration::from_secs(10);
/// How long a connection attempt may take, and then the agreement on TLS.
const CONNECT: Duration = Duration::from_secs(5);

/// Largest piece in which a service may send its answer: an actor's parameters (0.86 MB) are written to a connection in
/// one go, not in 53.
const FRAME_BYTES: u32 = 1 << 20;

type Connecting = Pin<Box<dyn Future<Output = io::Result<Connection>> + Send>>;
type Connector = Arc<dyn Fn(Uri) -> Connecting + Send + Sync>;

/// Why an address cannot be called.
#[derive(Debug, thiserror::Error)]
pub enum DialError {
    /// Not an address.
    #[error("{0:?} is not an address: expected HOST:PORT, http://HOST:PORT or https://HOST:PORT")]
    Address(String),
    /// TLS is asked for, and nobody is trusted.
    #[error("{0} is to be called by TLS: name its authority's certificate in --tls-ca")]
    NoAuthority(String),
    /// TLS cannot be spoken with this address.
    #[error("{address} cannot be called by TLS")]
    Tls {
        /// What was given.
        address: String,
        /// Why not.
        source: tonic::transport::Error,
    },
}

/// How services are called: over which network, with which token, trusting whom.
#[derive(Clone, Default)]
pub struct Dial {
    authorization: Option<HeaderValue>,
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
        let mut value = HeaderValue::try_from(token.header()).expect("a token is printable ASCII");
        value.set_sensitive(true);
        self.authorization = Some(value);
        self
    }

    /// Speaks TLS with services whose certificates one of `authority` (PEM) has signed.
    ///
    /// # Errors
    /// When there is no certificate, or one that cannot be used.
    pub fn with_authority(mut self, authority: &[u8]) -> Result<Self, TlsError> {
        tls::check_authority(authority)?;
        self.authority = Some(Certificate::from_pem(authority));
        Ok(self)
    }

    /// Connects through `connector` and not through the system's sockets.
    #[must_use]
    pub fn through<F>(mut self, connector: impl Fn(Uri) -> F + Send + Sync + 'static) -> Self
    where
        F: Future<Output = io::Result<Connection>> + Send + 'static,
    {
        self.connector = Some(Arc::new(move |uri| Box::pin(connector(uri))));
        self
    }

    /// A connection to `address`: `HOST:PORT`, or a URI whose scheme says whether TLS is spoken. Call it inside a
    /// runtime.
    ///
    /// # Errors
    /// When the address is none, or is to be called by TLS and nobody is trusted.
    pub fn link(&self, address: &str) -> Result<Link, DialError> {
        let uri = self.uri(address)?;
        let by_tls = uri.scheme_str() == Some("https");
        let mut endpoint = Endpoint::from(uri)
            .http2_keep_alive_interval(KEEP_ALIVE)
            .keep_alive_timeout(KEEP_ALIVE)
            .keep_alive_while_idle(true)
            .max_frame_size(FRAME_BYTES);
        if by_tls {
            let authority = self.authority.clone();
            let authority = authority.ok_or_else(|| DialError::NoAuthority(address.to_owned()))?;
            let tls = ClientTlsConfig::new().ca_certificate(authority).timeout(CONNECT);
            endpoint = endpoint
                .tls_config(tls)
                .map_err(|source| DialError::Tls { address: address.to_owned(), source })?;
        }
        let heard = Heard::nothing();
        let (connector, to) = (self.connector.clone().unwrap_or_else(sockets), heard.clone());
        let connect = tower::service_fn(move |uri| {
            let (connecting, heard) = (connector(uri), to.clone());
            async move {
                heard.forget();
                let connection = tokio::time::timeout(CONNECT, connecting)
                    .await
                    .map_err(|_elapsed| io::Error::from(io::ErrorKind::TimedOut))??;
                Ok::<_, io::Error>(TokioIo::new(Listening::new(connection, heard)))
            }
        });
        let channel = endpoint.connect_with_connector_lazy(connect);
        let authorization = self.authorization.clone();
        Ok(Link::new(channel, Peer { address: address.to_owned(), by_tls, authorization, heard }))
    }

    /// `address` with a scheme, a host and a port.
    fn uri(&self, address: &str) -> Result<Uri, DialError> {
        let scheme = if self.authority.is_some() { "https" } else { "http" };
        let whole = match address.contains("://") {
            true => address.to_owned(),
            false => format!("{scheme}://{address}"),
        };
        let is_complete = |uri: &Uri| {
            matches!(uri.scheme_str(), Some("http" | "https"))
                && uri.host().is_some_and(|host| !host.is_empty())
                && uri.port_u16().is_some_and(|port| port != 0)
                && uri.path() == "/"
        };
        let uri = whole.parse().ok().filter(is_complete);
        uri.ok_or_else(|| DialError::Address(address.to_owned()))
    }
}

/// Connects through the system's sockets.
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

impl fmt::Debug for Dial {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("Dial")
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
        let dial = Dial::default();
        let uri = |address: &str| dial.uri(address).map(|uri| uri.to_string()).ok();
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
    fn tls_needs_somebody_to_trust() {
        let refused = Dial::default().link("https://learner:7000").expect_err("nobody is trusted");
        assert!(matches!(refused, DialError::NoAuthority(_)), "{refused}");
        assert!(refused.to_string().contains("--tls-ca"), "{refused}");
    }
}
