//! Input normalisation with a running mean and standard deviation.

/// Lower bound on standard deviations, in the unit of the numbers, as in the HER reference implementation (OpenAI
/// baselines).
pub const STD_FLOOR: f32 = 0.01;
/// Normalised numbers are clipped to `[-CLIP, CLIP]`, as in the HER reference implementation (OpenAI baselines).
pub const CLIP: f32 = 5.0;

/// The mean and standard deviation by which inputs are normalised.
#[derive(Debug, Clone, PartialEq)]
pub struct NormalizerSnapshot {
    /// Mean of each column, shape `[size]`.
    pub mean: Vec<f32>,
    /// Standard deviation of each column, shape `[size]`, positive.
    pub std: Vec<f32>,
}

impl NormalizerSnapshot {
    /// Creates the normalisation with mean 0 and standard deviation 1, which only clips.
    #[must_use]
    pub fn identity(size: usize) -> Self {
        Self { mean: vec![0.0; size], std: vec![1.0; size] }
    }

    /// Writes `clip((raw - mean) / std, -CLIP, CLIP)` to `normalized`. Both rows have shape `[size]`.
    ///
    /// # Panics
    /// If a row has another length.
    pub fn normalize(&self, raw: &[f32], normalized: &mut [f32]) {
        let size = self.mean.len();
        assert_eq!((raw.len(), normalized.len()), (size, size), "a row of another size");
        for (out, ((raw, mean), std)) in
            normalized.iter_mut().zip(raw.iter().zip(&self.mean).zip(&self.std))
        {
            *out = ((raw - mean) / std).clamp(-CLIP, CLIP);
        }
    }
}

/// The state of a [`Normalizer`], for checkpoints.
#[derive(Debug, Clone, PartialEq)]
pub struct NormalizerState {
    /// Number of rows.
    pub count: u64,
    /// Sum of each column, shape `[size]`.
    pub sum: Vec<f64>,
    /// Sum of squares of each column, shape `[size]`.
    pub sum_of_squares: Vec<f64>,
}

/// The running mean and population standard deviation of all rows so far. Deviations below [`STD_FLOOR`] count as that.
#[derive(Debug, Clone, PartialEq)]
pub struct Normalizer {
    state: NormalizerState,
    snapshot: NormalizerSnapshot,
}

impl Normalizer {
    /// Creates a normaliser for rows of `size` numbers. Without data it only clips.
    #[must_use]
    pub fn new(size: usize) -> Self {
        let state =
            NormalizerState { count: 0, sum: vec![0.0; size], sum_of_squares: vec![0.0; size] };
        Self { state, snapshot: NormalizerSnapshot::identity(size) }
    }

    /// Creates a normaliser from stored state.
    ///
    /// # Panics
    /// If the two sums differ in length.
    #[must_use]
    pub fn from_state(state: NormalizerState) -> Self {
        assert_eq!(state.sum.len(), state.sum_of_squares.len(), "sums of different sizes");
        let snapshot = NormalizerSnapshot::identity(state.sum.len());
        let mut normalizer = Self { state, snapshot };
        normalizer.refresh();
        normalizer
    }

    /// Creates a normaliser as if it had seen `count` rows with the mean and standard deviation of `snapshot`; without
    /// rows it only clips.
    #[must_use]
    pub fn from_snapshot(snapshot: &NormalizerSnapshot, count: u64) -> Self {
        let rows = count as f64;
        let columns = || snapshot.mean.iter().zip(&snapshot.std);
        let sum = columns().map(|(mean, _)| f64::from(*mean) * rows).collect();
        let square = |x: f32| f64::from(x) * f64::from(x);
        let sum_of_squares =
            columns().map(|(mean, std)| (square(*mean) + square(*std)) * rows).collect();
        Self::from_state(NormalizerState { count, sum, sum_of_squares })
    }

    /// Returns the state, for checkpoints.
    #[must_use]
    pub const fn state(&self) -> &NormalizerState {
        &self.state
    }

    /// Adds rows to the statistics, shape `[n, size]`.
    ///
    /// # Panics
    /// If the length of `rows` is not a multiple of `size`.
    pub fn update(&mut self, rows: &[f32]) {
        let size = self.state.sum.len();
        assert_eq!(rows.len() % size, 0, "a row of another size");
        for row in rows.chunks_exact(size) {
            let sums = self.state.sum.iter_mut().zip(&mut self.state.sum_of_squares);
            for ((sum, sum_of_squares), x) in sums.zip(row) {
                *sum += f64::from(*x);
                *sum_of_squares += f64::from(*x) * f64::from(*x);
            }
            self.state.count += 1;
        }
        self.refresh();
    }

