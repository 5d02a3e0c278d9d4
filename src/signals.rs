//! When a process is asked to end.

use tokio::io::AsyncReadExt as _;
use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

/// A token that is cancelled by SIGINT or SIGTERM, and when standard input closes if `exit_with_stdin`.
pub(crate) fn shutdown_token(exit_with_stdin: bool) -> std::io::Result<CancellationToken> {
    let token = CancellationToken::new();
    let (mut interrupt, mut terminate) =
        (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    let cancel = token.clone();
    tokio::spawn(async move {
        tokio::select! {
            _ = interrupt.recv() => (),
            _ = terminate.recv() => (),
            () = standard_input_closed(exit_with_stdin) => (),
        }
        cancel.cancel();
    });
    Ok(token)
}

async fn standard_input_closed(is_watched: bool) {
    if !is_watched {
        std::future::pending::<()>().await;
    }
    let mut input = tokio::io::stdin();
    let mut byte = [0];
    while !matches!(input.read(&mut byte).await, Ok(0) | Err(_)) {}
}
