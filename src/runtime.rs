//! The tokio runtime of commands and services.

use anyhow::Context as _;
use tokio::runtime::{Builder, Runtime};

/// Creates a runtime with one thread for all sockets. Computations run on threads of their own.
pub(crate) fn new() -> anyhow::Result<Runtime> {
    Builder::new_current_thread().enable_all().build().context("cannot start the runtime")
}
