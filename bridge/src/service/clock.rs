//! The clock that the service receives.

/// A monotonic clock and a way to wait for it.
pub trait Clock: Send + Sync {
    /// Returns the seconds since an arbitrary start. Never decreases.
    fn now_s(&self) -> f64;

    /// Blocks the calling thread until [`now_s`](Self::now_s) reaches `when_s`. Returns at once if that time has
    /// passed.
    fn sleep_until(&self, when_s: f64);
}

/// Returns the first of the times `from_s` + period, `from_s` + 2 periods, ... after `now_s`, all in seconds.
///
/// Missed times are skipped: late commands must not be sent in a burst.
pub(crate) fn next_time(from_s: f64, period_s: f64, now_s: f64) -> f64 {
    let next_s = from_s + period_s;
    if next_s > now_s {
        return next_s;
    }
    from_s + (((now_s - from_s) / period_s).floor() + 1.0) * period_s
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_keep_their_times_and_missed_ones_are_skipped() {
        let check = |from_s: f64, now_s: f64, expected: f64| {
            let next_s = next_time(from_s, 0.01, now_s);
            assert!((next_s - expected).abs() < 1e-9, "{from_s} {now_s}: {next_s}");
        };
        check(5.0, 5.0, 5.01);
        check(5.0, 5.009, 5.01);
        check(5.0, 5.0104, 5.02);
        check(5.0, 5.0496, 5.05);
        check(5.0, 65.004, 65.01);
    }

    #[test]
    fn a_million_ticks_do_not_drift() {
        let mut at_s = 0.5;
        for _ in 0..1_000_000 {
            at_s = next_time(at_s, 0.01, at_s + 0.004);
        }
        assert!((at_s - 10_000.5).abs() < 1e-4, "{at_s}");
    }
}
