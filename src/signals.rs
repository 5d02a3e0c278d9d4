//! Signals, and the end of standard input.

use std::time::Duration;

use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

use crate::exit::{Exit, Failed, OrExit as _};
use crate::runtime;

/// Time after a first signal in which others have no effect.
const SETTLING_TIME: Duration = Duration::from_secs(1);

/// Returns a token that is cancelled by SIGINT or SIGTERM and, if `exit_with_stdin`, when standard input closes.
pub(crate) fn shutdown_token(exit_with_stdin: bool) -> Result<CancellationToken, Failed> {
    let watch =
        |kind| signal(kind).or_exit(Exit::TryAgain, || "cannot watch for signals".to_owned());
    let token = CancellationToken::new();
    let (mut interrupt, mut terminate) =
        (watch(SignalKind::interrupt())?, watch(SignalKind::terminate())?);
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

/// Waits for a second SIGINT or SIGTERM. One that follows the first at once does not count: a key can bounce, and programs
/// such as `timeout` signal a process and its group.
pub(crate) async fn second_shutdown() -> Result<(), Failed> {
    tokio::time::sleep(SETTLING_TIME).await;
    shutdown_token(false)?.cancelled().await;
    Ok(())
}

/// Runs `work` on a thread of its own. If a signal or, with `exit_with_stdin`, the end of standard input comes first, the
/// work is abandoned: the process is about to end.
pub(crate) fn unless_interrupted<T: Send + 'static>(
    exit_with_stdin: bool,
    work: impl FnOnce() -> Result<T, Failed> + Send + 'static,
) -> Result<T, Failed> {
    let runtime = runtime::new().or_exit(Exit::TryAgain, String::new)?;
    runtime.block_on(async {
        let interrupted = shutdown_token(exit_with_stdin)?;
        let (done, is_done) = tokio::sync::oneshot::channel();
        std::thread::spawn(move || drop(done.send(work())));
        tokio::select! {
            result = is_done => result.or_exit(Exit::Bug, || "the thread panicked".to_owned())?,
            () = interrupted.cancelled() => {
                Err(Failed::new(Exit::Interrupted, anyhow::anyhow!("interrupted")))
            }
        }
    })
}

/// Handles SIGXFSZ, so that a write beyond the file size limit (`ulimit -f`) is an error like that of a full disk and
/// does not end the process.
pub(crate) fn ignore_file_size_signal() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    // If this fails, the default action of the signal stays in force.
    if let Ok(runtime) = runtime {
        let _within = runtime.enter();
        drop(signal(SignalKind::from_raw(rustix::process::Signal::XFSZ.as_raw())));
    }
}

/// Waits until standard input closes. A separate thread reads it, because the bridge's runtime does not shut down
/// before its own blocking reads return.
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
