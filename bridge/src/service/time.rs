//! Time, as the service is given it.

/// A clock, and a way to wait for it.
pub trait Time: Send + Sync {
    /// Seconds since a start of the clock's own; never less than before.
    fn now_s(&self) -> f64;

    /// Blocks the calling thread until [`now_s`](Self::now_s) is `when_s`, as exactly as it can; not at all when that is past.
    fn sleep_until(&self, when_s: f64);
}

/// The next of the times `from_s`, `from_s` + period, ... that is still to come at `now_s`, all in seconds.
///
/// Times that are past are left out: commands that come late must not come in a burst.
pub(super) fn next_time(from_s: f64, period_s: f64, now_s: f64) -> f64 {
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
    fn ticks_keep_their_times_and_missed_ones_are_left_out() {
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
