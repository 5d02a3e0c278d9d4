//! A served site over real connections.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use tandem_net::Token;
use tandem_telemetry::{ArmsView, RunView, WorkerState, WorkerView};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;

use super::*;
use crate::bridge::BridgeTerms;
use crate::site::{ConfirmedStop, StopAction};

/// Within this everything that is to happen has happened, on the slowest machine.
const DEADLINE: Duration = Duration::from_secs(60);

struct Served {
    address: SocketAddr,
    views: watch::Sender<RunView>,
    shutdown: CancellationToken,
}

impl Served {
    async fn start(access: Access) -> Self {
        Self::start_within(Capacity::of_dashboard(None), access).await
    }

    async fn start_within(capacity: Capacity, access: Access) -> Self {
        let (views, receiver) = watch::channel(RunView::default());
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("bound");
        let shutdown = CancellationToken::new();
        let served = serve(Site::of_run(receiver), access, listener, capacity, shutdown.clone());
        drop(tokio::spawn(served));
        Self { address, views, shutdown }
    }

    /// Opens a connection and sends a request, with further lines of its head.
    async fn send(&self, request: &str, lines: &str) -> TcpStream {
        let mut stream = TcpStream::connect(self.address).await.expect("it listens");
        let head = format!("{request} HTTP/1.1\r\nhost: {}\r\n{lines}\r\n", self.address);
        stream.write_all(head.as_bytes()).await.expect("sent");
        stream
    }

    /// Returns the whole response.
    async fn ask(&self, request: &str, lines: &str) -> String {
        let mut stream = self.send(request, &format!("connection: close\r\n{lines}")).await;
        let mut response = String::new();
        let read = stream.read_to_string(&mut response);
        tokio::time::timeout(DEADLINE, read).await.expect("in time").expect("UTF-8");
        response
    }
}

/// Reads from a stream of events until `text` has arrived.
async fn until(stream: &mut TcpStream, text: &str) -> String {
    let mut received = Vec::new();
    let reading = async {
        while !String::from_utf8_lossy(&received).contains(text) {
            let n = stream.read_buf(&mut received).await.expect("open");
            assert!(n > 0, "closed before {text:?}");
        }
    };
    tokio::time::timeout(DEADLINE, reading).await.expect("in time");
    String::from_utf8_lossy(&received).into_owned()
}

fn has_status(response: &str, code: u16) {
    assert!(response.starts_with(&format!("HTTP/1.1 {code} ")), "{response}");
}

#[tokio::test]
async fn the_page_refers_to_its_own_files_only_and_all_of_them_exist() {
    let served = Served::start(Access::local()).await;
    let page = served.ask("GET /", "").await;
    has_status(&page, 200);
    assert!(page.contains("content-security-policy: default-src 'none'; script-src 'self'"));
    let (_, html) = page.split_once("\r\n\r\n").expect("a body");
    assert!(!html.contains("<style") && !html.contains(" style=") && !html.contains("onclick"));
    let mut pending: Vec<String> = references(html).collect();
    let mut seen = Vec::new();
    while let Some(path) = pending.pop().filter(|_| seen.len() < 20) {
        let file = served.ask(&format!("GET {path}"), "").await;
        has_status(&file, 200);
        pending.extend(references(&file).filter(|it| !seen.contains(it)));
        seen.push(path);
    }
    assert!(seen.iter().any(|path| path == "/assets/chart.js"), "{seen:?}");
    has_status(&served.ask("GET /assets/none.js", "").await, 404);
    for missing in ["none", "none/0", "log/0"] {
        has_status(&served.ask(&format!("GET /data/{missing}"), "").await, 404);
    }
    has_status(&served.ask("GET /data/evaluations/0", "").await, 200);
    has_status(&served.ask("GET /data/evaluations/-1", "").await, 400);
}

/// Returns the files that a text refers to.
fn references(text: &str) -> impl Iterator<Item = String> {
    assert!(!text.replace("http://www.w3.org/", "").contains("http://"), "another server");
    assert!(!text.contains("https://"), "another server");
    text.split('"').filter(|part| part.starts_with("/assets/")).map(str::to_owned)
}

