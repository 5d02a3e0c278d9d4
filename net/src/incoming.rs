//! Incoming connections of a service.

use std::fmt;
use std::future::Future as _;
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use tokio::net::TcpListener;
use tokio::time::{Instant, Sleep};
use tokio_stream::Stream;

use crate::admission::{Admission, Capacity};
use crate::connection::Connection;
use crate::throttle::Throttle;

/// The pause after a failed `accept`; it doubles up to [`LONGEST_PAUSE`].
const FIRST_PAUSE: Duration = Duration::from_millis(5);
const LONGEST_PAUSE: Duration = Duration::from_secs(1);
/// The minimum time between two log lines about failed accepts.
const LOG_EVERY: Duration = Duration::from_secs(60);

/// The stream of connections to a service, within its [`Capacity`].
///
/// A connection that makes no request within 10 s is closed.
pub struct Incoming {
    accepted: Pin<Box<dyn Stream<Item = io::Result<Connection>> + Send>>,
    admission: Arc<Admission>,
    pause: Option<Pin<Box<Sleep>>>,
    next_pause: Duration,
    log: Throttle,
}

impl Incoming {
    /// Creates a stream from the connections of any network.
    pub fn new(connections: impl Stream<Item = io::Result<Connection>> + Send + 'static) -> Self {
        Self {
            accepted: Box::pin(connections),
            admission: Admission::new(Capacity::default()),
            pause: None,
            next_pause: FIRST_PAUSE,
            log: Throttle::default(),
        }
    }

    /// Sets the capacity. Must be called before the first connection is accepted.
    #[must_use]
    pub fn with_capacity(mut self, capacity: Capacity) -> Self {
        self.admission = Admission::new(capacity);
        self
    }

    /// Pauses before the next `accept` and evicts a connection, since an immediate attempt would find the same shortage.
    fn back_off(&mut self, error: &io::Error) {
        self.admission.make_room();
        if self.log.pass(Instant::now(), LOG_EVERY).is_some() {
            let n_open = self.admission.n_open();
            tracing::warn!(%error, n_open, "cannot accept connections, trying again");
        }
        self.pause = Some(Box::pin(tokio::time::sleep(self.next_pause)));
        self.next_pause = (2 * self.next_pause).min(LONGEST_PAUSE);
    }
}

/// Returns whether the error concerns a single connection that ended before it was accepted.
fn is_of_one_connection(error: &io::Error) -> bool {
    use io::ErrorKind as E;
    matches!(error.kind(), E::ConnectionAborted | E::ConnectionReset | E::Interrupted)
}

impl From<TcpListener> for Incoming {
    fn from(listener: TcpListener) -> Self {
        Self::new(Accepting(listener))
    }
}

/// The connections to a listening socket.
struct Accepting(TcpListener);

impl Stream for Accepting {
    type Item = io::Result<Connection>;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let accepted = ready!(self.0.poll_accept(context));
        Poll::Ready(Some(accepted.map(|(stream, peer)| {
            // Optional: without it the connection is slower, and a closed connection fails on the first read.
            stream.set_nodelay(true).ok();
            Connection::new(stream).with_peer(peer.ip())
        })))
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
        loop {
            ready!(self.admission.poll_room(context));
            if let Some(pause) = &mut self.pause {
                ready!(pause.as_mut().poll(context));
                self.pause = None;
            }
            match ready!(self.accepted.as_mut().poll_next(context)) {
                Some(Ok(connection)) => {
                    self.next_pause = FIRST_PAUSE;
                    return Poll::Ready(Some(Ok(connection.admitted_to(&self.admission))));
                }
                Some(Err(error)) if is_of_one_connection(&error) => {
                    context.waker().wake_by_ref();
                    return Poll::Pending;
                }
                Some(Err(error)) => self.back_off(&error),
                None => return Poll::Ready(None),
            }
        }
    }
}

#[cfg(test)]
mod tests;
