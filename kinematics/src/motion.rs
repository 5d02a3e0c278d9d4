//! Sampled motions of the arms, and the cubic interpolation between samples.

use crate::joints::Joints;

/// The state of one arm at one sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmSample {
    /// Joint angles, radians.
    pub angles: Joints,
    /// Joint velocities, radians per second.
    pub velocities: Joints,
    /// Opening of the gripper: 0 is closed, 1 open.
    pub gripper_opening: f64,
}

/// The motion of all arms as equidistant samples. Between two samples each joint follows the cubic Hermite polynomial
/// with the angles and velocities of both.
#[derive(Debug, Clone, PartialEq)]
pub struct Motion {
    /// Time from one sample to the next, seconds.
    pub period_s: f64,
    /// Samples per arm, the first at time 0. All arms have the same number.
    pub arms: Vec<Vec<ArmSample>>,
}

impl Motion {
    /// Returns the duration, seconds.
    #[must_use]
    pub fn duration_s(&self) -> f64 {
        let n_samples = self.arms.first().map_or(0, Vec::len);
        n_samples.saturating_sub(1) as f64 * self.period_s
    }

    /// Returns the state of every arm at `time_s` (seconds). Times are clamped to the motion.
    ///
    /// # Panics
    /// If an arm has fewer than two samples, or its samples differ in their numbers of joints.
    #[must_use]
    pub fn at(&self, time_s: f64) -> Vec<ArmSample> {
        self.arms.iter().map(|samples| arm_at(samples, self.period_s, time_s)).collect()
    }
}

fn arm_at(samples: &[ArmSample], period_s: f64, time_s: f64) -> ArmSample {
    let n_intervals = samples.len() - 1;
    let periods = (time_s / period_s).clamp(0.0, n_intervals as f64);
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "between 0 and the number of samples"
    )]
    let idx = (periods as usize).min(n_intervals - 1);
    let (from, to) = (&samples[idx], &samples[idx + 1]);
    let share = periods - idx as f64;
    let cubic = |joint| Cubic::between(from, to, joint, period_s);
    ArmSample {
        angles: Joints::from_fn(from.angles.len(), |joint| cubic(joint).angle(share * period_s)),
        velocities: Joints::from_fn(from.angles.len(), |joint| cubic(joint).rate(share * period_s)),
        gripper_opening: from.gripper_opening + share * (to.gripper_opening - from.gripper_opening),
    }
}

/// The motion of a joint between two samples. Times are seconds since the first.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Cubic {
    from_rad: f64,
    /// Bernstein coefficients of the velocity, a quadratic, radians per second.
    rates: [f64; 3],
    period_s: f64,
}

impl Cubic {
    /// Interpolates joint `joint` of two samples that are `period_s` apart.
    pub(crate) fn between(from: &ArmSample, to: &ArmSample, joint: usize, period_s: f64) -> Self {
        let mean = (to.angles[joint] - from.angles[joint]) / period_s;
        let (first, last) = (from.velocities[joint], to.velocities[joint]);
        let rates = [first, 3.0 * mean - first - last, last];
        Self { from_rad: from.angles[joint], rates, period_s }
    }

    /// Returns the angle, radians.
    pub(crate) fn angle(&self, time_s: f64) -> f64 {
        let [a, b, c] = self.rates;
        let t = time_s / self.period_s;
        let of_period = t * (a + t * ((b - a) + t * (a - 2.0 * b + c) / 3.0));
        self.from_rad + of_period * self.period_s
    }

    /// Returns the velocity, radians per second.
    pub(crate) fn rate(&self, time_s: f64) -> f64 {
        let [a, b, c] = self.rates;
        let t = time_s / self.period_s;
        a + t * (2.0 * (b - a) + t * (a - 2.0 * b + c))
    }

    /// Returns an upper bound on the absolute velocity, radians per second.
    pub(crate) fn rate_bound(&self) -> f64 {
        self.rates.iter().fold(0.0, |max: f64, rate| max.max(rate.abs()))
    }

    /// Returns the largest absolute velocity, radians per second.
    pub(crate) fn largest_rate(&self) -> f64 {
        let [a, b, c] = self.rates;
        let ends = a.abs().max(c.abs());
        let top = (a - b) / (a - 2.0 * b + c);
        if top > 0.0 && top < 1.0 { ends.max(self.rate(top * self.period_s).abs()) } else { ends }
    }

    /// Returns the largest absolute acceleration, radians per second squared.
    pub(crate) fn largest_acceleration(&self) -> f64 {
        let [a, b, c] = self.rates;
        2.0 * (b - a).abs().max((c - b).abs()) / self.period_s
    }

    /// Returns the smallest acceleration limit under which some motion connects the two samples, radians per second
    /// squared.
    ///
    /// That motion is bang-bang: full acceleration in one direction, then in the other. With the limit A, the period h,
    /// the mean acceleration a and the distance d beyond that of constant acceleration, d = h² (A² − a²) / 4 A.
    pub(crate) fn least_acceleration(&self) -> f64 {
        let [first, middle, last] = self.rates;
        let mean = (last - first) / self.period_s;
        let excess_rad = (middle - 0.5 * (first + last)) / 3.0 * self.period_s;
        let part = 2.0 * excess_rad.abs() / (self.period_s * self.period_s);
        part + libm::hypot(part, mean)
    }