#[tokio::test]
async fn viewers_receive_the_state_and_every_change() {
    let served = Served::start(Access::local()).await;
    let mut viewer = served.send("GET /events", "").await;
    let head = until(&mut viewer, "\"workers\":[]").await;
    assert!(head.contains("content-type: text/event-stream"), "{head}");
    let worker = WorkerView {
        id: 1,
        name: "worker-1".to_owned(),
        state: WorkerState::Playing,
        slot: Some(3),
        n_episodes: 0,
        last_seen_s: 0.1,
    };
    served.views.send_modify(|view| {
        "collecting".clone_into(&mut view.phase);
        view.workers.push(worker);
    });
    until(&mut viewer, "\"state\":\"playing\",\"slot\":3").await;
    served.views.send_modify(|view| view.workers[0].state = WorkerState::Disconnected);
    until(&mut viewer, "\"state\":\"disconnected\"").await;
    assert!(served.ask("GET /data/log", "").await.contains("worker-1 disconnected"));
    served.shutdown.cancel();
    let mut rest = Vec::new();
    let closed = tokio::time::timeout(DEADLINE, viewer.read_to_end(&mut rest)).await;
    drop(closed.expect("the stream ends with the service"));
}

#[tokio::test]
async fn a_stream_names_its_page_first() {
    let served = Served::start(Access::local()).await;
    let head = until(&mut served.send("GET /events", "").await, "data: {").await;
    let (before, _) = head.split_once("data: {").expect("a state");
    let id = before.split("event: page\ndata: ").nth(1).and_then(|it| it.lines().next());
    let id = id.expect("a page comes before the first state");
    let html = served.ask("GET /", "").await;
    assert!(html.contains(&format!("data-page=\"{id}\"")), "{id}: {html}");
    let pages = [crate::page::run(), crate::page::sweep(), crate::page::bridge()];
    let ids: BTreeSet<String> = pages.into_iter().map(|page| page.id).collect();
    assert!(ids.len() == 3 && ids.contains(id), "{ids:?}");
}

#[tokio::test]
async fn an_old_connection_ends_with_a_whole_response() {
    let served = Served::start(Access::local()).await;
    let mut viewer = served.send("GET /events", "").await;
    let head = until(&mut viewer, "data: {").await;
    assert!(head.contains("retry: 200\n"), "{head}");
    // From here on, the clock advances by itself while everything waits.
    tokio::time::pause();
    let mut rest = String::new();
    viewer.read_to_string(&mut rest).await.expect("UTF-8");
    assert!(rest.contains("event: alive"), "{rest}");
    assert!(rest.ends_with("\r\n0\r\n\r\n"), "{rest}");
}

