//! Estimates of times from recorded exchanges.

use crate::calibration::Exchange;

/// Time before a stop in which the joint's speed is fitted, and after its end in which rates count, seconds.
const FIT_S: f64 = 0.15;
/// Time at the end of a recording in which the joint is at rest, seconds.
const REST_S: f64 = 0.2;
/// Resolution of a braking time, seconds.
const STEP_S: f64 = 0.000_25;
/// Longest braking time that is tried, seconds.
const LONGEST_S: f64 = 0.2;
/// Expected error of a distance, in seconds at the full speed.
const DISTANCE_S: f64 = 0.001_5;
/// Expected error of a rate, as a share of the full speed.
const RATE_SHARE: f64 = 0.05;
/// Largest error of a distance that is tried, in expected errors.
const MOST_DISTANCES: f64 = 4.0;
/// Difference of errors (sums of squares) that counts as none.
const EQUAL_ERROR: f64 = 0.25;
/// Slowest speed from which a stop can be measured, radians per second.
const LEAST_RADPS: f64 = 0.02;

/// The braking of a joint after a stop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct StopFit {
    /// Time from the stamp of the newest state before the stop until the joint began to brake, seconds.
    pub(super) begins_s: f64,
    /// Time from then until it was at rest, seconds.
    pub(super) takes_s: f64,
}

/// Returns the lag of a joint's angles behind its commands, seconds, from the exchanges of a swing out and back: the
/// slope of the distance between commanded and measured angle over the commanded speed. `None` if nothing moved.
pub(super) fn lag_s(
    exchanges: &[Exchange],
    arm: usize,
    joint: usize,
    period_s: f64,
) -> Option<f64> {
    let mut commanded = None;
    let mut points = Vec::with_capacity(exchanges.len());
    let mut known = None;
    for exchange in exchanges {
        let angle = exchange.state.arms[arm].angles[joint];
        let velocity = exchange.commanded.as_ref().map_or(0.0, |arms| arms[arm][joint]);
        let total = commanded.get_or_insert(angle);
        *total += period_s * velocity;
        if known.replace(exchange.state.sequence) != Some(exchange.state.sequence) {
            points.push((velocity, *total - angle));
        }
    }
    slope(&points)
}

/// Returns the slope of the line through points, or `None` if their abscissae are equal.
fn slope(points: &[(f64, f64)]) -> Option<f64> {
    let n = points.len() as f64;
    let (x, y) = points.iter().fold((0.0, 0.0), |(x, y), point| (x + point.0, y + point.1));
    let (x, y) = (x / n, y / n);
    let spread: f64 = points.iter().map(|point| (point.0 - x) * (point.0 - x)).sum();
    let common: f64 = points.iter().map(|point| (point.0 - x) * (point.1 - y)).sum();
    (spread > 0.0).then(|| common / spread)
}

/// Fits how a joint that turned towards `side` (1 or -1) came to rest after a stop: its speed is constant, falls linearly
/// and is zero. `exchanges[n_before]` is the first exchange after the stop. `None` if it did not turn.
///
/// The distance from the last state before the stop determines the sum of the time until it brakes and half the time for
/// which it does; the rates of the states between determine the rest.
pub(super) fn fit_stop(
    exchanges: &[Exchange],
    n_before: usize,
    arm: usize,
    joint: usize,
    side: f64,
) -> Option<StopFit> {
    let newest = &exchanges.get(n_before.checked_sub(1)?)?.state;
    let (stamp_s, origin) = (newest.stamp_s, newest.arms[arm].angles[joint]);
    let point = |exchange: &Exchange| {
        let reading = &exchange.state.arms[arm];
        let time_s = exchange.state.stamp_s - stamp_s;
        (time_s, side * (reading.angles[joint] - origin), side * reading.velocities[joint])
    };
    let before = exchanges[..n_before].iter().rev().map(point);
    let before: Vec<(f64, f64)> = before
        .take_while(|(time_s, ..)| *time_s > -FIT_S)
        .map(|(time_s, angle, _)| (time_s, angle))
        .collect();
    let radps = slope(&before).filter(|radps| *radps > LEAST_RADPS)?;
    let n = before.len() as f64;
    let mean_s = before.iter().map(|(time_s, _)| time_s).sum::<f64>() / n;
    let start = before.iter().map(|(_, angle)| angle).sum::<f64>() / n - radps * mean_s;
    let after: Vec<(f64, f64, f64)> = exchanges[n_before..].iter().map(point).collect();
    let end_s = after.last()?.0;
    let rest = after.iter().filter(|(time_s, ..)| *time_s > end_s - REST_S);
    let (n, sum) = rest.fold((0.0, 0.0), |(n, sum), (_, angle, _)| (n + 1.0, sum + angle));
    let whole_s = (sum / n - start) / radps;
    if !(whole_s > 0.0 && whole_s.is_finite()) {
        return None;
    }
    let rates: Vec<(f64, f64)> = after
        .iter()
        .take_while(|(time_s, ..)| *time_s < whole_s + FIT_S)
        .map(|(time_s, _, rate)| (*time_s, rate / radps))
        .collect();
    Some(best_fit(whole_s, &rates))
}

/// Returns the fit that explains the distance, `whole_s` seconds at the full speed, and the rates, shares of the full
/// speed over time. Of fits that explain them about equally well, it returns the one that brakes for longest, which is
/// the slowest at higher speeds.
fn best_fit(whole_s: f64, rates: &[(f64, f64)]) -> StopFit {
    let mut fits: Vec<(f64, StopFit)> = Vec::new();
    let mut takes_s = 0.0;
    while takes_s <= LONGEST_S.min(2.0 * whole_s) {
        let middle_s = whole_s - 0.5 * takes_s;
        let mut begins_s = (middle_s - MOST_DISTANCES * DISTANCE_S).max(0.0);
        let mut best = (f64::INFINITY, StopFit { begins_s, takes_s });
        while begins_s <= middle_s + MOST_DISTANCES * DISTANCE_S {
            let fit = StopFit { begins_s, takes_s };
            let distance = (begins_s - middle_s) / DISTANCE_S;
            let rate = |(time_s, share): &(f64, f64)| (fit.share_at(*time_s) - share) / RATE_SHARE;
            let error = rates.iter().map(rate).map(|error| error * error).sum::<f64>();
            if error + distance * distance < best.0 {
                best = (error + distance * distance, fit);
            }
            begins_s += STEP_S;
        }
        fits.push(best);
        takes_s += STEP_S;
    }
    let least = fits.iter().map(|(error, _)| *error).fold(f64::INFINITY, f64::min);
    let good = fits.iter().rev().find(|(error, _)| *error <= least + EQUAL_ERROR);
    good.map_or(StopFit { begins_s: whole_s, takes_s: 0.0 }, |(_, fit)| *fit)
}

impl StopFit {
    /// Returns the share of the full speed at a time.
    fn share_at(&self, time_s: f64) -> f64 {
        let braked_s = time_s - self.begins_s;
        if braked_s <= 0.0 {
            1.0
        } else if braked_s < self.takes_s {
            1.0 - braked_s / self.takes_s
        } else {
            0.0
        }
    }
}