    /// Returns the smallest and the largest angle, radians.
    pub(crate) fn angle_bounds(&self) -> [f64; 2] {
        let ends = [self.from_rad, self.angle(self.period_s)];
        let stationary =
            self.stationary_shares().into_iter().filter(|share| *share > 0.0 && *share < 1.0);
        let angles = stationary.map(|share| self.angle(share * self.period_s)).chain(ends);
        angles.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], angle| {
            [low.min(angle), high.max(angle)]
        })
    }

    /// Returns the roots of the velocity as shares of the period. Values outside (0, 1), NaN included, are to be
    /// ignored.
    fn stationary_shares(&self) -> [f64; 2] {
        let [a, b, c] = self.rates;
        let (square, half) = (a - 2.0 * b + c, b - a);
        let root = (half * half - square * a).sqrt();
        let far = -(half + root.copysign(half));
        [far / square, a / far]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cubic(angles: [f64; 2], rates: [f64; 2], period_s: f64) -> Cubic {
        let [from, to] = [0, 1].map(|end| ArmSample {
            angles: Joints::new(&[angles[end]]),
            velocities: Joints::new(&[rates[end]]),
            gripper_opening: 0.0,
        });
        Cubic::between(&from, &to, 0, period_s)
    }

    #[test]
    fn the_cubic_has_the_angles_and_velocities_of_both_samples() {
        let cubic = cubic([1.0, 1.3], [0.5, -2.0], 0.1);
        let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-12, "{a} {b}");
        close(cubic.angle(0.0), 1.0);
        close(cubic.angle(0.1), 1.3);
        close(cubic.rate(0.0), 0.5);
        close(cubic.rate(0.1), -2.0);
        let derived = (cubic.angle(0.04 + 1e-6) - cubic.angle(0.04 - 1e-6)) / 2e-6;
        assert!((derived - cubic.rate(0.04)).abs() < 1e-6);
        let [low, high] = cubic.angle_bounds();
        let (mut largest_rate, mut largest_acceleration) = (0.0_f64, 0.0_f64);
        for step in 0..=1000 {
            let time_s = 1e-4 * f64::from(step);
            assert!((low..=high).contains(&cubic.angle(time_s)));
            largest_rate = largest_rate.max(cubic.rate(time_s).abs());
            let acceleration = (cubic.rate(time_s + 1e-6) - cubic.rate(time_s - 1e-6)) / 2e-6;
            largest_acceleration = largest_acceleration.max(acceleration.abs());
        }
        assert!((cubic.largest_rate() - largest_rate).abs() < 1e-3);
        assert!((cubic.largest_acceleration() - largest_acceleration).abs() < 1e-3);
    }

    #[test]
    fn a_motion_interpolates_its_samples_and_is_constant_outside() {
        let sample = |angle, rate, gripper_opening| ArmSample {
            angles: Joints::new(&[angle]),
            velocities: Joints::new(&[rate]),
            gripper_opening,
        };
        let samples = vec![sample(0.0, 0.0, 0.2), sample(0.1, 0.5, 0.4), sample(0.3, 0.0, 0.4)];
        let motion = Motion { period_s: 0.2, arms: vec![samples.clone()] };
        assert!((motion.duration_s() - 0.4).abs() < 1e-12);
        for (time_s, expected) in [(-1.0, 0), (0.0, 0), (0.2, 1), (0.4, 2), (9.0, 2)] {
            let (got, expected) = (motion.at(time_s)[0], samples[expected]);
            assert!((got.angles[0] - expected.angles[0]).abs() < 1e-12, "{time_s}");
            assert!((got.velocities[0] - expected.velocities[0]).abs() < 1e-12, "{time_s}");
        }
        let middle = motion.at(0.1)[0];
        assert!((middle.gripper_opening - 0.3).abs() < 1e-12 && middle.angles[0] < 0.05);
    }

    #[test]
    fn the_least_acceleration_is_that_of_a_bang_bang_motion() {
        // With 3 rad/s² for 0.7 of a period and then −3 rad/s² for the rest, from 0.2 rad/s.
        let (period_s, limit, share) = (0.01_f64, 3.0_f64, 0.7_f64);
        let (first_s, then_s) = (share * period_s, (1.0 - share) * period_s);
        let middle = 0.2 + limit * first_s;
        let last = middle - limit * then_s;
        let displacement = 0.5 * (0.2 + middle) * first_s + 0.5 * (middle + last) * then_s;
        let least = cubic([0.0, displacement], [0.2, last], period_s).least_acceleration();
        assert!((least - limit).abs() < 1e-9, "{least}");
        let even = cubic([0.0, 0.2 * 0.01 + 1e-4], [0.2, 0.22], period_s).least_acceleration();
        assert!((even - 2.0).abs() < 1e-9, "{even}");
    }
}
