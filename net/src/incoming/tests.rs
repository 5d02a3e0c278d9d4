use std::sync::atomic::{AtomicUsize, Ordering};

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, DuplexStream};
use tokio::sync::mpsc;
use tokio_stream::StreamExt as _;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::server::Connected as _;

use super::*;
use crate::admission::FIRST_REQUEST;

/// Returns both ends of a connection: the service's and the client's.
async fn connected() -> (Connection, DuplexStream) {
    let (near, far) = tokio::io::duplex(64);
    let mut incoming = Incoming::new(tokio_stream::once(Ok(Connection::new(near))));
    (incoming.next().await.unwrap().unwrap(), far)
}

#[tokio::test(start_paused = true)]
async fn a_client_that_sends_nothing_is_disconnected() {
    let (mut connection, _silent) = connected().await;
    let started = Instant::now();
    let refused = connection.read_u8().await.unwrap_err();
    assert_eq!(refused.kind(), io::ErrorKind::TimedOut);
    assert_eq!(started.elapsed(), FIRST_REQUEST);
}

#[tokio::test(start_paused = true)]
async fn a_client_that_sends_a_byte_per_second_but_no_request_is_disconnected() {
    let (mut connection, mut client) = connected().await;
    let dripping = tokio::spawn(async move {
        while client.write_u8(b'P').await.is_ok() {
            tokio::time::sleep(Duration::from_secs(1)).await;
        }
    });
    let mut n_read = 0;
    let refused = loop {
        match connection.read_u8().await {
            Ok(_) => n_read += 1,
            Err(error) => break error,
        }
    };
    assert_eq!(refused.kind(), io::ErrorKind::TimedOut);
    assert!((9..=11).contains(&n_read), "{n_read} bytes");
    drop(connection);
    dripping.await.unwrap();
}

#[tokio::test(start_paused = true)]
async fn a_client_that_reads_nothing_and_sends_no_request_is_disconnected() {
    let (mut connection, _client) = connected().await;
    let refused = connection.write_all(&[0; 65]).await.unwrap_err();
    assert_eq!(refused.kind(), io::ErrorKind::TimedOut);
}

#[tokio::test(start_paused = true)]
async fn a_client_that_has_made_a_request_may_stay_idle() {
    let (mut connection, mut client) = connected().await;
    let caller = connection.connect_info();
    let later = async {
        tokio::time::sleep(FIRST_REQUEST / 2).await;
        caller.mark_requested();
        tokio::time::sleep(100 * FIRST_REQUEST).await;
        client.write_u8(2).await.unwrap();
    };
    assert_eq!(tokio::join!(connection.read_u8(), later).0.unwrap(), 2);
}

/// Returns a listener whose every accept fails with `kind`, and the number of accepts.
fn failing(kind: io::ErrorKind) -> (Incoming, Arc<AtomicUsize>) {
    let n_asked = Arc::new(AtomicUsize::new(0));
    let count = Arc::clone(&n_asked);
    let failing = tokio_stream::iter(std::iter::repeat_with(move || {
        count.fetch_add(1, Ordering::SeqCst);
        Err(kind.into())
    }));
    (Incoming::new(failing), n_asked)
}

#[tokio::test(start_paused = true)]
async fn failed_accepts_are_repeated_with_growing_pauses() {
    let (mut incoming, n_asked) = failing(io::ErrorKind::Other);
    let minute = tokio::time::timeout(Duration::from_secs(60), incoming.next()).await;
    minute.unwrap_err();
    // 5 ms doubled 8 times is more than a second.
    let n_asked = n_asked.load(Ordering::SeqCst);
    assert!((60..70).contains(&n_asked), "asked {n_asked} times in a minute");
}

#[tokio::test(start_paused = true)]
async fn connections_are_accepted_again_after_failures() {
    let (sender, accepted) = mpsc::channel(16);
    let mut incoming = Incoming::new(ReceiverStream::new(accepted));
    for _ in 0..3 {
        sender.send(Err(io::ErrorKind::Other.into())).await.unwrap();
    }
    sender.send(Err(io::ErrorKind::ConnectionAborted.into())).await.unwrap();
    let (stream, _client) = tokio::io::duplex(16);
    sender.send(Ok(Connection::new(stream))).await.unwrap();
    let started = Instant::now();
    assert!(incoming.next().await.unwrap().is_ok());
    assert_eq!(started.elapsed(), Duration::from_millis(5 + 10 + 20));
    assert_eq!(incoming.next_pause, FIRST_PAUSE);
}

#[tokio::test(start_paused = true)]
async fn no_connection_is_accepted_before_the_evicted_one_has_closed() {
    let (sender, accepted) = mpsc::channel(16);
    let incoming = Incoming::new(ReceiverStream::new(accepted));
    let mut incoming = incoming.with_capacity(Capacity::of(2));
    let mut clients = Vec::new();
    for _ in 0..4 {
        let (stream, client) = tokio::io::duplex(16);
        clients.push(client);
        sender.send(Ok(Connection::new(stream))).await.unwrap();
    }
    let mut first = incoming.next().await.unwrap().unwrap();
    let _second = incoming.next().await.unwrap().unwrap();
    let _third = incoming.next().await.unwrap().unwrap();
    let soon = Duration::from_secs(1);
    tokio::time::timeout(soon, incoming.next()).await.unwrap_err();
    let evicted = first.read_u8().await.unwrap_err();
    assert_eq!(evicted.kind(), io::ErrorKind::ConnectionAborted);
    drop(first);
    let fourth = tokio::time::timeout(soon, incoming.next()).await.unwrap();
    assert!(fourth.unwrap().is_ok());
}
