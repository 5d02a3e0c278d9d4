//! The paper's measures of a learning curve (Table 2).

use tandem_telemetry::MetricsRow;

/// Share of the maximum success at which learning counts as begun.
const INSPIRED_SHARE: f64 = 0.1;
/// Share of the maximum success at which learning counts as done.
const RISEN_SHARE: f64 = 0.9;

/// The paper's measures of a learning curve, in paper epochs. A curve that never leaves zero has only `max_success`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LearningMeasures {
    /// IE: the epoch at which success first reaches 10 % of its maximum.
    pub inspired_epoch: Option<f64>,
    /// RT: epochs from 10 % to 90 % of the maximum.
    pub rising_epochs: Option<f64>,
    /// MSR: the maximum success.
    pub max_success: f64,
    /// ELR: 90 % of the maximum, divided by the epochs it took to reach it.
    pub learning_rate: Option<f64>,
}

impl LearningMeasures {
    /// Measures a run's evaluations, in order.
    #[must_use]
    pub fn of(rows: &[MetricsRow]) -> Self {
        let max_success = rows.iter().map(|row| row.success).fold(0.0, f64::max);
        let epoch_reaching = |share: f64| {
            let reached =
                rows.iter().find(|row| max_success > 0.0 && row.success >= share * max_success);
            reached.map(|row| row.paper_epochs)
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
    fn a_rising_curve_has_the_measures_that_the_paper_defines() {
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
}
