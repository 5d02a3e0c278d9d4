//! Time-optimal path parameterization: the fastest time scaling of a path within limits that hold everywhere, not only
//! at samples.
//!
//! Let s be the path parameter in spans, v its rate and x = v². The acceleration u of s is constant in every span, so x
//! changes linearly from one end to the other. In a span where |dq/ds| <= V and |d²q/ds²| <= C for a joint:
//!
//! - its speed |dq/ds| v is at most V √x, and x is largest at an end of the span;
//! - its acceleration |dq/ds u + d²q/ds² x| is at most V |u| + C x.
//!
//! Both limits are applied to the larger x of the two ends. The first bounds x at each end of a span, and so does the
//! second for u = 0. A forward pass then lowers values that cannot be reached from rest at the start, a backward pass
//! values from which the path cannot come to rest at the end (as in numerical integration in the phase plane). Lowering
//! x never violates a bound of another span, so the result keeps all of them.

/// Bounds within one span, per unit of the path parameter.
#[derive(Debug, Clone, Default)]
pub(crate) struct SpanBounds {
    /// Largest x = v².
    pub(crate) x: f64,
    /// |dq/ds| and |d²q/ds²| of each joint, both divided by the acceleration limit.
    pub(crate) joints: Vec<[f64; 2]>,
}

impl SpanBounds {
    /// Returns the largest x at which every joint can follow the path's curvature.
    fn curvature_x(&self) -> f64 {
        self.joints.iter().map(|[_, second]| 1.0 / second).fold(self.x, f64::min)
    }

    /// Returns the largest x at one end of the span that is reachable from `x` at the other.
    fn reached_from(&self, x: f64) -> f64 {
        let rise =
            |[first, second]: &[f64; 2]| 2.0 * (1.0 - second * x).max(0.0) / (first + 2.0 * second);
        x + self.joints.iter().map(rise).fold(f64::INFINITY, f64::min)
    }
}

/// Returns the rate v at the ends of the spans, from rest to rest, spans per second; shape `[n_spans + 1]`.
///
/// # Panics
/// If there are fewer than two spans: a single span with rest at both ends would take for ever.
pub(crate) fn fastest_rates(spans: &[SpanBounds]) -> Vec<f64> {
    assert!(spans.len() >= 2, "at least two spans from rest to rest");
    let mut xs: Vec<f64> = vec![f64::INFINITY; spans.len() + 1];
    for (idx, span) in spans.iter().enumerate() {
        let x = span.curvature_x();
        xs[idx] = xs[idx].min(x);
        xs[idx + 1] = xs[idx + 1].min(x);
    }
    (xs[0], xs[spans.len()]) = (0.0, 0.0);
    for (idx, span) in spans.iter().enumerate() {
        xs[idx + 1] = xs[idx + 1].min(span.reached_from(xs[idx]));
    }
    for (idx, span) in spans.iter().enumerate().rev() {
        xs[idx] = xs[idx].min(span.reached_from(xs[idx + 1]));
    }
    xs.into_iter().map(f64::sqrt).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_straight_path_has_a_trapezoidal_profile() {
        // One joint, one radian per span, 1 rad/s² and 2 rad/s at most.
        let span = SpanBounds { x: 4.0, joints: vec![[1.0, 0.0]] };
        let rates = fastest_rates(&[span.clone(), span.clone(), span.clone(), span.clone(), span]);
        let expected = [0.0, 2.0_f64.sqrt(), 2.0, 2.0, 2.0_f64.sqrt(), 0.0];
        for (rate, expected) in rates.iter().zip(expected) {
            assert!((rate - expected).abs() < 1e-12, "{rates:?}");
        }
    }

    #[test]
    fn every_span_keeps_its_bounds() {
        let spans: Vec<SpanBounds> = (0..40_u32)
            .map(|idx| {
                let wave = |n: u32| f64::from((idx * n) % 7) / 7.0;
                let joints = vec![[0.1 + wave(3), 2.0 * wave(5)], [wave(2), 0.5 * wave(4)]];
                SpanBounds { x: 0.5 + 3.0 * wave(6), joints }
            })
            .collect();
        let rates = fastest_rates(&spans);
        for (idx, span) in spans.iter().enumerate() {
            let [from, to] = [rates[idx] * rates[idx], rates[idx + 1] * rates[idx + 1]];
            let (u, x) = (0.5 * (to - from).abs(), from.max(to));
            assert!(x <= span.x + 1e-12);
            for [first, second] in &span.joints {
                assert!(first * u + second * x <= 1.0 + 1e-9, "span {idx}");
            }
        }
    }
}
