//! Mean and range of a value over runs, and intervals of shares over seeds and over episodes.

use tandem_core::Wilson;

/// Mean and range of a value over the runs that have it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// Number of runs that have the value.
    pub n: usize,
    /// Number of runs of the group.
    pub n_runs: usize,
    /// Mean over the runs that have it; NaN if none has.
    pub mean: f64,
    /// Smallest value; NaN if no run has it.
    pub min: f64,
    /// Largest value; NaN if no run has it.
    pub max: f64,
}

impl Spread {
    /// Computes the spread of `values`, which belong to some of `n_runs` runs.
    #[must_use]
    pub fn of(values: &[f64], n_runs: usize) -> Self {
        Self {
            n: values.len(),
            n_runs,
            mean: values.iter().sum::<f64>() / values.len() as f64,
            min: values.iter().copied().fold(f64::NAN, f64::min),
            max: values.iter().copied().fold(f64::NAN, f64::max),
        }
    }
}

/// A share over the runs of a group, with its 95 % intervals.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShareSpread {
    /// Mean and range over the runs that have the share.
    pub values: Spread,
    /// Wilson's interval over the episodes of all runs together, which does not include the variation between seeds;
    /// `None` if no run has the share.
    pub pooled: Option<Wilson>,
    /// Student's interval of the mean over runs; `None` if fewer than three runs have the share.
    pub over_seeds: Option<MeanInterval>,
}

impl ShareSpread {
    /// Computes the spread of a share over some of `n_runs` runs, from the share, in [0, 1], and the number of episodes
    /// of each.
    #[must_use]
    pub fn of(shares: &[(f64, u64)], n_runs: usize) -> Self {
        let values: Vec<f64> = shares.iter().map(|(share, _)| *share).collect();
        Self {
            values: Spread::of(&values, n_runs),
            pooled: pooled_interval(shares),
            over_seeds: MeanInterval::of_shares(&values),
        }
    }

    /// Returns the ends of the interval that tables show: that over seeds, or that over episodes if there are fewer
    /// than three runs or all have the same share. The interval of equal shares over seeds has no width and would
    /// suggest that their mean is certain.
    #[must_use]
    pub fn shown_interval(&self) -> Option<(f64, f64)> {
        let over_seeds = self.over_seeds.filter(|_| self.values.min < self.values.max);
        let over_seeds = over_seeds.map(|MeanInterval { low, high }| (low, high));
        over_seeds.or_else(|| self.pooled.map(|Wilson { low, high }| (low, high)))
    }
}

/// The interval of the mean of a share over runs with different seeds, at a confidence of 95 % (Student 1908).
///
/// It applies to further seeds on the same goals, and takes the shares as normally distributed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeanInterval {
    /// Lower end, in [0, 1].
    pub low: f64,
    /// Upper end, in [0, 1].
    pub high: f64,
}

impl MeanInterval {
    /// Computes the interval for the shares of at least three runs, clipped to [0, 1]. Equal shares have an interval
    /// without width.
    #[must_use]
    pub fn of_shares(shares: &[f64]) -> Option<Self> {
        let Spread { n, mean, min, max, .. } = Spread::of(shares, shares.len());
        if n < MIN_RUNS {
            return None;
        }
        let squares = shares.iter().map(|share| (share - mean).powi(2)).sum::<f64>();
        // The rounding of the mean would give equal shares a width.
        let variance = if min < max { squares / (n - 1) as f64 } else { 0.0 };
        let margin = student_t(n - 1) * (variance / n as f64).sqrt();
        Some(Self { low: (mean - margin).clamp(0.0, 1.0), high: (mean + margin).clamp(0.0, 1.0) })
    }
}

/// Smallest number of runs from which the variation between seeds is estimated. For two, the interval would extend 12.7
/// standard errors to either side.
const MIN_RUNS: usize = 3;

/// Two-sided 95 % quantiles of Student's t distribution for 1 to 30 degrees of freedom (NIST/SEMATECH e-Handbook of
/// Statistical Methods, 1.3.6.7.2, column 0.975).
const STUDENT_T: [f64; 30] = [
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160,
    2.145, 2.131, 2.120, 2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056,
    2.052, 2.048, 2.045, 2.042,
];