#[tokio::test]
async fn a_further_viewer_gets_a_sentence_and_the_others_are_served() {
    let served = Served::start(Access::local()).await;
    let mut viewers = Vec::new();
    for _ in 0..MAX_VIEWERS {
        let mut viewer = served.send("GET /events", "").await;
        until(&mut viewer, "data: ").await;
        viewers.push(viewer);
    }
    let refused = served.ask("GET /events", "").await;
    has_status(&refused, 503);
    assert!(refused.contains("too many viewers"), "{refused}");
    // Most viewers stop reading; the one that reads is as fast as before, and the page is served.
    let mut reader = viewers.pop().expect("viewers");
    for round in 1..200 {
        served.views.send_modify(|view| view.round = round);
    }
    until(&mut reader, "\"round\":199,").await;
    has_status(&served.ask("GET /state", "").await, 200);
    drop(reader);
    let freed = async {
        while served.ask("HEAD /events", "").await.starts_with("HTTP/1.1 503") {
            served.views.send_modify(|view| view.round += 1);
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(DEADLINE, freed).await.expect("a place is free");
}

#[tokio::test]
async fn with_few_connections_there_are_few_viewers() {
    let served = Served::start_within(Capacity::of_dashboard(Some(64)), Access::local()).await;
    let mut viewers = Vec::new();
    for _ in 0..2 {
        let mut viewer = served.send("GET /events", "").await;
        until(&mut viewer, "data: ").await;
        viewers.push(viewer);
    }
    has_status(&served.ask("GET /events", "").await, 503);
    has_status(&served.ask("GET /state", "").await, 200);
}

#[tokio::test]
async fn a_token_is_exchanged_for_a_cookie() {
    let token = Token::new("0123456789abcdef").expect("a token");
    let served = Served::start(Access::with_token(token)).await;
    let form = served.ask("GET /", "").await;
    has_status(&form, 401);
    assert!(form.contains("Access token"), "{form}");
    has_status(&served.ask("GET /assets/login.js", "").await, 200);
    for path in ["/state", "/events", "/data/log"] {
        has_status(&served.ask(&format!("GET {path}"), "").await, 401);
    }
    let wrong = "authorization: Bearer 0123456789abcdeF\r\nx-tandem-action: login\r\n";
    has_status(&served.ask("POST /login", wrong).await, 401);
    let bearer = "authorization: Bearer 0123456789abcdef\r\n";
    has_status(&served.ask("POST /login", bearer).await, 403);
    let right = format!("{bearer}x-tandem-action: login\r\n");
    let accepted = served.ask("POST /login", &right).await;
    has_status(&accepted, 204);
    let cookie = accepted.split("set-cookie: ").nth(1).and_then(|it| it.split(';').next());
    let cookie = format!("cookie: {}\r\n", cookie.expect("a cookie"));
    has_status(&served.ask("GET /state", &cookie).await, 200);
    has_status(&served.ask("GET /state", bearer).await, 200);
}

#[tokio::test]
async fn a_page_of_another_name_reads_nothing() {
    let served = Served::start(Access::local()).await;
    let mut stream = TcpStream::connect(served.address).await.expect("it listens");
    let request = b"GET /state HTTP/1.1\r\nhost: evil.example\r\nconnection: close\r\n\r\n";
    stream.write_all(request).await.expect("sent");
    let mut response = String::new();
    stream.read_to_string(&mut response).await.expect("answered");
    has_status(&response, 421);
    assert!(!response.contains("env_steps"), "{response}");
}

#[tokio::test]
async fn only_the_page_itself_and_programs_can_stop_the_arms_of_a_bridge() {
    let (views, receiver) = watch::channel(Arc::new(ArmsView::default()));
    let pressed = Arc::new(AtomicU32::new(0));
    let counter = Arc::clone(&pressed);
    let stop: StopAction = Arc::new(move || {
        let stopped = match counter.fetch_add(1, Ordering::Relaxed) {
            0 => Ok(ConfirmedStop { stopped: "at 1.000 s".to_owned(), time_s: 1.0 }),
            _ => Err("the drives are gone".to_owned()),
        };
        Box::pin(async move { stopped })
    });
    let site = Site::of_bridge(BridgeTerms::default(), receiver, stop);
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("bound");
    let shutdown = CancellationToken::new();
    drop(tokio::spawn(serve(
        site,
        Access::local(),
        listener,
        Capacity::of_dashboard(None),
        shutdown.clone(),
    )));
    let served = Served { address, views: watch::channel(RunView::default()).0, shutdown };
    let action = "x-tandem-action: stop\r\ncontent-length: 0\r\n";
    for refused in ["content-length: 0\r\n", &format!("{action}origin: http://evil.example\r\n")] {
        has_status(&served.ask("POST /stop", refused).await, 403);
    }
    has_status(&served.ask("GET /stop", "").await, 405);
    assert_eq!(pressed.load(Ordering::Relaxed), 0);
    let stopped = served.ask("POST /stop", &format!("{action}origin: http://{address}\r\n")).await;
    has_status(&stopped, 200);
    assert!(stopped.contains(r#"{"stopped":"at 1.000 s","time_s":1.0}"#), "{stopped}");
    let failed = served.ask("POST /stop", action).await;
    has_status(&failed, 503);
    assert!(failed.contains("the drives are gone"), "{failed}");
    let page = served.ask("GET /", "").await;
    assert!(page.contains("Stop both arms") && page.contains("bridge.js"), "{page}");
    drop(views);
}

#[tokio::test]
async fn the_page_of_a_run_has_no_stop_button() {
    let served = Served::start(Access::local()).await;
    let action = "x-tandem-action: stop\r\ncontent-length: 0\r\n";
    has_status(&served.ask("POST /stop", action).await, 404);
}
