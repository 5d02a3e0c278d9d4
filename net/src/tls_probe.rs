//! Detection of TLS at the other end of a connection, from the first byte received.
//!
//! A client that expects plain HTTP/2 from a TLS server, or the reverse, sees the connection closed: depending on
//! timing, as a reset, a broken pipe or a truncated frame, the same errors as those of a server that was killed. The
//! first byte that the server sent distinguishes the cases: it is a TLS record or it is not.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU16, Ordering};
use std::task::{Context, Poll, ready};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

use crate::connection::Connection;

/// The types of the TLS records that a server may send first: an alert, a handshake.
const TLS_RECORDS: [u16; 2] = [0x15, 0x16];
/// The value before any byte is received.
const NONE: u16 = u16::MAX;

/// The first byte received over the latest connection of a channel. Clones share it.
#[derive(Debug, Clone)]
pub(crate) struct FirstByte(Arc<AtomicU16>);

impl Default for FirstByte {
    fn default() -> Self {
        Self(Arc::new(AtomicU16::new(NONE)))
    }
}

impl FirstByte {
    /// Returns whether the byte begins a TLS record; `None` before a byte is received.
    pub(crate) fn is_tls(&self) -> Option<bool> {
        let first = self.0.load(Ordering::Relaxed);
        (first != NONE).then(|| TLS_RECORDS.contains(&first))
    }

    /// Discards the byte of the previous connection.
    pub(crate) fn clear(&self) {
        self.0.store(NONE, Ordering::Relaxed);
    }
}

/// A connection that records the first byte it receives.
///
/// A TLS mismatch often makes the server close the connection before the client has written everything. After a failed
/// write the stream therefore reads one byte before it returns the error.
#[derive(Debug)]
pub(crate) struct SniffedStream {
    connection: Connection,
    first_byte: FirstByte,
    received: bool,
    failed_write: Option<io::Error>,
}

impl SniffedStream {
    pub(crate) const fn new(connection: Connection, first_byte: FirstByte) -> Self {
        Self { connection, first_byte, received: false, failed_write: None }
    }

    fn record(&mut self, bytes: &[u8]) {
        if let Some(&first) = bytes.first().filter(|_| !self.received) {
            self.first_byte.0.store(u16::from(first), Ordering::Relaxed);
            self.received = true;
        }
    }

    /// Performs `write`. If it fails before any byte was received, waits for one before returning the error.
    fn poll_write_with<T>(
        &mut self,
        context: &mut Context<'_>,
        write: impl FnOnce(Pin<&mut Connection>, &mut Context<'_>) -> Poll<io::Result<T>>,
    ) -> Poll<io::Result<T>> {
        if self.failed_write.is_none() {
            match write(Pin::new(&mut self.connection), context) {
                Poll::Ready(Err(error)) if !self.received => self.failed_write = Some(error),
                outcome => return outcome,
            }
        }
        self.poll_first_byte(context).map(Err)
    }

    /// Waits for the first byte or the end of the connection; returns the error of the failed write.
    fn poll_first_byte(&mut self, context: &mut Context<'_>) -> Poll<io::Error> {
        if !self.received {
            let mut byte = [0];
            let mut buffer = ReadBuf::new(&mut byte);
            // The outcome does not matter: the write has failed already.
            drop(ready!(Pin::new(&mut self.connection).poll_read(context, &mut buffer)));
            self.record(buffer.filled());
        }
        let error = self.failed_write.take();
        Poll::Ready(error.unwrap_or_else(|| io::ErrorKind::BrokenPipe.into()))
    }
}

impl AsyncRead for SniffedStream {
    fn poll_read(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let (this, n_before) = (self.get_mut(), buffer.filled().len());
        ready!(Pin::new(&mut this.connection).poll_read(context, buffer))?;
        this.record(&buffer.filled()[n_before..]);
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for SniffedStream {
    fn poll_write(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.get_mut().poll_write_with(context, |stream, context| stream.poll_write(context, bytes))
    }

    fn poll_flush(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.get_mut().poll_write_with(context, AsyncWrite::poll_flush)
    }

    fn poll_shutdown(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().connection).poll_shutdown(context)
    }

    fn poll_write_vectored(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.get_mut()
            .poll_write_with(context, |stream, context| stream.poll_write_vectored(context, slices))
    }

    fn is_write_vectored(&self) -> bool {
        self.connection.is_write_vectored()
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

    use super::*;

    /// A peer whose writes fail, and whose first bytes arrive on the second read.
    struct Closing {
        bytes: &'static [u8],
        was_polled: bool,
    }

    impl AsyncRead for Closing {
        fn poll_read(
            mut self: Pin<&mut Self>,
            context: &mut Context<'_>,
            buffer: &mut ReadBuf<'_>,
        ) -> Poll<io::Result<()>> {
            if std::mem::replace(&mut self.was_polled, true) {
                let (now, later) = self.bytes.split_at(self.bytes.len().min(buffer.remaining()));
                buffer.put_slice(now);
                self.bytes = later;
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
    async fn a_failed_write_returns_after_the_first_byte() {
        for (bytes, expected) in
            [(&b"\x15\x03\x03"[..], Some(true)), (b"\0\0\x12\x04", Some(false)), (b"", None)]
        {
            let first_byte = FirstByte::default();
            let connection = Connection::new(Closing { bytes, was_polled: false });
            let mut stream = SniffedStream::new(connection, first_byte.clone());
            let error = stream.write_all(b"PRI * HTTP/2.0").await.expect_err("is closing");
            assert_eq!(error.kind(), io::ErrorKind::ConnectionReset);
            assert_eq!(first_byte.is_tls(), expected, "{bytes:?}");
        }
    }

    #[tokio::test]
    async fn only_the_first_byte_of_the_latest_connection_counts() {
        let first_byte = FirstByte::default();
        for (bytes, expected) in [(&b"\x16\0\0"[..], Some(true)), (b"H\x15\x15", Some(false))] {
            first_byte.clear();
            assert_eq!(first_byte.is_tls(), None);
            let (near, mut far) = tokio::io::duplex(16);
            let mut stream = SniffedStream::new(Connection::new(near), first_byte.clone());
            far.write_all(bytes).await.expect("there is room");
            drop(far);
            let mut read = Vec::new();
            stream.read_to_end(&mut read).await.expect("reads");
            assert_eq!(read, bytes, "no byte is lost");
            assert_eq!(first_byte.is_tls(), expected, "{bytes:?}");
        }
    }
}
