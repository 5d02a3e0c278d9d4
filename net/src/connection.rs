//! A connection over any network, on either side, and what its calls can know of it.

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

use crate::admission::{Admission, Place, Seat};

/// A connection over any network.
pub struct Connection {
    stream: Pin<Box<dyn Duplex>>,
    /// Dropped with the connection.
    open: watch::Sender<()>,
    peer: Option<IpAddr>,
    /// Held by connections that a service has admitted.
    seat: Option<Seat>,
}

trait Duplex: AsyncRead + AsyncWrite + Send {}
impl<T: AsyncRead + AsyncWrite + Send> Duplex for T {}

impl Connection {
    /// A connection over `stream`.
    pub fn new(stream: impl AsyncRead + AsyncWrite + Send + 'static) -> Self {
        Self { stream: Box::pin(stream), open: watch::Sender::new(()), peer: None, seat: None }
    }

    /// Names the other side's address: a service bounds how many connections without an authenticated call one address
    /// has.
    #[must_use]
    pub fn with_peer(mut self, peer: IpAddr) -> Self {
        self.peer = Some(peer);
        self
    }

    /// Takes a place among the connections of a service.
    pub(crate) fn admitted_to(mut self, admission: &Arc<Admission>) -> Self {
        self.seat = Some(admission.admit(self.peer));
        self
    }

    /// Fails when the connection has to close.
    fn check(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        self.seat.as_mut().map_or(Ok(()), |seat| seat.check(context))
    }
}

impl fmt::Debug for Connection {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Connection(..)")
    }
}

impl Connected for Connection {
    type ConnectInfo = Caller;

    fn connect_info(&self) -> Caller {
        let place = self.seat.as_ref().map(|seat| Arc::clone(&seat.place));
        Caller { hangup: Hangup(self.open.subscribe()), place }
    }
}

/// The connection over which a call came.
#[derive(Debug, Clone)]
pub struct Caller {
    hangup: Hangup,
    place: Option<Arc<Place>>,
}

impl Caller {
    /// Notes that a complete request has come.
    pub(crate) fn requested(&self) {
        if let Some(place) = &self.place {
            place.requested();
        }
    }

    /// Notes that a call has passed the guard.
    pub(crate) fn authenticated(&self) {
        if let Some(place) = &self.place {
            place.authenticated();
        }
    }
}

/// Tells when a connection has ended.
#[derive(Debug, Clone)]
pub struct Hangup(watch::Receiver<()>);

impl Hangup {
    /// Of the connection over which a request with these extensions came; `None` when it came otherwise.
    #[must_use]
    pub fn of(extensions: &Extensions) -> Option<Self> {
        extensions.get::<Caller>().map(|caller| caller.hangup.clone())
    }

    /// Whether both are of the same connection.
    #[must_use]
    pub fn is_same(&self, other: &Self) -> bool {
        self.0.same_channel(&other.0)
    }

    /// Waits until the connection has ended, from whichever side.
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

/// Makes a service note that a connection has made a request.
#[derive(Debug, Clone, Copy)]
pub struct Noting;

/// A service that notes of each connection that it has made a request.
#[derive(Debug, Clone)]
pub struct NotingRequests<S>(S);

impl<S> Layer<S> for Noting {
    type Service = NotingRequests<S>;

    fn layer(&self, service: S) -> NotingRequests<S> {
        NotingRequests(service)
    }
}

impl<S: Service<http::Request<B>>, B> Service<http::Request<B>> for NotingRequests<S> {
    type Response = S::Response;
    type Error = S::Error;
    type Future = S::Future;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.0.poll_ready(context)
    }

    fn call(&mut self, request: http::Request<B>) -> S::Future {
        if let Some(caller) = request.extensions().get::<Caller>() {
            caller.requested();
        }
        self.0.call(request)
    }
}