    /// Returns the current mean and standard deviation.
    #[must_use]
    pub const fn snapshot(&self) -> &NormalizerSnapshot {
        &self.snapshot
    }

    /// Normalises one row, shape `[size]`; see [`NormalizerSnapshot::normalize`].
    ///
    /// # Panics
    /// If a row has another length.
    pub fn normalize(&self, raw: &[f32], normalized: &mut [f32]) {
        self.snapshot.normalize(raw, normalized);
    }

    #[expect(clippy::cast_possible_truncation, reason = "means of f32 numbers are within f32")]
    fn refresh(&mut self) {
        if self.state.count == 0 {
            return;
        }
        let count = self.state.count as f64;
        let sums = self.state.sum.iter().zip(&self.state.sum_of_squares);
        for ((mean, std), (sum, sum_of_squares)) in
            self.snapshot.mean.iter_mut().zip(&mut self.snapshot.std).zip(sums)
        {
            let exact_mean = sum / count;
            let variance = (sum_of_squares / count - exact_mean * exact_mean).max(0.0);
            *mean = exact_mean as f32;
            *std = (variance.sqrt() as f32).max(STD_FLOOR);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 3 columns: spread out, far from zero, constant.
    fn rows() -> Vec<f32> {
        (0..500_u16)
            .flat_map(|i| [f32::from(i % 37) - 11.0, 40.0 + f32::from(i % 5) * 0.25, 0.125])
            .collect()
    }

    #[test]
    fn running_statistics_agree_with_a_two_pass_computation() {
        let rows = rows();
        let mut normalizer = Normalizer::new(3);
        normalizer.update(&rows[..300]);
        normalizer.update(&rows[300..]);
        for column in 0..3 {
            let values: Vec<f64> = rows.chunks(3).map(|row| f64::from(row[column])).collect();
            let mean = values.iter().sum::<f64>() / 500.0;
            let std =
                (values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 500.0).sqrt().max(0.01);
            assert!(
                (f64::from(normalizer.snapshot().mean[column]) - mean).abs() < 1e-5,
                "mean of column {column}"
            );
            assert!(
                (f64::from(normalizer.snapshot().std[column]) - std).abs() < 1e-6,
                "std of column {column}"
            );
        }
    }

    #[test]
    fn standard_deviations_have_a_floor_and_outliers_are_clipped() {
        let mut normalizer = Normalizer::new(3);
        normalizer.update(&rows());
        let mut normalized = [0.0; 3];
        normalizer.normalize(&[1e6, -1e6, 0.135], &mut normalized);
        assert_eq!(normalized[..2], [5.0, -5.0]);
        assert!((normalized[2] - 1.0).abs() < 1e-5, "one floor away from the mean");
    }

    #[test]
    fn a_normalizer_without_data_only_clips() {
        let mut normalized = [0.0; 2];
        Normalizer::new(2).normalize(&[0.75, -9.0], &mut normalized);
        assert_eq!(normalized, [0.75, -5.0]);
    }

    #[test]
    fn a_normalizer_is_restored_from_its_state() {
        let mut normalizer = Normalizer::new(3);
        normalizer.update(&rows());
        assert_eq!(Normalizer::from_state(normalizer.state().clone()), normalizer);
    }

    #[test]
    fn a_normalizer_from_a_snapshot_weighs_it_like_its_rows() {
        let snapshot = NormalizerSnapshot { mean: vec![0.3, -2.0], std: vec![0.5, 1.5] };
        let mut normalizer = Normalizer::from_snapshot(&snapshot, 1000);
        for (got, expected) in [
            (&normalizer.snapshot().mean, &snapshot.mean),
            (&normalizer.snapshot().std, &snapshot.std),
        ] {
            for (got, expected) in got.iter().zip(expected) {
                assert!((got - expected).abs() < 1e-5, "{got} against {expected}");
            }
        }
        normalizer.update(&[0.3, 4.0].repeat(1000));
        let after = normalizer.snapshot();
        assert!((after.mean[1] - 1.0).abs() < 1e-4, "half of the rows each: {after:?}");
        assert!((after.std[0] - 0.5 / 2.0_f32.sqrt()).abs() < 1e-4, "{after:?}");
    }
}
