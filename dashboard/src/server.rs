//! Connections of viewers. None of them can hold the service up: their number, the size of their requests and their
//! duration are limited.

use std::pin::{Pin, pin};
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use http::Request;
use hyper::body::Incoming as RequestBody;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::TokioIo;
use tandem_net::{Capacity, Connection, Incoming, MarkRequestLayer};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio_stream::StreamExt as _;
use tokio_util::sync::CancellationToken;
use tonic::transport::server::Connected as _;
use tower::Service as _;

use crate::access::Access;
use crate::site::{Expiry, Site};

/// The largest number of pages that receive events at a time. A further one gets a sentence instead.
pub const MAX_VIEWERS: usize = 64;
/// The number of connections per such page: one for events, and a few for a moment.
const CONNECTIONS_PER_VIEWER: usize = 4;
/// The largest size of the head of a request, in bytes.
const MAX_HEAD_BYTES: usize = 16 << 10;
/// The age from which a connection ends with the response in progress. Browsers open another one by themselves.
const MAX_AGE: Duration = Duration::from_secs(600);
/// Time for that response, after which the connection is dropped: a viewer that stopped reading makes room.
const FAREWELL: Duration = Duration::from_secs(10);

/// Serves `site` to the connections of `incoming`, at most `capacity` at a time, until `shutdown` is cancelled.
pub async fn serve(
    site: Site,
    access: Access,
    incoming: impl Into<Incoming>,
    capacity: Capacity,
    shutdown: CancellationToken,
) {
    let incoming = incoming.into().with_capacity(capacity);
    let max_viewers = MAX_VIEWERS.min(capacity.total().div_ceil(CONNECTIONS_PER_VIEWER));
    let serving = accept(site.router(access, max_viewers).layer(MarkRequestLayer), incoming);
    tokio::select! {
        () = serving => (),
        () = shutdown.cancelled() => (),
    }
}

/// Boxed, so that it is compiled in this crate only.
fn accept(router: Router, mut incoming: Incoming) -> Pin<Box<dyn Future<Output = ()> + Send>> {
    Box::pin(async move {
        let mut connections = JoinSet::new();
        loop {
            tokio::select! {
                accepted = incoming.next() => match accepted {
                    Some(Ok(connection)) => {
                        drop(connections.spawn(serve_connection(router.clone(), connection)));
                    }
                    Some(Err(_refused)) => {}
                    None => break,
                },
                Some(_) = connections.join_next() => {}
            }
        }
    })
}

async fn serve_connection(router: Router, connection: Connection) {
    let info = connection.connect_info();
    let (is_old, expiry) = watch::channel(false);
    let service = service_fn(move |mut request: Request<RequestBody>| {
        request.extensions_mut().insert(info.clone());
        request.extensions_mut().insert(Expiry(expiry.clone()));
        let mut router = router.clone();
        router.call(request.map(Body::new))
    });
    let mut served = pin!(
        http1::Builder::new()
            .max_buf_size(MAX_HEAD_BYTES)
            .serve_connection(TokioIo::new(connection), service)
    );
    // Errors are the viewer's: it went away, stopped reading, or does not speak HTTP.
    if tokio::time::timeout(MAX_AGE, served.as_mut()).await.is_err() {
        is_old.send_replace(true);
        served.as_mut().graceful_shutdown();
        drop(tokio::time::timeout(FAREWELL, served).await);
    }
}

#[cfg(test)]
mod tests;
