//! The server loop of every service, with its graceful shutdown.

use std::pin::Pin;
use std::time::Duration;

use tokio_util::sync::CancellationToken;

use crate::gate::Router;
use crate::incoming::Incoming;

/// How long open calls may run on after the shutdown: a client that stops reading would keep its call open for ever.
pub const SHUTDOWN_GRACE: Duration = Duration::from_secs(5);

/// Serves `router` to the connections of `incoming` until `shutdown` is cancelled.
///
/// From then on no connection is accepted and no call is begun. Calls that are still open after [`SHUTDOWN_GRACE`] are
/// cut off.
///
/// # Errors
/// When the server fails.
pub async fn serve(
    router: Router,
    incoming: impl Into<Incoming>,
    shutdown: CancellationToken,
) -> Result<(), tonic::transport::Error> {
    let served = server(router, incoming.into(), shutdown.clone());
    let grace_is_over = async {
        shutdown.cancelled().await;
        tokio::time::sleep(SHUTDOWN_GRACE).await;
    };
    tokio::select! {
        served = served => served,
        () = grace_is_over => {
            tracing::warn!(grace_s = SHUTDOWN_GRACE.as_secs(), "open calls were cut off");
            Ok(())
        }
    }
}

type Served = Pin<Box<dyn Future<Output = Result<(), tonic::transport::Error>> + Send>>;

/// The HTTP/2 server behind a pointer, so that it is compiled in this crate and not again in each that serves.
fn server(router: Router, incoming: Incoming, shutdown: CancellationToken) -> Served {
    Box::pin(router.serve_with_incoming_shutdown(incoming, shutdown.cancelled_owned()))
}
