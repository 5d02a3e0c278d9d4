//! The paper's measures of a learning curve (Table 2).

use tandem_telemetry::MetricsRow;

use crate::quantity::Quantity;

/// Share of the maximum success that defines IE and the start of RT.
const INSPIRED_SHARE: f64 = 0.1;
/// Share of the maximum success that defines the end of RT, and ELR.
const RISEN_SHARE: f64 = 0.9;
/// Maximum success below which the epochs of a curve say nothing about learning.
const MIN_SUCCESS: f64 = 0.5;
/// Number of evaluations below which the epochs of a curve are too coarse.
const MIN_EVALUATIONS: usize = 5;
/// Tolerance of comparisons: the product of two shares may miss the share it equals by rounding.
const ROUNDING: f64 = 1e-9;

/// The paper's measures of a learning curve (section 4.2, Table 2), in paper epochs.
///
/// A curve that never leaves zero has only `max_success`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LearningMeasures {
    /// IE: the epoch at which success first reaches 10 % of its maximum.
    pub inspired_epoch: Option<f64>,
    /// RT: number of epochs from 10 % to 90 % of the maximum.
    pub rising_epochs: Option<f64>,
    /// MSR: the maximum success of an evaluation, in [0, 1].
    pub max_success: f64,
    /// ELR: 90 % of the maximum, divided by the number of epochs until it was reached.
    pub learning_rate: Option<f64>,
}

impl LearningMeasures {
    /// Computes the measures of a run's evaluations, which are in order.
    #[must_use]
    pub fn of(rows: &[MetricsRow]) -> Self {
        let max_success = rows.iter().map(|row| row.success).fold(0.0, f64::max);
        let epoch_reaching = |share: f64| {
            let reached = first_reaching(rows, Quantity::Success, share * max_success);
            reached.filter(|_| max_success > 0.0).map(|row| row.paper_epochs)
        };
        let (inspired, risen) = (epoch_reaching(INSPIRED_SHARE), epoch_reaching(RISEN_SHARE));
        Self {
            inspired_epoch: inspired,
            rising_epochs: risen.zip(inspired).map(|(risen, inspired)| risen - inspired),
            max_success,
            learning_rate: risen
                .filter(|epochs| *epochs > 0.0)
                .map(|epochs| RISEN_SHARE * max_success / epochs),
        }
    }
}

impl LearningMeasures {
    /// Computes the measures for a comparison: without IE, RT and ELR if the maximum is below 0.5 or there are fewer
    /// than five evaluations. Returns `None` if there are none.
    #[must_use]
    pub fn for_comparison(rows: &[MetricsRow]) -> Option<Self> {
        let measures = Self::of(rows);
        let is_meaningful =
            measures.max_success >= MIN_SUCCESS - ROUNDING && rows.len() >= MIN_EVALUATIONS;
        let epochs = |value: Option<f64>| value.filter(|_| is_meaningful);
        (!rows.is_empty()).then(|| Self {
            inspired_epoch: epochs(measures.inspired_epoch),
            rising_epochs: epochs(measures.rising_epochs),
            learning_rate: epochs(measures.learning_rate),
            ..measures
        })
    }
}

/// Returns the cost of a run until an evaluation, if it is known.
pub(crate) type CostOf = fn(&MetricsRow) -> Option<f64>;

/// Returns the first evaluation in which `quantity` is at least `value`.
#[must_use]
pub fn first_reaching(rows: &[MetricsRow], quantity: Quantity, value: f64) -> Option<&MetricsRow> {
    rows.iter().find(|row| quantity.of(row) >= value - ROUNDING)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(successes: &[f64]) -> Vec<MetricsRow> {
        let row = |(epoch, success): (u32, &f64)| MetricsRow {
            paper_epochs: f64::from(epoch) * 10.0,
            success: *success,
            ..MetricsRow::default()
        };
        (0..).zip(successes).map(row).collect()
    }

    #[test]
    fn a_rising_curve_has_the_measures_of_the_paper() {
        let measures = LearningMeasures::of(&rows(&[0.0, 0.05, 0.2, 0.5, 0.73, 0.8, 0.7]));
        assert_eq!(measures.inspired_epoch, Some(20.0));
        assert_eq!(measures.rising_epochs, Some(20.0));
        assert!((measures.max_success - 0.8).abs() < 1e-12);
        assert!((measures.learning_rate.unwrap() - 0.72 / 40.0).abs() < 1e-12);
    }

    #[test]
    fn a_curve_that_never_leaves_zero_has_no_epochs() {
        let measures = LearningMeasures::of(&rows(&[0.0, 0.0]));
        assert_eq!(
            (measures.inspired_epoch, measures.rising_epochs, measures.learning_rate),
            (None, None, None)
        );
        assert_eq!(LearningMeasures::of(&[]).max_success, 0.0);
    }

    #[test]
    fn a_short_or_low_curve_has_a_maximum_only() {
        let epochs = |successes: &[f64]| {
            let measures = LearningMeasures::for_comparison(&rows(successes)).unwrap();
            (measures.inspired_epoch, measures.learning_rate.is_some(), measures.max_success)
        };
        assert_eq!(epochs(&[0.0, 0.1, 0.3, 0.4, 0.5]), (Some(10.0), true, 0.5));
        assert_eq!(epochs(&[0.0, 0.1, 0.3, 0.4, 0.49]), (None, false, 0.49));
        assert_eq!(epochs(&[0.0, 0.1, 0.3, 0.9]), (None, false, 0.9));
        assert_eq!(LearningMeasures::for_comparison(&[]), None);
    }

    #[test]
    fn exactly_ten_and_ninety_per_cent_count_despite_rounding() {
        for n_tenths in 1..=24 {
            let share = |n_hits: i32| f64::from(n_hits) / 240.0;
            let curve = [0.0, share(n_tenths), share(9 * n_tenths), share(10 * n_tenths)];
            let measures = LearningMeasures::of(&rows(&curve));
            assert_eq!(measures.inspired_epoch, Some(10.0), "{n_tenths} of 240");
            assert_eq!(measures.rising_epochs, Some(10.0), "{n_tenths} of 240");
        }
    }

    #[test]
    fn a_threshold_is_reached_by_the_first_evaluation_at_or_above_it() {
        let rows = rows(&[0.4, 228.0 / 240.0, 0.8, 1.0]);
        let reached = |success| first_reaching(&rows, Quantity::Success, success);
        let epoch = |success| reached(success).map(|row| row.paper_epochs);
        assert_eq!(
            [0.0, 0.5, 0.95, 0.951, 1.0].map(epoch),
            [Some(0.0), Some(10.0), Some(10.0), Some(30.0), Some(30.0)]
        );
        assert_eq!(first_reaching(&rows[..1], Quantity::Success, 0.5), None);
    }
}
