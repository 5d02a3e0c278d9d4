//! A connection over any network, at either end, and the information that its calls carry.

use std::fmt;
use std::io;
use std::net::IpAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::sync::watch;
use tonic::Extensions;
use tonic::transport::server::Connected;
use tower::{Layer, Service};

use crate::admission::{Admission, AdmissionHandle, AdmissionPermit};

/// A connection over any network.
pub struct Connection {
    stream: Pin<Box<dyn Duplex>>,
    /// Dropped with the connection.
    open: watch::Sender<()>,
    peer: Option<IpAddr>,
    /// The permit of a connection that a service has admitted.
    permit: Option<AdmissionPermit>,
}

trait Duplex: AsyncRead + AsyncWrite + Send {}
impl<T: AsyncRead + AsyncWrite + Send> Duplex for T {}

impl Connection {
    /// Creates a connection over `stream`.
    pub fn new(stream: impl AsyncRead + AsyncWrite + Send + 'static) -> Self {
        Self { stream: Box::pin(stream), open: watch::Sender::new(()), peer: None, permit: None }
    }

    /// Sets the peer's address. Services limit the number of connections without an authenticated call per address.
    #[must_use]
    pub fn with_peer(mut self, peer: IpAddr) -> Self {
        self.peer = Some(peer);
        self
    }

    /// Admits the connection to a service.
    pub(crate) fn admitted_to(mut self, admission: &Arc<Admission>) -> Self {
        self.permit = Some(admission.admit(self.peer));
        self
    }

    /// Returns an error when the connection must close.
    fn check(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        self.permit.as_mut().map_or(Ok(()), |permit| permit.check(context))
    }
}

impl fmt::Debug for Connection {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Connection(..)")
    }
}

impl Connected for Connection {
    type ConnectInfo = ConnectInfo;

    fn connect_info(&self) -> ConnectInfo {
        let handle = self.permit.as_ref().map(|permit| Arc::clone(&permit.handle));
        ConnectInfo { closed: ConnectionClosed(self.open.subscribe()), handle, peer: self.peer }
    }
}

/// The connection of a call, available in the extensions of every request.
#[derive(Debug, Clone)]
pub struct ConnectInfo {
    closed: ConnectionClosed,
    handle: Option<Arc<AdmissionHandle>>,
    peer: Option<IpAddr>,
}

impl ConnectInfo {
    /// Returns the address of the client that sent a request with these extensions, if it is known.
    #[must_use]
    pub fn peer(extensions: &Extensions) -> Option<IpAddr> {
        extensions.get::<Self>()?.peer
    }

    /// Records that a complete request has arrived.
    pub(crate) fn mark_requested(&self) {
        if let Some(handle) = &self.handle {
            handle.mark_requested();
        }
    }

    /// Records that a call has passed the token check.
    pub(crate) fn mark_authenticated(&self) {
        if let Some(handle) = &self.handle {
            handle.mark_authenticated();
        }
    }
}

/// A signal that a connection has closed.
#[derive(Debug, Clone)]
pub struct ConnectionClosed(watch::Receiver<()>);

impl ConnectionClosed {
    /// Returns the signal of the connection that delivered a request with these extensions; `None` if the request did
    /// not arrive over a [`Connection`].
    #[must_use]
    pub fn from_extensions(extensions: &Extensions) -> Option<Self> {
        extensions.get::<ConnectInfo>().map(|info| info.closed.clone())
    }

    /// Returns whether both signals belong to the same connection.
    #[must_use]
    pub fn is_same(&self, other: &Self) -> bool {
        self.0.same_channel(&other.0)
    }

    /// Waits until either end has closed the connection.
    pub async fn wait(mut self) {
        while self.0.changed().await.is_ok() {}
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.check(context)?;
        self.stream.as_mut().poll_read(context, buffer)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.check(context)?;
        self.stream.as_mut().poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.check(context)?;
        self.stream.as_mut().poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.check(context)?;
        self.stream.as_mut().poll_shutdown(context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.check(context)?;
        self.stream.as_mut().poll_write_vectored(context, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

/// A layer that records which connections have made a request.
#[derive(Debug, Clone, Copy)]
pub struct MarkRequestLayer;

/// The service that [`MarkRequestLayer`] makes.
#[derive(Debug, Clone)]
pub struct MarkRequest<S>(S);

impl<S> Layer<S> for MarkRequestLayer {
    type Service = MarkRequest<S>;

    fn layer(&self, service: S) -> MarkRequest<S> {
        MarkRequest(service)
    }
}

impl<S: Service<http::Request<B>>, B> Service<http::Request<B>> for MarkRequest<S> {
    type Response = S::Response;
    type Error = S::Error;
    type Future = S::Future;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.0.poll_ready(context)
    }

    fn call(&mut self, request: http::Request<B>) -> S::Future {
        if let Some(info) = request.extensions().get::<ConnectInfo>() {
            info.mark_requested();
        }
        self.0.call(request)
    }
}
