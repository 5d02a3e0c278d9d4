//! The loop of a runtime.

use std::pin::Pin;

use tokio::runtime::Runtime;

/// Runs `future` on `runtime` until it ends.
///
/// Tokio's function of this name is generic, so the loop that polls the tasks of a service is compiled in the crate
/// that calls it. This function has the loop compiled and optimized here.
pub fn block_on(runtime: &Runtime, future: Pin<&mut dyn Future<Output = ()>>) {
    runtime.block_on(future);
}
