//! The server loop of every service, with graceful shutdown.

use std::pin::Pin;
use std::time::Duration;

use tokio_util::sync::CancellationToken;

use crate::incoming::Incoming;
use crate::server::Router;

/// The time that open calls have to end after a shutdown. A client that stops reading would keep its call open forever.
pub const SHUTDOWN_GRACE: Duration = Duration::from_secs(5);

/// Serves `router` to the connections of `incoming` until `shutdown` is cancelled.
///
/// Then no further connection or call is accepted, and calls that are still open after [`SHUTDOWN_GRACE`] are
/// cancelled.
///
/// # Errors
/// When the server fails.
pub async fn serve(
    router: Router,
    incoming: impl Into<Incoming>,
    shutdown: CancellationToken,
) -> Result<(), tonic::transport::Error> {
    let served = server(router, incoming.into(), shutdown.clone());
    let grace_ends = async {
        shutdown.cancelled().await;
        tokio::time::sleep(SHUTDOWN_GRACE).await;
    };
    tokio::select! {
        served = served => served,
        () = grace_ends => {
            tracing::warn!(grace_s = SHUTDOWN_GRACE.as_secs(), "cancelled open calls");
            Ok(())
        }
    }
}

type Served = Pin<Box<dyn Future<Output = Result<(), tonic::transport::Error>> + Send>>;

/// Boxes the HTTP/2 server, so that it is compiled in this crate only and not in every crate that serves.
fn server(router: Router, incoming: Incoming, shutdown: CancellationToken) -> Served {
    Box::pin(router.serve_with_incoming_shutdown(incoming, shutdown.cancelled_owned()))
}
