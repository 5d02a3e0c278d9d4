//! A raw HTTP/2 client that sends arbitrary bytes as a request.

use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

use h2::client::SendRequest;
use h2::{RecvStream, SendStream};
use http::{HeaderMap, Request};
use prost::Message as _;
use prost::bytes::Bytes;
use prost_types::FileDescriptorSet;
use tonic::Code;

/// A method of a service.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Rpc {
    /// For example `tandem.v1.Teacher`.
    pub(crate) service: String,
    /// For example `/tandem.v1.Teacher/Advise`.
    pub(crate) path: String,
}

/// The outcome of a call.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Answer {
    /// A status code and message without a response message.
    Status(Code, String),
    /// The first response message.
    Message(Vec<u8>),
    /// The call or its connection was closed.
    Closed,
}

/// Returns every method of every service, from the descriptors.
pub(crate) fn rpcs() -> Vec<Rpc> {
    let files = FileDescriptorSet::decode(tandem_proto::FILE_DESCRIPTOR_SET).expect("descriptors");
    let mut calls = Vec::new();
    for file in &files.file {
        for service in &file.service {
            let name = format!("{}.{}", file.package(), service.name());
            let paths = service.method.iter().map(|method| format!("/{name}/{}", method.name()));
            calls.extend(paths.map(|path| Rpc { service: name.clone(), path }));
        }
    }
    calls
}

/// Returns a message with its gRPC frame header.
pub(crate) fn frame(flag: u8, message: &[u8]) -> Vec<u8> {
    let length = u32::try_from(message.len()).expect("a small message");
    [&[flag][..], &length.to_be_bytes(), message].concat()
}

async fn connect(address: SocketAddr) -> Option<SendRequest<Bytes>> {
    let socket = tokio::net::TcpStream::connect(address).await.ok()?;
    let (client, connection) = h2::client::handshake(socket).await.ok()?;
    // The connection ends with the client. Its errors surface in the call.
    drop(tokio::spawn(async move { connection.await.is_ok() }));
    client.ready().await.ok()
}

fn open(
    client: &mut SendRequest<Bytes>,
    address: SocketAddr,
    path: &str,
) -> Option<(h2::client::ResponseFuture, SendStream<Bytes>)> {
    let request = Request::post(format!("http://{address}{path}"))
        .header("content-type", "application/grpc")
        .header("te", "trailers")
        .body(())
        .expect("a request");
    client.send_request(request, false).ok()
}

/// Calls `path` with `body` as the complete request stream.
pub(crate) async fn call(address: SocketAddr, path: &str, body: &[u8]) -> Answer {
    let Some(mut client) = connect(address).await else { return Answer::Closed };
    let Some((response, mut body_stream)) = open(&mut client, address, path) else {
        return Answer::Closed;
    };
    // A service may refuse before it has read everything, so a failure to send is not a failure of the call.
    drop(body_stream.send_data(Bytes::copy_from_slice(body), true));
    match response.await {
        Err(_) => Answer::Closed,
        Ok(response) => match status_of(response.headers()) {
            Some(status) => status,
            None => first_message(response.into_body()).await,
        },
    }
}

/// Returns the gRPC status in headers or trailers.
fn status_of(headers: &HeaderMap) -> Option<Answer> {
    let code = headers.get("grpc-status")?.to_str().ok()?.parse().ok()?;
    let message =
        headers.get("grpc-message").map(|message| String::from_utf8_lossy(message.as_bytes()));
    Some(Answer::Status(Code::from_i32(code), message.unwrap_or_default().into_owned()))
}

async fn first_message(mut body: RecvStream) -> Answer {
    let mut bytes = Vec::new();
    loop {
        if let Some(length) = bytes.first_chunk::<5>().map(|head| &head[1..]) {
            let length = u32::from_be_bytes([length[0], length[1], length[2], length[3]]);
            let end = 5 + usize::try_from(length).expect("fits");
            if bytes.len() >= end {
                return Answer::Message(bytes[5..end].to_vec());
            }
        }
        match body.data().await {
            Some(Ok(more)) => {
                drop(body.flow_control().release_capacity(more.len()));
                bytes.extend_from_slice(&more);
            }
            Some(Err(_)) => return Answer::Closed,
            None => break,
        }
    }
    let trailers = body.trailers().await.ok().flatten();
    trailers.and_then(|trailers| status_of(&trailers)).unwrap_or(Answer::Closed)
}

