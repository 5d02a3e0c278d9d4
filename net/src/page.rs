//! A page of text over plain HTTP, for programs that look again and again.

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

use crate::admission::Capacity;
use crate::connection::Connection;
use crate::incoming::Incoming;

/// How long a caller may take to ask and to take the answer.
const PATIENCE: Duration = Duration::from_secs(10);
/// Callers that are answered at a time; the next one takes the place of one that has asked nothing for longest.
const MAX_CALLERS: usize = 16;
/// Bytes of a question that are read.
const MAX_QUESTION_BYTES: usize = 16 << 10;

/// What stands at one path. Nobody needs a token to read it.
#[derive(Clone)]
pub struct Page {
    /// Where it stands, such as `/metrics`.
    pub path: &'static str,
    /// What it is.
    pub content_type: &'static str,
    /// Writes it, anew for every caller; called on the runtime's own thread.
    pub write: Arc<dyn Fn() -> String + Send + Sync>,
}

impl Page {
    /// Answers those who come, until nobody can come any more.
    pub async fn serve(self, incoming: impl Into<Incoming>) {
        let mut incoming = incoming.into().with_capacity(Capacity::of(MAX_CALLERS));
        let mut callers = JoinSet::new();
        loop {
            tokio::select! {
                accepted = incoming.next() => match accepted {
                    Some(Ok(caller)) => drop(callers.spawn(answer(self.clone(), caller))),
                    Some(Err(_refused)) => {}
                    None => break,
                },
                Some(_) = callers.join_next() => {}
            }
        }
        callers.join_all().await;
    }

    fn answer<B>(&self, request: &Request<B>) -> Response<Full<Bytes>> {
        if request.uri().path() != self.path {
            return told(
                StatusCode::NOT_FOUND,
                format!("there is {} and nothing else\n", self.path),
            );
        }
        if !matches!(*request.method(), Method::GET | Method::HEAD) {
            let mut refused =
                told(StatusCode::METHOD_NOT_ALLOWED, "it can only be read\n".to_owned());
            refused.headers_mut().insert(ALLOW, HeaderValue::from_static("GET, HEAD"));
            return refused;
        }
        let mut page = told(StatusCode::OK, (self.write)());
        page.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(self.content_type));
        page
    }
}

/// Answers one question and closes the connection.
async fn answer(page: Page, connection: Connection) {
    let caller = connection.connect_info();
    let service = service_fn(|request: Request<Body>| {
        caller.requested();
        let answer = page.answer(&request);
        async move { Ok::<_, Infallible>(answer) }
    });
    let answered = http1::Builder::new()
        .keep_alive(false)
        .max_buf_size(MAX_QUESTION_BYTES)
        .serve_connection(TokioIo::new(connection), service);
    // Whoever goes away, is too slow or speaks otherwise gets nothing, and misses nothing that matters.
    drop(tokio::time::timeout(PATIENCE, answered).await);
}

fn told(status: StatusCode, text: String) -> Response<Full<Bytes>> {
    let mut response = Response::new(Full::new(Bytes::from(text)));
    *response.status_mut() = status;
    response
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    use tokio::net::{TcpListener, TcpStream};

    use super::*;

    /// What a page that counts its readers answers to bytes, one question after another.
    async fn answers(questions: &[&[u8]]) -> Vec<String> {
        let n_readers = std::sync::atomic::AtomicU64::new(0);
        let count = move || {
            let n = n_readers.fetch_add(1, std::sync::atomic::Ordering::SeqCst) + 1;
            format!("reader {n}\n")
        };
        let page = Page { path: "/count", content_type: "text/plain", write: Arc::new(count) };
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("bound");
        let serving = tokio::spawn(page.serve(listener));
        let mut silent = Vec::new();
        for _ in 0..2 * MAX_CALLERS {
            silent.push(TcpStream::connect(address).await.expect("taken in"));
        }
        let mut answers = Vec::new();
        for question in questions {
            let mut caller = TcpStream::connect(address).await.expect("taken in");
            caller.write_all(question).await.expect("sent");
            let mut answer = Vec::new();
            caller.read_to_end(&mut answer).await.expect("answered and closed");
            answers.push(String::from_utf8(answer).expect("UTF-8"));
        }
        serving.abort();
        answers
    }

    #[tokio::test]
    async fn a_page_is_written_anew_for_every_reader_while_others_say_nothing() {
        let asked = b"GET /count HTTP/1.1\r\nhost: any\r\n\r\n";
        let answers = answers(&[asked, asked, b"GET /count HTTP/1.0\r\n\r\n"]).await;
        for (idx, answer) in answers.iter().enumerate() {
            assert!(answer.contains(" 200 OK\r\n"), "{answer}");
            assert!(answer.contains("content-type: text/plain\r\n"), "{answer}");
            assert!(answer.ends_with(&format!("\r\n\r\nreader {}\n", idx + 1)), "{answer}");
        }
    }

    #[tokio::test]
    async fn nothing_else_is_there_and_nothing_can_be_sent() {
        let answers = answers(&[
            b"GET / HTTP/1.1\r\nhost: any\r\n\r\n",
            b"GET /count/ HTTP/1.1\r\nhost: any\r\n\r\n",
            b"POST /count HTTP/1.1\r\nhost: any\r\ncontent-length: 2\r\n\r\nhi",
            b"HEAD /count HTTP/1.1\r\nhost: any\r\n\r\n",
            b"\x16\x03\x01\x02\x00 what is this?\r\n\r\n",
        ])
        .await;
        let begins = |idx: usize, with: &str| {
            assert!(answers[idx].starts_with(with), "{:?}", answers[idx]);
        };
        begins(0, "HTTP/1.1 404 ");
        begins(1, "HTTP/1.1 404 ");
        begins(2, "HTTP/1.1 405 ");
        assert!(answers[2].contains("allow: GET, HEAD\r\n"), "{}", answers[2]);
        begins(3, "HTTP/1.1 200 ");
        assert!(answers[3].ends_with("\r\n\r\n"), "{}", answers[3]);
        begins(4, "HTTP/1.1 400 ");
    }
}
