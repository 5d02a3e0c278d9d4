//! The connections over which workers join, by number, and how many of the joins are logged.

use std::collections::BTreeMap;
use std::time::Duration;

use tandem_net::ConnectionClosed;

/// Log lines of one kind in a span of [`QUOTA_SPAN`].
const QUOTA: u64 = 100;
const QUOTA_SPAN: Duration = Duration::from_secs(10);

/// The open connections over which workers have joined. A relay's workers share one.
#[derive(Debug, Default)]
pub(crate) struct Connections {
    n_ever: u64,
    open: BTreeMap<u64, ConnectionClosed>,
}

impl Connections {
    /// The number of a connection, and whether it is new here.
    pub(crate) fn number_of(&mut self, hangup: &ConnectionClosed) -> (u64, bool) {
        if let Some((number, _)) = self.open.iter().rfind(|(_, known)| known.is_same(hangup)) {
            return (*number, false);
        }
        self.n_ever += 1;
        self.open.insert(self.n_ever, hangup.clone());
        (self.n_ever, true)
    }

    /// Forgets a connection that has ended.
    pub(crate) fn ended(&mut self, number: u64) {
        self.open.remove(&number);
    }
}

/// Bounds how many log lines are written about what anybody can make happen.
#[derive(Debug, Default)]
pub(crate) struct LogQuota {
    since: Option<Duration>,
    n: u64,
}

/// What to log about an occurrence.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Lines {
    /// Whether to log it.
    pub(crate) this: bool,
    /// How many before it were not logged, when that is to be told.
    pub(crate) left_out: Option<u64>,
}

impl LogQuota {
    /// Counts an occurrence.
    pub(crate) fn count(&mut self, now: Duration) -> Lines {
        let is_over = self.since.is_none_or(|since| now.saturating_sub(since) >= QUOTA_SPAN);
        let mut left_out = None;
        if is_over {
            left_out = self.n.checked_sub(QUOTA).filter(|n| *n > 0);
            (self.since, self.n) = (Some(now), 0);
        }
        self.n += 1;
        Lines { this: self.n <= QUOTA, left_out }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ten_thousand_occurrences_are_a_hundred_lines_and_a_count() {
        let mut quota = LogQuota::default();
        let lines: Vec<Lines> =
            (0..10_000).map(|n| quota.count(Duration::from_micros(n))).collect();
        assert_eq!(lines.iter().filter(|lines| lines.this).count(), 100);
        assert!(lines.iter().all(|lines| lines.left_out.is_none()));
        let later = quota.count(QUOTA_SPAN);
        assert_eq!(later, Lines { this: true, left_out: Some(9_900) });
        assert_eq!(quota.count(2 * QUOTA_SPAN), Lines { this: true, left_out: None });
    }
}
