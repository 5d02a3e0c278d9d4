//! The connections over which workers join, and a limit on log lines about joins.

use std::collections::BTreeMap;
use std::time::Duration;

use tandem_net::ConnectionClosed;

/// Log lines of one kind per [`QUOTA_SPAN`].
const QUOTA: u64 = 100;
const QUOTA_SPAN: Duration = Duration::from_secs(10);

/// The open connections over which workers have joined, by number. The workers of a relay share one.
#[derive(Debug, Default)]
pub(crate) struct Connections {
    n_ever: u64,
    open: BTreeMap<u64, ConnectionClosed>,
}

impl Connections {
    /// Returns the number of a connection, and true if the connection is new.
    pub(crate) fn register(&mut self, closed: &ConnectionClosed) -> (u64, bool) {
        if let Some((number, _)) = self.open.iter().rfind(|(_, known)| known.is_same(closed)) {
            return (*number, false);
        }
        self.n_ever += 1;
        self.open.insert(self.n_ever, closed.clone());
        (self.n_ever, true)
    }

    /// Returns true if the open connection `number` is the one with the signal `closed`.
    pub(crate) fn is_same(&self, number: u64, closed: &ConnectionClosed) -> bool {
        self.open.get(&number).is_some_and(|known| known.is_same(closed))
    }

    /// Removes a closed connection.
    pub(crate) fn remove(&mut self, number: u64) {
        self.open.remove(&number);
    }
}

/// Limits the log lines about an event that any client can cause.
#[derive(Debug, Default)]
pub(crate) struct LogQuota {
    since: Option<Duration>,
    n: u64,
}

/// The decision about logging one occurrence of an event.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct LogDecision {
    /// True if this occurrence is logged.
    pub(crate) log: bool,
    /// The number of earlier occurrences that were not logged, if it is to be logged now.
    pub(crate) n_skipped: Option<u64>,
}

impl LogQuota {
    /// Counts an occurrence.
    pub(crate) fn count(&mut self, now: Duration) -> LogDecision {
        let is_over = self.since.is_none_or(|since| now.saturating_sub(since) >= QUOTA_SPAN);
        let mut n_skipped = None;
        if is_over {
            n_skipped = self.n.checked_sub(QUOTA).filter(|n| *n > 0);
            (self.since, self.n) = (Some(now), 0);
        }
        self.n += 1;
        LogDecision { log: self.n <= QUOTA, n_skipped }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ten_thousand_occurrences_are_a_hundred_lines_and_a_count() {
        let mut quota = LogQuota::default();
        let lines: Vec<LogDecision> =
            (0..10_000).map(|n| quota.count(Duration::from_micros(n))).collect();
        assert_eq!(lines.iter().filter(|line| line.log).count(), 100);
        assert!(lines.iter().all(|line| line.n_skipped.is_none()));
        let later = quota.count(QUOTA_SPAN);
        assert_eq!(later, LogDecision { log: true, n_skipped: Some(9_900) });
        assert_eq!(quota.count(2 * QUOTA_SPAN), LogDecision { log: true, n_skipped: None });
    }
}