/// Sends messages as fast as the service accepts them, until it refuses or 2 MiB are sent, then disconnects without
/// ending the stream.
pub(crate) async fn send_endlessly(address: SocketAddr, path: &str) {
    let Some(mut client) = connect(address).await else { return };
    let Some((_response, mut body)) = open(&mut client, address, path) else { return };
    let chunk = Bytes::from(frame(0, &[]).repeat(3000));
    for _ in 0..140 {
        body.reserve_capacity(chunk.len());
        let mut granted =
            std::pin::pin!(std::future::poll_fn(|context| body.poll_capacity(context)));
        // A service that stops reading blocks the client, which counts as a refusal.
        let granted = tokio::time::timeout(Duration::from_millis(200), &mut granted).await;
        if !matches!(granted, Ok(Some(Ok(_)))) || body.send_data(chunk.clone(), false).is_err() {
            return;
        }
    }
}

/// Opens `n_calls` calls on one connection and resets each immediately.
pub(crate) async fn reset_storm(address: SocketAddr, path: &str, n_calls: usize) {
    let Some(mut client) = connect(address).await else { return };
    for _ in 0..n_calls {
        let Ok(ready) = client.ready().await else { return };
        client = ready;
        let Some((_response, mut body)) = open(&mut client, address, path) else { return };
        body.send_reset(h2::Reason::CANCEL);
        tokio::task::yield_now().await;
    }
}

/// Returns byte sequences that are not HTTP/2, or only start like it.
pub(crate) fn not_http2() -> Vec<Vec<u8>> {
    let preface = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".to_vec();
    let settings = [0, 0, 0, 4, 0, 0, 0, 0, 0];
    let begun = [preface.as_slice(), &settings].concat();
    let with = |frame: &[u8]| [begun.as_slice(), frame].concat();
    vec![
        b"GET / HTTP/1.1\r\nHost: tandem\r\n\r\n".to_vec(),
        b"POST /tandem.v1.Teacher/Advise HTTP/1.1\r\nContent-Length: 99999999999\r\n\r\n".to_vec(),
        vec![0x16, 3, 1, 2, 0, 1, 0, 1, 0xfc, 3, 3, 7, 7, 7, 7, 7, 7, 7, 7, 7, 7, 7, 7, 7, 7, 7],
        vec![0xff; 4096],
        vec![0; 4096],
        [preface.as_slice(), &[0xff; 64]].concat(),
        // A frame of 16 MB, undecodable headers, data for a stream that was never opened.
        with(&[0xff, 0xff, 0xff, 0, 0, 0, 0, 0, 1]),
        with(&[0, 0, 4, 1, 5, 0, 0, 0, 1, 0xff, 0xff, 0xff, 0xff]),
        with(&[0, 0, 1, 0, 1, 0, 0, 0, 5, 9]),
        // A zero window update, settings out of range.
        with(&[0, 0, 4, 8, 0, 0, 0, 0, 0, 0, 0, 0, 0]),
        with(&[0, 0, 6, 4, 0, 0, 0, 0, 0, 0, 4, 0xff, 0xff, 0xff, 0xff]),
    ]
}

/// Sends `bytes` and returns true if the peer closes the connection.
pub(crate) fn is_closed_after(address: SocketAddr, bytes: &[u8]) -> bool {
    let mut stream = TcpStream::connect(address).expect("connects");
    stream.set_read_timeout(Some(super::DEADLINE)).expect("a time");
    // The peer may close the connection during the write.
    drop(stream.write_all(bytes));
    let mut answer = [0; 1024];
    loop {
        match stream.read(&mut answer) {
            Ok(0) => return true,
            Ok(_) => {}
            Err(error) => return error.kind() == std::io::ErrorKind::ConnectionReset,
        }
    }
}
