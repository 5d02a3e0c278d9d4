//! A page, its data, and the routes to both.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::{Path, State};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{Html, IntoResponse as _, Response};
use axum::routing::{get, post};
use axum::{Extension, Router};
use http::StatusCode;
use http::header::CONTENT_TYPE;
use serde::Serialize;
use tokio::sync::{Semaphore, watch};
use tokio_stream::StreamExt as _;
use tokio_stream::wrappers::WatchStream;

use crate::access::{self, Access};
use crate::document::{Document, encode};
use crate::page::{ASSETS, Page};

/// Time without a state after which an event `alive` is sent, so that both sides notice when the other one is gone.
const KEEP_ALIVE: Duration = Duration::from_secs(5);
/// Time after which browsers open a stream again that has ended.
const RETRY_AFTER: Duration = Duration::from_millis(200);

/// The stop that the arms are in, as pages receive it.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct ConfirmedStop {
    /// Description of the stop.
    pub stopped: String,
    /// Time since the start of the bridge, seconds. A later state without a stop is that of arms that were reset.
    pub time_s: f64,
}

/// The result of a stop: the stop that the arms are in, or the description of the problem.
pub type StopResult = Result<ConfirmedStop, String>;
/// Stops the arms.
pub type StopAction =
    Arc<dyn Fn() -> Pin<Box<dyn Future<Output = StopResult> + Send>> + Send + Sync>;

/// A page and the data that it shows.
#[derive(Clone)]
pub struct Site {
    pub(crate) page: Arc<Page>,
    /// The latest data.
    pub(crate) frames: watch::Receiver<Arc<Frame>>,
    /// The action of the page's stop button, if it has one.
    pub(crate) stop: Option<StopAction>,
}

/// The data of a page at one moment.
#[derive(Debug, Default)]
pub(crate) struct Frame {
    /// The state, JSON on one line. It is sent with every change, so it is short.
    pub(crate) state: Arc<str>,
    /// Larger documents. The state has the versions of each, and pages fetch those that have changed.
    pub(crate) documents: BTreeMap<&'static str, Document>,
}

/// Becomes true when the connection of a request has to end.
#[derive(Clone)]
pub(crate) struct Expiry(pub(crate) watch::Receiver<bool>);

/// The state of the routes.
#[derive(Clone)]
struct Served {
    site: Site,
    /// One permit per viewer.
    viewers: Arc<Semaphore>,
}

impl Site {
    /// Returns a site that shows `page`. `encode` turns each snapshot of `views` into a frame once, in a task of the
    /// runtime that calls it, until the sender is dropped.
    pub(crate) fn of_views<V: Clone + Send + Sync + 'static>(
        page: Page,
        mut views: watch::Receiver<V>,
        mut encode: impl FnMut(&V) -> Frame + Send + 'static,
    ) -> Self {
        let first = encode(&views.borrow_and_update().clone());
        let (frames, receiver) = watch::channel(Arc::new(first));
        tokio::spawn(async move {
            while views.changed().await.is_ok() {
                let view = views.borrow_and_update().clone();
                frames.send_replace(Arc::new(encode(&view)));
            }
        });
        Self { page: Arc::new(page), frames: receiver, stop: None }
    }

    /// Returns the routes, behind the rules of `access`, for at most `max_viewers` streams of events.
    pub(crate) fn router(self, access: Access, max_viewers: usize) -> Router {
        let viewers = Arc::new(Semaphore::new(max_viewers));
        Router::new()
            .route("/", get(page))
            .route("/state", get(state))
            .route("/events", get(events))
            .route("/data/{name}", get(document))
            .route("/data/{name}/{from}", get(rows))
            .route("/assets/{name}", get(asset))
            .route("/stop", post(stop))
            .route("/login", post(|| async { StatusCode::NO_CONTENT }))
            .with_state(Served { site: self, viewers })
            .layer(axum::middleware::from_fn_with_state(Arc::new(access), access::guard))
    }
}

async fn page(State(served): State<Served>) -> Html<String> {
    Html(served.site.page.html.clone())
}

async fn state(State(served): State<Served>) -> Response {
    let state = served.site.frames.borrow().state.clone();
    json(state.as_ref().to_owned())
}

async fn document(State(served): State<Served>, Path(name): Path<String>) -> Response {
    let document = served.site.frames.borrow().documents.get(name.as_str()).cloned();
    document.map_or_else(not_found, |document| json(document.text().to_owned()))
}

/// Sends the rows of a document from number `from` on.
async fn rows(State(served): State<Served>, Path((name, from)): Path<(String, usize)>) -> Response {
    let document = served.site.frames.borrow().documents.get(name.as_str()).cloned();
    document.and_then(|document| document.rows_from(from)).map_or_else(not_found, json)
}

async fn asset(Path(name): Path<String>) -> Response {
    let asset = ASSETS.iter().find(|(known, ..)| *known == name);
    asset.map_or_else(not_found, |(_, content_type, content)| {
        ([(CONTENT_TYPE, *content_type)], *content).into_response()
    })
}

/// Streams the states until the connection expires. A viewer that is slower than they change misses those in between.
async fn events(
    State(served): State<Served>,
    Extension(Expiry(expiry)): Extension<Expiry>,
) -> Response {
    let Ok(permit) = served.viewers.try_acquire_owned() else {
        let text = "too many viewers: close another page of this dashboard\n";
        return (StatusCode::SERVICE_UNAVAILABLE, text).into_response();
    };
    // First its page, for viewers that show another one.
    let page = Event::default().event("page").data(&served.site.page.id).retry(RETRY_AFTER);
    let states = WatchStream::new(served.site.frames).map(move |frame| {
        let _held = &permit;
        Event::default().data(&*frame.state)
    });
    let states =
        tokio_stream::once(page).chain(states).map(|event| Some(Ok::<_, Infallible>(event)));
    let end = WatchStream::new(expiry).filter(|is_old| *is_old).map(|_| None);
    // The stream ends with the first `None`.
    let states = states.chain(tokio_stream::once(None)).merge(end).map_while(|event| event);
    let alive = KeepAlive::new().interval(KEEP_ALIVE);
    let alive = alive.event(Event::default().event("alive").data("-"));
    Sse::new(states).keep_alive(alive).into_response()
}

/// Stops the arms of a bridge. `access` has checked that a page of another server did not ask for it.
async fn stop(State(served): State<Served>) -> Response {
    let Some(action) = &served.site.stop else { return not_found() };
    match action().await {
        Ok(stopped) => json(encode(&stopped).as_ref().to_owned()),
        Err(problem) => {
            let body = encode(&BTreeMap::from([("problem", problem)]));
            (StatusCode::SERVICE_UNAVAILABLE, json(body.as_ref().to_owned())).into_response()
        }
    }
}

fn json(text: String) -> Response {
    ([(CONTENT_TYPE, "application/json")], text).into_response()
}

fn not_found() -> Response {
    (StatusCode::NOT_FOUND, "not found\n").into_response()
}
