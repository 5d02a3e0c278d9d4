//! What a service says first tells whether it speaks TLS, whatever becomes of the connection afterwards.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU16, Ordering};
use std::task::{Context, Poll, ready};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

use crate::connection::Connection;

/// First bytes of TLS records that a service may begin with: an alert, a handshake.
const TLS_RECORDS: [u16; 2] = [0x15, 0x16];
/// No byte has come.
const NOTHING: u16 = u16::MAX;

/// The first byte that came over the latest connection.
#[derive(Debug, Clone)]
pub(crate) struct Heard(Arc<AtomicU16>);

impl Heard {
    pub(crate) fn nothing() -> Self {
        Self(Arc::new(AtomicU16::new(NOTHING)))
    }

    /// Whether TLS came, once something has come.
    pub(crate) fn is_tls(&self) -> Option<bool> {
        let first = self.0.load(Ordering::Relaxed);
        (first != NOTHING).then(|| TLS_RECORDS.contains(&first))
    }

    /// Forgets what came over former connections.
    pub(crate) fn forget(&self) {
        self.0.store(NOTHING, Ordering::Relaxed);
    }
}

/// A connection whose first byte is noted.
///
/// A service that speaks otherwise closes the connection, often before all has been written to it. The failed write
/// then waits for the service's last words.
#[derive(Debug)]
pub(crate) struct Listening {
    connection: Connection,
    heard: Heard,
    heard_something: bool,
    failed_write: Option<io::Error>,
}

impl Listening {
    pub(crate) const fn new(connection: Connection, heard: Heard) -> Self {
        Self { connection, heard, heard_something: false, failed_write: None }
    }

    fn note(&mut self, bytes: &[u8]) {
        if let Some(&first) = bytes.first().filter(|_| !self.heard_something) {
            self.heard.0.store(u16::from(first), Ordering::Relaxed);
            self.heard_something = true;
        }
    }

    /// The outcome of a write; a failed one is told after the last words.
    fn written<T>(
        &mut self,
        context: &mut Context<'_>,
        outcome: Poll<io::Result<T>>,
    ) -> Poll<io::Result<T>> {
        match outcome {
            Poll::Ready(Err(error)) if !self.heard_something => {
                self.failed_write = Some(error);
                self.last_words(context).map(Err)
            }
            outcome => outcome,
        }
    }

    /// Waits for what a service says before it is gone; gives why the write failed.
    fn last_words(&mut self, context: &mut Context<'_>) -> Poll<io::Error> {
        if !self.heard_something {
            let mut byte = [0];
            let mut buffer = ReadBuf::new(&mut byte);
            // Whatever comes of it: the write has failed already.
            drop(ready!(Pin::new(&mut self.connection).poll_read(context, &mut buffer)));
            self.note(buffer.filled());
        }
        let why = self.failed_write.take();
        Poll::Ready(why.unwrap_or_else(|| io::ErrorKind::BrokenPipe.into()))
    }
}

impl AsyncRead for Listening {
    fn poll_read(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let (this, n_before) = (self.get_mut(), buffer.filled().len());
        ready!(Pin::new(&mut this.connection).poll_read(context, buffer))?;
        this.note(&buffer.filled()[n_before..]);
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Listening {
    fn poll_write(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        if this.failed_write.is_some() {
            return this.last_words(context).map(Err);
        }
        let outcome = Pin::new(&mut this.connection).poll_write(context, bytes);
        this.written(context, outcome)
    }

    fn poll_flush(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        if this.failed_write.is_some() {
            return this.last_words(context).map(Err);
        }
        let outcome = Pin::new(&mut this.connection).poll_flush(context);
        this.written(context, outcome)
    }

    fn poll_shutdown(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().connection).poll_shutdown(context)
    }

    fn poll_write_vectored(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        if this.failed_write.is_some() {
            return this.last_words(context).map(Err);
        }
        let outcome = Pin::new(&mut this.connection).poll_write_vectored(context, slices);
        this.written(context, outcome)
    }

    fn is_write_vectored(&self) -> bool {
        self.connection.is_write_vectored()
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

    use super::*;

    /// A peer whose first words come later than the first write fails.
    struct Closing(&'static [u8], bool);

    impl AsyncRead for Closing {
        fn poll_read(
            mut self: Pin<&mut Self>,
            context: &mut Context<'_>,
            buffer: &mut ReadBuf<'_>,
        ) -> Poll<io::Result<()>> {
            if std::mem::replace(&mut self.1, true) {
                let (now, later) = self.0.split_at(self.0.len().min(buffer.remaining()));
                buffer.put_slice(now);
                self.0 = later;
                Poll::Ready(Ok(()))
            } else {
                context.waker().wake_by_ref();
                Poll::Pending
            }
        }
    }

    impl AsyncWrite for Closing {
        fn poll_write(
            self: Pin<&mut Self>,
            _: &mut Context<'_>,
            _: &[u8],
        ) -> Poll<io::Result<usize>> {
            Poll::Ready(Err(io::ErrorKind::ConnectionReset.into()))
        }

        fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
            Poll::Ready(Ok(()))
        }

        fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
            Poll::Ready(Ok(()))
        }
    }

    #[tokio::test]
    async fn the_last_words_are_heard_before_a_write_fails() {
        for (words, expected) in
            [(&b"\x15\x03\x03"[..], Some(true)), (b"\0\0\x12\x04", Some(false)), (b"", None)]
        {
            let heard = Heard::nothing();
            let connection = Connection::new(Closing(words, false));
            let mut listening = Listening::new(connection, heard.clone());
            let error = listening.write_all(b"PRI * HTTP/2.0").await.expect_err("is closing");
            assert_eq!(error.kind(), io::ErrorKind::ConnectionReset);
            assert_eq!(heard.is_tls(), expected, "{words:?}");
        }
    }

    #[tokio::test]
    async fn only_the_first_byte_of_the_latest_connection_counts() {
        let heard = Heard::nothing();
        for (words, expected) in [(&b"\x16\0\0"[..], Some(true)), (b"H\x15\x15", Some(false))] {
            heard.forget();
            assert_eq!(heard.is_tls(), None);
            let (near, mut far) = tokio::io::duplex(16);
            let mut listening = Listening::new(Connection::new(near), heard.clone());
            far.write_all(words).await.expect("there is room");
            drop(far);
            let mut read = Vec::new();
            listening.read_to_end(&mut read).await.expect("reads");
            assert_eq!(read, words, "nothing of it is lost");
            assert_eq!(heard.is_tls(), expected, "{words:?}");
        }
    }
}
