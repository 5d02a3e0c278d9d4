//! Uniform cubic B-splines in all joints of all arms and the openings of the grippers.
//!
//! The span between two control points has length 1. A B-spline approximates its control points: at a corner it
//! deviates by a sixth of the second difference, and it is exact where points are equidistant on a line. It is twice
//! continuously differentiable. Its first derivative lies in the convex hull of three values and its second between
//! two, all given directly by the control points.

/// A path as control points, each a row of `n_channels` values.
#[derive(Debug, Clone)]
pub(crate) struct Spline {
    n_channels: usize,
    /// Shape `[n_spans + 3, n_channels]`.
    rows: Vec<f64>,
}

/// A value of the path and its derivatives by the path parameter, which counts spans.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Jet {
    pub(crate) value: f64,
    pub(crate) first: f64,
    pub(crate) second: f64,
}

impl Spline {
    /// Creates the path from the first to the last of `points` (shape `[n_spans + 1, n_channels]`). Linear
    /// extrapolation adds a control point at each end, so that the path starts and ends exactly at these points.
    ///
    /// # Panics
    /// If there are fewer than two points.
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

    /// Returns the number of spans.
    pub(crate) fn n_spans(&self) -> usize {
        self.rows.len() / self.n_channels - 3
    }

    /// Evaluates `channel` at parameter `t` in [0, 1] of `span`.
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

    /// Returns upper bounds on the absolute first and second derivative of `channel` in `span`.
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
    fn the_path_starts_and_ends_at_its_points_and_is_twice_differentiable() {
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
    fn derivatives_match_differences_and_stay_within_their_bounds() {
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
