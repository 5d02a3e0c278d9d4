//! The path: a uniform cubic B-spline in all joints of all arms and the grippers' openings.
//!
//! Between two control points lies a span of length 1. A B-spline does not pass through its points but follows them: at a
//! corner it stays away by a sixth of the second difference, and where points lie on a line evenly it is that line.
//! It is twice continuously differentiable, and its first and second derivatives lie within bounds that the
//! points give directly: the first between three known values, the second between two.

/// Control points; each is a row of `n_channels` numbers.
#[derive(Debug, Clone)]
pub(crate) struct Spline {
    n_channels: usize,
    /// Shape `[n_spans + 3, n_channels]`.
    rows: Vec<f64>,
}

/// A number of the path and its derivatives by the path's length in spans.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Jet {
    pub(crate) value: f64,
    pub(crate) first: f64,
    pub(crate) second: f64,
}

impl Spline {
    /// The path that begins at the first of `points` (shape `[n_spans + 1, n_channels]`), follows them and ends at the
    /// last: a point before the first and one behind the last go on in a straight line.
    ///
    /// # Panics
    /// When there are fewer than two points.
    pub(crate) fn following(n_channels: usize, points: &[f64]) -> Self {
        assert!(points.len() >= 2 * n_channels, "a path has a beginning and an end");
        let beyond = |from: &[f64], to: &[f64]| -> Vec<f64> {
            from.iter().zip(to).map(|(from, to)| 2.0 * to - from).collect()
        };
        let row = |idx: usize| &points[idx * n_channels..(idx + 1) * n_channels];
        let last = points.len() / n_channels - 1;
        let mut rows = beyond(row(1), row(0));
        rows.extend_from_slice(points);
        rows.extend(beyond(row(last - 1), row(last)));
        Self { n_channels, rows }
    }

    pub(crate) fn n_spans(&self) -> usize {
        self.rows.len() / self.n_channels - 3
    }

    /// One channel at share `t` of a span.
    pub(crate) fn at(&self, span: usize, t: f64, channel: usize) -> Jet {
        let [a, b, c, d] = self.points(span, channel);
        let rest = 1.0 - t;
        let (t2, t3) = (t * t, t * t * t);
        let value = rest * rest * rest * a
            + (3.0 * t3 - 6.0 * t2 + 4.0) * b
            + (3.0 * (t + t2 - t3) + 1.0) * c
            + t3 * d;
        let first = rest * rest * (b - a) + (1.0 + 2.0 * (t - t2)) * (c - b) + t2 * (d - c);
        let second = rest * (a - 2.0 * b + c) + t * (b - 2.0 * c + d);
        Jet { value: value / 6.0, first: first / 2.0, second }
    }

    /// Bounds of the absolute values of a channel's first and second derivative in a span.
    pub(crate) fn bounds(&self, span: usize, channel: usize) -> [f64; 2] {
        let [a, b, c, d] = self.points(span, channel);
        let first = [0.5 * (c - a), c - b, 0.5 * (d - b)];
        let second = [a - 2.0 * b + c, b - 2.0 * c + d];
        let largest = |values: &[f64]| values.iter().fold(0.0, |max: f64, v| max.max(v.abs()));
        [largest(&first), largest(&second)]
    }

    fn points(&self, span: usize, channel: usize) -> [f64; 4] {
        std::array::from_fn(|idx| self.rows[(span + idx) * self.n_channels + channel])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const POINTS: [f64; 7] = [0.0, 1.0, 1.0, 0.2, 0.9, 0.0, 0.3];

    #[test]
    fn the_path_joins_its_ends_twice_differentiably() {
        let path = Spline::following(1, &POINTS);
        assert_eq!(path.n_spans(), 6);
        assert!((path.at(0, 0.0, 0).value).abs() < 1e-15);
        assert!((path.at(5, 1.0, 0).value - 0.3).abs() < 1e-15);
        for span in 0..5 {
            let (end, start) = (path.at(span, 1.0, 0), path.at(span + 1, 0.0, 0));
            assert!((end.value - start.value).abs() < 1e-14);
            assert!((end.first - start.first).abs() < 1e-14);
            assert!((end.second - start.second).abs() < 1e-14);
        }
    }

    #[test]
    fn derivatives_are_right_and_within_their_bounds() {
        let path = Spline::following(1, &POINTS);
        for span in 0..path.n_spans() {
            let [first, second] = path.bounds(span, 0);
            for step in 1..20 {
                let t = f64::from(step) / 20.0;
                let [before, here, after] = [t - 1e-5, t, t + 1e-5].map(|t| path.at(span, t, 0));
                assert!(((after.value - before.value) / 2e-5 - here.first).abs() < 1e-8);
                assert!(((after.first - before.first) / 2e-5 - here.second).abs() < 1e-8);
                assert!(here.first.abs() <= first + 1e-12 && here.second.abs() <= second + 1e-12);
                assert!((0.0..=1.0).contains(&here.value), "openings stay in their range");
            }
        }
    }
}
