//! The runtime as the thread that learns sees it.

use std::io;
use std::pin::Pin;
use std::sync::mpsc::sync_channel;
use std::thread;

use tandem_net::Pacing;
use tokio::runtime::{EnterGuard, Handle};
use tokio::sync::mpsc;

type Call = Pin<Box<dyn Future<Output = ()> + Send>>;

/// Lets a thread of its own use the runtime that it was started from.
#[derive(Debug, Clone)]
pub(crate) struct Runtime {
    handle: Handle,
    calls: mpsc::Sender<Call>,
}

impl Runtime {
    /// Lets the runtime do `work` and waits for its outcome; `None` when the runtime ends first. Not to be called on one
    /// of the runtime's own threads.
    pub(crate) fn wait_on<T: Send + 'static>(
        &self,
        work: impl Future<Output = T> + Send + 'static,
    ) -> Option<T> {
        let (sender, outcome) = sync_channel(1);
        let call = Box::pin(async move { drop(sender.send(work.await)) });
        self.calls.blocking_send(call).ok()?;
        outcome.recv().ok()
    }

    /// Lets the runtime do `work`, and waits for nothing.
    pub(crate) fn spawn(&self, work: impl Future<Output = ()> + Send + 'static) {
        self.handle.spawn(work);
    }

    /// For what wants to know its runtime when it is made.
    pub(crate) fn enter(&self) -> EnterGuard<'_> {
        self.handle.enter()
    }
}

/// Does `work` on a thread called `name` and, until it is done, what it asks the runtime for, one call at a time.
///
/// # Errors
/// When no thread can be started. The inner result is an error when `work` panics.
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
    // The thread has dropped its end of the channel, which is the last that it does.
    Ok(thread.join())
}
