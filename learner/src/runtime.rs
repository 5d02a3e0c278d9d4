//! Access to the async runtime from a thread.

use std::io;
use std::pin::Pin;
use std::sync::mpsc::sync_channel;
use std::thread;

use tandem_net::Pacing;
use tokio::runtime::{EnterGuard, Handle};
use tokio::sync::mpsc;

type Call = Pin<Box<dyn Future<Output = ()> + Send>>;

/// A handle with which a thread uses the runtime that started it.
#[derive(Debug, Clone)]
pub(crate) struct Runtime {
    handle: Handle,
    calls: mpsc::Sender<Call>,
}

impl Runtime {
    /// Runs `work` on the runtime and blocks until it completes; returns `None` if the runtime ends first. Must not be
    /// called on a thread of the runtime.
    pub(crate) fn wait_on<T: Send + 'static>(
        &self,
        work: impl Future<Output = T> + Send + 'static,
    ) -> Option<T> {
        let (sender, outcome) = sync_channel(1);
        let call = Box::pin(async move { drop(sender.send(work.await)) });
        self.calls.blocking_send(call).ok()?;
        outcome.recv().ok()
    }

    /// Spawns `work` on the runtime.
    pub(crate) fn spawn(&self, work: impl Future<Output = ()> + Send + 'static) {
        self.handle.spawn(work);
    }

    /// Enters the runtime, for constructors that require one.
    pub(crate) fn enter(&self) -> EnterGuard<'_> {
        self.handle.enter()
    }
}

/// Runs `work` on a thread called `name`, and serves its calls to the runtime one at a time until it is done.
///
/// # Errors
/// When no thread can be started. The inner result is an error if `work` panics.
pub(crate) async fn on_a_thread<T: Send + 'static>(
    name: &str,
    pacing: Pacing,
    work: impl FnOnce(Runtime) -> T + Send + 'static,
) -> io::Result<thread::Result<T>> {
    let (calls, mut called) = mpsc::channel(1);
    let runtime = Runtime { handle: Handle::current(), calls };
    let thread = thread::Builder::new().name(name.to_owned()).spawn(move || work(runtime))?;
    while let Some(call) = pacing.next(called.recv()).await {
        call.await;
    }
    // The thread has dropped its end of the channel, which is the last thing that it does.
    Ok(thread.join())
}
