//! The tokio runtime of commands and services.

use std::pin::pin;

use anyhow::Context as _;
use tokio::runtime::Builder;

/// A runtime with one thread for all sockets. Computations run on threads of their own.
pub(crate) struct Runtime(tokio::runtime::Runtime);

/// Creates a runtime.
pub(crate) fn new() -> anyhow::Result<Runtime> {
    let runtime = Builder::new_current_thread().enable_all().build();
    runtime.map(Runtime).context("cannot start the runtime")
}

impl Runtime {
    /// Runs `future` and the tasks that it spawns on this thread until `future` ends.
    pub(crate) fn block_on<T>(&self, future: impl Future<Output = T>) -> T {
        let mut output = None;
        tandem_net::block_on(&self.0, pin!(async { output = Some(future.await) }));
        output.expect("the future has ended")
    }
}
