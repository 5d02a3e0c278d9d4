//! The tokio runtime of commands and services.

use std::pin::pin;

use anyhow::Context as _;
use tokio::runtime::Builder;

/// A runtime with one thread for all sockets. Computations run on threads of their own.
///
/// Dropping it drops its tasks. It waits for no blocking call, such as a name lookup that gets no answer: such calls
/// end with the process, so those with an effect must be awaited.
pub(crate) struct Runtime(Option<tokio::runtime::Runtime>);

/// Creates a runtime.
pub(crate) fn new() -> anyhow::Result<Runtime> {
    let runtime = Builder::new_current_thread().enable_all().build();
    runtime.map(|runtime| Runtime(Some(runtime))).context("cannot start the runtime")
}

impl Runtime {
    /// Runs `future` and the tasks that it spawns on this thread until `future` ends.
    pub(crate) fn block_on<T>(&self, future: impl Future<Output = T>) -> T {
        let runtime = self.0.as_ref().expect("only `drop` takes it");
        let mut output = None;
        tandem_net::block_on(runtime, pin!(async { output = Some(future.await) }));
        output.expect("the future has ended")
    }
}

impl Drop for Runtime {
    fn drop(&mut self) {
        if let Some(runtime) = self.0.take() {
            runtime.shutdown_background();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_blocking_call_does_not_delay_the_drop_and_tasks_end_with_it() {
        let runtime = new().expect("a runtime");
        let (release, released) = channel::<()>();
        let (started, has_started) = channel();
        let (of_task, task_ended) = channel::<()>();
        runtime.block_on(async {
            drop(tokio::task::spawn_blocking(move || {
                started.send(()).expect("the test waits");
                released.recv()
            }));
            drop(tokio::spawn(async move {
                std::future::pending::<()>().await;
                drop(of_task);
            }));
        });
        has_started.recv().expect("the call has started");
        let (dropped, is_dropped) = channel();
        std::thread::spawn(move || {
            drop(runtime);
            dropped.send(())
        });
        is_dropped.recv_timeout(Duration::from_secs(20)).expect("the drop does not wait");
        task_ended.recv().expect_err("the task is dropped");
        drop(release);
    }
}
