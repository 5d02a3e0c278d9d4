//! Rate limiting of log lines about events that may occur thousands of times per second.

use std::time::Duration;

use tokio::time::Instant;

/// A rate limiter for one log line.
#[derive(Debug, Default)]
pub(crate) struct Throttle {
    last: Option<Instant>,
    n_since: u64,
}

impl Throttle {
    /// Counts an event. If a line is due, returns the number of events since the previous line.
    pub(crate) fn pass(&mut self, now: Instant, every: Duration) -> Option<u64> {
        self.n_since += 1;
        if self.last.is_some_and(|last| now.duration_since(last) < every) {
            return None;
        }
        self.last = Some(now);
        Some(std::mem::take(&mut self.n_since))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn a_line_is_due_at_the_first_event_and_then_once_per_interval_with_the_count() {
        let mut throttle = Throttle::default();
        let every = Duration::from_secs(60);
        let mut pass = || throttle.pass(Instant::now(), every);
        assert_eq!([pass(), pass(), pass()], [Some(1), None, None]);
        tokio::time::advance(every).await;
        assert_eq!([pass(), pass()], [Some(3), None]);
    }
}
