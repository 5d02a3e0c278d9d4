//! When a process is asked to end.

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

/// Makes a write beyond the limit of file sizes (`ulimit -f`) an error like that of a full disk. Without this the system
/// ends the process.
pub(crate) fn survive_a_limit_of_file_sizes() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    // Where it cannot be done, the system's own rule holds.
    if let Ok(runtime) = runtime {
        let _within = runtime.enter();
        drop(signal(SignalKind::from_raw(rustix::process::Signal::XFSZ.as_raw())));
    }
}

/// Waits until standard input closes. A thread of its own reads it: that may take for ever, and a runtime does not end
/// before its own blocked reads do.
async fn standard_input_closed(is_watched: bool) {
    if !is_watched {
        std::future::pending::<()>().await;
    }
    let (closed, is_closed) = tokio::sync::oneshot::channel();
    std::thread::spawn(move || {
        drop(std::io::copy(&mut std::io::stdin().lock(), &mut std::io::sink()));
        closed.send(()).ok();
    });
    drop(is_closed.await);
}
