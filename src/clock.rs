//! The program's only clock.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use tandem_bridge::service::Clock;

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

/// Milliseconds since 1970: another number at every start.
#[expect(clippy::disallowed_methods, reason = "the clock")]
pub(crate) fn unix_millis() -> u64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or_default()
}

/// The clock by which arms are moved. It begins with its making.
pub(crate) struct Ticking(Instant);

impl Ticking {
    pub(crate) fn new() -> Self {
        Self(now())
    }
}

impl Clock for Ticking {
    fn now_s(&self) -> f64 {
        self.0.elapsed().as_secs_f64()
    }

    fn sleep_until(&self, when_s: f64) {
        if let Ok(left) = Duration::try_from_secs_f64(when_s - self.now_s()) {
            std::thread::sleep(left);
        }
    }
}
