//! A text served over plain HTTP, for programs that poll it.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use http::header::{ALLOW, CONTENT_TYPE};
use http::{HeaderValue, Method, Request, Response, StatusCode};
use http_body_util::Full;
use hyper::body::{Bytes, Incoming as Body};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::TokioIo;
use tokio::task::JoinSet;
use tokio_stream::StreamExt as _;
use tonic::transport::server::Connected as _;

use crate::admission::{Capacity, MOST_OF_TEXT};
use crate::connection::Connection;
use crate::incoming::Incoming;

/// The deadline of a connection, from the first byte of the request to the last byte of the response.
const DEADLINE: Duration = Duration::from_secs(10);
/// The maximum size of a request, in bytes.
const MAX_REQUEST_BYTES: usize = 16 << 10;

/// A text that is served at one path. Clients need no token.
#[derive(Clone)]
pub struct TextEndpoint {
    /// The path, such as `/metrics`.
    pub path: &'static str,
    /// The value of the `content-type` header.
    pub content_type: &'static str,
    /// Returns the text. Called for every request, on the runtime's own thread.
    pub write: Arc<dyn Fn() -> String + Send + Sync>,
}

impl TextEndpoint {
    /// Serves the text to all connections of `incoming`, until that stream ends.
    pub async fn serve(self, incoming: impl Into<Incoming>) {
        let mut incoming = incoming.into().with_capacity(Capacity::of(MOST_OF_TEXT));
        let mut connections = JoinSet::new();
        loop {
            tokio::select! {
                accepted = incoming.next() => match accepted {
                    Some(Ok(connection)) => {
                        drop(connections.spawn(serve_connection(self.clone(), connection)));
                    }
                    Some(Err(_refused)) => {}
                    None => break,
                },
                Some(_) = connections.join_next() => {}
            }
        }
        connections.join_all().await;
    }

    fn response<B>(&self, request: &Request<B>) -> Response<Full<Bytes>> {
        if request.uri().path() != self.path {
            let text = format!("not found: the only path is {}\n", self.path);
            return text_response(StatusCode::NOT_FOUND, text);
        }
        if !matches!(*request.method(), Method::GET | Method::HEAD) {
            let text = "only GET and HEAD are allowed\n".to_owned();
            let mut response = text_response(StatusCode::METHOD_NOT_ALLOWED, text);
            response.headers_mut().insert(ALLOW, HeaderValue::from_static("GET, HEAD"));
            return response;
        }
        let mut response = text_response(StatusCode::OK, (self.write)());
        let content_type = HeaderValue::from_static(self.content_type);
        response.headers_mut().insert(CONTENT_TYPE, content_type);
        response
    }
}

/// Answers one request and closes the connection.
async fn serve_connection(endpoint: TextEndpoint, connection: Connection) {
    let info = connection.connect_info();
    let service = service_fn(|request: Request<Body>| {
        info.mark_requested();
        let response = endpoint.response(&request);
        async move { Ok::<_, Infallible>(response) }
    });
    let served = http1::Builder::new()
        .keep_alive(false)
        .max_buf_size(MAX_REQUEST_BYTES)
        .serve_connection(TokioIo::new(connection), service);
    // Errors are the client's: it disconnected, was too slow, or does not speak HTTP.
    drop(tokio::time::timeout(DEADLINE, served).await);
}

fn text_response(status: StatusCode, text: String) -> Response<Full<Bytes>> {
    let mut response = Response::new(Full::new(Bytes::from(text)));
    *response.status_mut() = status;
    response
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    use tokio::net::{TcpListener, TcpStream};

    use super::*;

    /// Sends each request to an endpoint that counts its readers, and returns the responses.
    async fn responses_to(requests: &[&[u8]]) -> Vec<String> {
        let n_readers = std::sync::atomic::AtomicU64::new(0);
        let count = move || {
            let n = n_readers.fetch_add(1, std::sync::atomic::Ordering::SeqCst) + 1;
            format!("reader {n}\n")
        };
        let endpoint =
            TextEndpoint { path: "/count", content_type: "text/plain", write: Arc::new(count) };
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("bound");
        let serving = tokio::spawn(endpoint.serve(listener));
        let mut silent = Vec::new();
        for _ in 0..2 * MOST_OF_TEXT {
            silent.push(TcpStream::connect(address).await.expect("taken in"));
        }
        let mut responses = Vec::new();
        for request in requests {
            let mut client = TcpStream::connect(address).await.expect("taken in");
            client.write_all(request).await.expect("sent");
            let mut response = Vec::new();
            client.read_to_end(&mut response).await.expect("answered and closed");
            responses.push(String::from_utf8(response).expect("UTF-8"));
        }
        serving.abort();
        responses
    }

    #[tokio::test]
    async fn the_text_is_written_for_every_reader_while_others_send_nothing() {
        let asked = b"GET /count HTTP/1.1\r\nhost: any\r\n\r\n";
        let responses = responses_to(&[asked, asked, b"GET /count HTTP/1.0\r\n\r\n"]).await;
        for (idx, response) in responses.iter().enumerate() {
            assert!(response.contains(" 200 OK\r\n"), "{response}");
            assert!(response.contains("content-type: text/plain\r\n"), "{response}");
            assert!(response.ends_with(&format!("\r\n\r\nreader {}\n", idx + 1)), "{response}");
        }
    }

    #[tokio::test]
    async fn other_paths_and_methods_are_rejected() {
        let responses = responses_to(&[
            b"GET / HTTP/1.1\r\nhost: any\r\n\r\n",
            b"GET /count/ HTTP/1.1\r\nhost: any\r\n\r\n",
            b"POST /count HTTP/1.1\r\nhost: any\r\ncontent-length: 2\r\n\r\nhi",
            b"HEAD /count HTTP/1.1\r\nhost: any\r\n\r\n",
            b"\x16\x03\x01\x02\x00 not HTTP\r\n\r\n",
        ])
        .await;
        let begins = |idx: usize, with: &str| {
            assert!(responses[idx].starts_with(with), "{:?}", responses[idx]);
        };
        begins(0, "HTTP/1.1 404 ");
        begins(1, "HTTP/1.1 404 ");
        begins(2, "HTTP/1.1 405 ");
        assert!(responses[2].contains("allow: GET, HEAD\r\n"), "{}", responses[2]);
        begins(3, "HTTP/1.1 200 ");
        assert!(responses[3].ends_with("\r\n\r\n"), "{}", responses[3]);
        begins(4, "HTTP/1.1 400 ");
    }
}