/// Two-sided 95 % quantile of the normal distribution, which Student's t distribution approaches.
const NORMAL: f64 = 1.96;

/// Returns the two-sided 95 % quantile of Student's t distribution with `n_degrees` degrees of freedom, 1 or more.
fn student_t(n_degrees: usize) -> f64 {
    STUDENT_T.get(n_degrees - 1).copied().unwrap_or(NORMAL)
}

/// Returns the 95 % interval of a share over the episodes of all runs, from the share and the number of episodes of each.
fn pooled_interval(shares: &[(f64, u64)]) -> Option<Wilson> {
    let n_episodes: u64 = shares.iter().map(|(_, n)| n).sum();
    let n_hits: u64 = shares.iter().map(|(share, n)| hits(*share, *n)).sum();
    let counts = usize::try_from(n_hits).ok().zip(usize::try_from(n_episodes).ok());
    counts.filter(|(_, n)| *n > 0).map(|(hits, n)| Wilson::of(hits, n))
}

/// Returns the number of episodes that a share corresponds to.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a share of few episodes, clamped"
)]
fn hits(share: f64, n_episodes: u64) -> u64 {
    (share.clamp(0.0, 1.0) * n_episodes as f64).round() as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_shares_have_students_interval() {
        let interval = MeanInterval::of_shares(&[0.4, 0.5, 0.6]).unwrap();
        // Of R: t.test(c(0.4, 0.5, 0.6))$conf.int
        let errors = [interval.low - 0.251_586, interval.high - 0.748_414];
        assert!(errors.iter().all(|error| error.abs() < 1e-4), "{interval:?}");
    }

    #[test]
    fn fewer_than_three_runs_keep_the_interval_over_episodes() {
        let check = |shares: &[(f64, u64)], n_hits: usize, n: usize| {
            let spread = ShareSpread::of(shares, shares.len());
            let Wilson { low, high } = Wilson::of(n_hits, n);
            assert_eq!((spread.over_seeds, spread.shown_interval()), (None, Some((low, high))));
        };
        check(&[(0.5, 240)], 120, 240);
        check(&[(0.5, 240), (0.75, 240)], 300, 480);
        assert_eq!(ShareSpread::of(&[], 3).shown_interval(), None);
    }

    #[test]
    fn three_runs_that_differ_show_the_interval_over_seeds() {
        let spread = ShareSpread::of(&[(0.4, 240), (0.5, 240), (0.6, 240)], 4);
        let MeanInterval { low, high } = spread.over_seeds.unwrap();
        assert_eq!(spread.shown_interval(), Some((low, high)));
        assert_eq!(spread.pooled, Some(Wilson::of(360, 720)), "the interval over episodes remains");
        assert_eq!((spread.values.n, spread.values.n_runs), (3, 4));
    }

    #[test]
    fn the_interval_of_a_share_stays_within_0_and_1() {
        let interval = MeanInterval::of_shares(&[0.7, 0.9, 1.0]).unwrap();
        assert!(interval.low > 0.0 && interval.high == 1.0, "{interval:?}");
        let interval = MeanInterval::of_shares(&[0.0, 0.1, 0.3]).unwrap();
        assert!(interval.low == 0.0 && interval.high < 1.0, "{interval:?}");
    }

    #[test]
    fn equal_shares_have_an_interval_without_width_that_tables_do_not_show() {
        let share = 233.0 / 240.0;
        let equal = ShareSpread::of(&[(share, 240); 3], 3);
        let MeanInterval { low, high } = equal.over_seeds.unwrap();
        assert_eq!(low, high);
        assert!((low - share).abs() < 1e-12, "{low}");
        let Wilson { low, high } = Wilson::of(699, 720);
        assert_eq!(equal.shown_interval(), Some((low, high)));
    }

    #[test]
    fn quantiles_fall_from_those_of_few_seeds_to_that_of_the_normal_distribution() {
        assert_eq!([1, 2, 30, 31, 1000].map(student_t), [12.706, 4.303, 2.042, 1.96, 1.96]);
        assert!((1..60).all(|n| student_t(n) >= student_t(n + 1)));
    }
}
