//! The only clock of the program.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use tandem_bridge::service::Clock;

/// Returns a clock that counts from this call, for libraries that take the time as an argument.
pub(crate) fn since_now() -> Arc<dyn Fn() -> Duration + Send + Sync> {
    let start = now();
    Arc::new(move || start.elapsed())
}

/// Returns the current instant, for measuring time spans.
#[expect(clippy::disallowed_methods, reason = "the clock")]
pub(crate) fn now() -> Instant {
    Instant::now()
}

/// Returns the milliseconds since 1970, a different number at every start.
#[expect(clippy::disallowed_methods, reason = "the clock")]
pub(crate) fn unix_millis() -> u64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or_default()
}

/// Returns the nanoseconds since 1970, for the times of spans.
#[cfg(feature = "otlp")]
#[expect(clippy::disallowed_methods, reason = "the clock")]
pub(crate) fn unix_nanos() -> u64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_nanos()).unwrap_or_default()
}

/// The clock of a bridge. It counts from its creation.
pub(crate) struct BridgeClock(Instant);

impl BridgeClock {
    pub(crate) fn new() -> Self {
        Self(now())
    }
}

impl Clock for BridgeClock {
    fn now_s(&self) -> f64 {
        self.0.elapsed().as_secs_f64()
    }

    fn sleep_until(&self, when_s: f64) {
        if let Ok(left) = Duration::try_from_secs_f64(when_s - self.now_s()) {
            std::thread::sleep(left);
        }
    }
}
