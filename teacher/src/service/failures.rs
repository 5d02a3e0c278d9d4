//! Log lines about requests that fail for a reason on the teacher's side.
//!
//! During an outage, every client repeats its request about once a second.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use crate::error::Error;
use crate::ledger::LedgerError;
use crate::remote_policy::RemoteError;

/// The minimum time between two log lines about failures of one kind.
const LOG_EVERY: Duration = Duration::from_secs(60);

/// The kind of a failure. Their log lines do not displace each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum FailureKind {
    Ledger,
    OtherPolicy,
    PolicyAway,
    Late,
    Other,
}

/// Counts failures and logs one line for many of them.
#[derive(Debug, Default)]
pub(super) struct FailureLog {
    by_kind: Mutex<BTreeMap<FailureKind, Unlogged>>,
}

/// The failures since a log line.
#[derive(Debug)]
struct Unlogged {
    logged_at: Duration,
    n: u64,
}

impl FailureLog {
    /// Logs a failure at time `now`, unless it is the client's or one of its kind was logged within a minute.
    pub(super) fn record(&self, error: &Error, now: Duration) {
        let Some(kind) = kind_of(error) else { return };
        if let Some(n_failed) = self.count(kind, now) {
            tracing::error!(%error, n_failed, "request failed");
        }
    }

    /// Counts a failure. If a line is due, returns the number of failures since the previous one.
    fn count(&self, kind: FailureKind, now: Duration) -> Option<u64> {
        let mut by_kind = self.by_kind.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(unlogged) = by_kind.get_mut(&kind) else {
            by_kind.insert(kind, Unlogged { logged_at: now, n: 0 });
            return Some(1);
        };
        unlogged.n += 1;
        if now.saturating_sub(unlogged.logged_at) < LOG_EVERY {
            return None;
        }
        unlogged.logged_at = now;
        Some(std::mem::take(&mut unlogged.n))
    }
}

/// Returns the kind of a failure; `None` if the client has to change its request.
const fn kind_of(error: &Error) -> Option<FailureKind> {
    match error {
        Error::Request(_)
        | Error::Strategy(_)
        | Error::NoValues { .. }
        | Error::Ledger(LedgerError::Budget(_) | LedgerError::BeyondEnd { .. }) => None,
        Error::Ledger(LedgerError::Unavailable { .. } | LedgerError::OtherStrategy { .. })
        | Error::LedgerNeedsRestart => Some(FailureKind::Ledger),
        Error::RemotePolicy(RemoteError::Changed { .. }) => Some(FailureKind::OtherPolicy),
        Error::RemotePolicy(RemoteError::Unavailable { .. }) => Some(FailureKind::PolicyAway),
        Error::Timeout(_) => Some(FailureKind::Late),
        _ => Some(FailureKind::Other),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn failures_of_a_kind_are_logged_at_first_and_then_once_a_minute_with_their_number() {
        let log = FailureLog::default();
        let count = |kind, at_s| log.count(kind, Duration::from_secs(at_s));
        assert_eq!([0, 1, 59].map(|at_s| count(FailureKind::Ledger, at_s)), [Some(1), None, None]);
        assert_eq!(
            [count(FailureKind::Late, 59), count(FailureKind::Ledger, 60)],
            [Some(1), Some(3)]
        );
        assert_eq!(count(FailureKind::Ledger, 300), Some(1), "a later outage");
    }
}
