//! The connections that reach a service.

use std::fmt;
use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::time::Sleep;
use tokio_stream::{Stream, StreamExt as _};
use tonic::Extensions;
use tonic::transport::server::{Connected, TcpIncoming};

/// How long a client may take to say its first word.
const GREETING: Duration = Duration::from_secs(10);

/// A connection over any network.
pub struct Connection {
    stream: Pin<Box<dyn Duplex>>,
    /// Dropped with the connection.
    open: watch::Sender<()>,
}

trait Duplex: AsyncRead + AsyncWrite + Send {}
impl<T: AsyncRead + AsyncWrite + Send> Duplex for T {}

impl Connection {
    /// A connection over `stream`.
    pub fn new(stream: impl AsyncRead + AsyncWrite + Send + 'static) -> Self {
        Self { stream: Box::pin(stream), open: watch::Sender::new(()) }
    }
}

impl fmt::Debug for Connection {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Connection(..)")
    }
}

impl Connected for Connection {
    type ConnectInfo = Hangup;

    fn connect_info(&self) -> Hangup {
        Hangup(self.open.subscribe())
    }
}

/// Tells when a connection has ended.
#[derive(Debug, Clone)]
pub struct Hangup(watch::Receiver<()>);

impl Hangup {
    /// Of the connection over which a request with these extensions came; `None` when it came otherwise.
    #[must_use]
    pub fn of(extensions: &Extensions) -> Option<Self> {
        extensions.get::<Self>().cloned()
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
        self.stream.as_mut().poll_read(context, buffer)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.stream.as_mut().poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.stream.as_mut().poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.stream.as_mut().poll_shutdown(context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.stream.as_mut().poll_write_vectored(context, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

/// A connection that fails when its client says nothing at first.
struct Greeting<S> {
    stream: S,
    /// `None` once the client has spoken.
    patience: Option<Pin<Box<Sleep>>>,
}

impl<S> Greeting<S> {
    fn await_from(stream: S) -> Self {
        Self { stream, patience: Some(Box::pin(tokio::time::sleep(GREETING))) }
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Greeting<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let n_before = buffer.filled().len();
        let read = Pin::new(&mut self.stream).poll_read(context, buffer);
        if buffer.filled().len() > n_before {
            self.patience = None;
        }
        let patience = self.patience.as_mut();
        if patience.is_some_and(|patience| patience.as_mut().poll(context).is_ready()) {
            let silent = io::Error::new(io::ErrorKind::TimedOut, "the client says nothing");
            return Poll::Ready(Err(silent));
        }
        read
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Greeting<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(context, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

/// The connections that reach a service, as they come.
pub struct Incoming(Pin<Box<dyn Stream<Item = io::Result<Connection>> + Send>>);

impl Incoming {
    /// Connections over any network.
    pub fn new(connections: impl Stream<Item = io::Result<Connection>> + Send + 'static) -> Self {
        Self(Box::pin(connections))
    }
}

impl From<TcpListener> for Incoming {
    fn from(listener: TcpListener) -> Self {
        let accepted = TcpIncoming::from(listener).with_nodelay(Some(true));
        Self::new(accepted.map(|stream| Ok(Connection::new(Greeting::await_from(stream?)))))
    }
}

impl fmt::Debug for Incoming {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Incoming(..)")
    }
}

impl Stream for Incoming {
    type Item = io::Result<Connection>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.0.as_mut().poll_next(context)
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

    use super::*;

    #[tokio::test(start_paused = true)]
    async fn a_client_that_says_nothing_is_hung_up_on_and_one_that_spoke_is_not() {
        let (_silent, stream) = tokio::io::duplex(16);
        let refused = Greeting::await_from(stream).read_u8().await.unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::TimedOut);

        let (mut client, stream) = tokio::io::duplex(16);
        let mut greeting = Greeting::await_from(stream);
        client.write_u8(1).await.unwrap();
        assert_eq!(greeting.read_u8().await.unwrap(), 1);
        let later = async {
            tokio::time::sleep(10 * GREETING).await;
            client.write_u8(2).await.unwrap();
        };
        assert_eq!(tokio::join!(greeting.read_u8(), later).0.unwrap(), 2);
    }
}
