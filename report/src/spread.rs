//! Mean and range of a value over runs, and intervals of shares.

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

/// Returns the 95 % interval of a share over the episodes of all runs, from the share and the number of episodes of each.
pub(crate) fn pooled_interval(shares: &[(f64, u64)]) -> Option<Wilson> {
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
