//! How fast a path may be followed: the fastest time scaling within bounds that hold everywhere, not at samples only.
//!
//! Let s be the length along the path in spans, v its rate and x = v². In every span s is accelerated evenly by u, so x
//! changes linearly from its value at one end to that at the other. In a span where |dq/ds| <= V and
//! |d²q/ds²| <= C for a joint:
//!
//! - its speed |dq/ds| v is at most V √x, and x is largest at an end of the span;
//! - its acceleration |dq/ds u + d²q/ds² x| is at most V |u| + C x.
//!
//! Both are kept within the limits with the larger x of the two ends. The first gives a bound of x at each end of
//! spans, and so does the second for u = 0. One pass forwards then lowers what cannot be reached from rest at
//! the start, one pass backwards what cannot be left for rest at the end (the phase plane of time-optimal path
//! following). Lowering x never breaks a bound of another span, so the result holds all of them.

/// Bounds of one span, per unit of the path.
#[derive(Debug, Clone, Default)]
pub(crate) struct SpanBounds {
    /// Largest x = v².
    pub(crate) x: f64,
    /// For each joint |dq/ds| and |d²q/ds²|, both divided by the acceleration limit.
    pub(crate) joints: Vec<[f64; 2]>,
}

impl SpanBounds {
    /// The largest x at which every joint can follow the path's curvature.
    fn curvature_x(&self) -> f64 {
        self.joints.iter().map(|[_, second]| 1.0 / second).fold(self.x, f64::min)
    }

    /// The largest x at one end of the span when it is `x` at the other, and the span may be accelerated in.
    fn reached_from(&self, x: f64) -> f64 {
        let rise =
            |[first, second]: &[f64; 2]| 2.0 * (1.0 - second * x).max(0.0) / (first + 2.0 * second);
        x + self.joints.iter().map(rise).fold(f64::INFINITY, f64::min)
    }
}

/// The rate v at each end of spans, from rest to rest: one more than there are spans, spans per second.
///
/// # Panics
/// When there are fewer than two spans: with rest at both ends one span would take for ever.
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
    fn a_straight_path_is_a_trapezoid() {
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
