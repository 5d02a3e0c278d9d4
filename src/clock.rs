//! The program's only clock.

use std::sync::Arc;
use std::time::{Duration, Instant};

/// The time since this function was called, for those who take time as an argument.
pub(crate) fn since_now() -> Arc<dyn Fn() -> Duration + Send + Sync> {
    let start = now();
    Arc::new(move || start.elapsed())
}

/// Now, for measuring how long something takes.
#[expect(clippy::disallowed_methods, reason = "the clock")]
pub(crate) fn now() -> Instant {
    Instant::now()
}
