//! The Adam optimiser, and Polyak averaging for target networks.

use pulp::Arch;

use crate::elementwise::blend;

const FIRST_DECAY: f32 = 0.9;
const SECOND_DECAY: f32 = 0.999;
/// Weights of a new gradient. Computed in single precision, `1 - SECOND_DECAY` would have a relative error of 1.3e-5.
const FIRST_SHARE: f32 = 0.1;
const SECOND_SHARE: f32 = 0.001;
const EPSILON: f32 = 1e-8;

/// The Adam optimiser (Kingma & Ba 2015) with bias correction, `beta1 = 0.9`, `beta2 = 0.999` and `epsilon = 1e-8`.
#[derive(Debug, Clone, PartialEq)]
pub struct Adam {
    learning_rate: f32,
    n_steps: u64,
    first_moments: Vec<f32>,
    second_moments: Vec<f32>,
}

impl Adam {
    /// Creates an optimiser for `n_parameters` parameters.
    #[must_use]
    pub fn new(n_parameters: usize, learning_rate: f32) -> Self {
        Self {
            learning_rate,
            n_steps: 0,
            first_moments: vec![0.0; n_parameters],
            second_moments: vec![0.0; n_parameters],
        }
    }

    /// Updates `parameters` with `gradient`, both of shape `[n_parameters]`, so that the loss decreases.
    ///
    /// # Panics
    /// If a vector has another length.
    pub fn step(&mut self, parameters: &mut [f32], gradient: &[f32]) {
        let n = self.first_moments.len();
        assert_eq!((parameters.len(), gradient.len()), (n, n), "an optimiser for another network");
        self.n_steps += 1;
        let (step_size, second_scale) = self.bias_corrected();
        let (first_moments, second_moments) =
            (&mut self.first_moments[..n], &mut self.second_moments[..n]);
        Arch::new().dispatch(|| {
            for i in 0..n {
                let slope = gradient[i];
                let first = FIRST_DECAY * first_moments[i] + FIRST_SHARE * slope;
                let second = SECOND_DECAY * second_moments[i] + SECOND_SHARE * (slope * slope);
                first_moments[i] = first;
                second_moments[i] = second;
                parameters[i] -= step_size * first / (second.sqrt() * second_scale + EPSILON);
            }
        });
    }

    /// Sets the learning rate of the following steps. The moments are kept.
    pub const fn set_learning_rate(&mut self, learning_rate: f32) {
        self.learning_rate = learning_rate;
    }

    /// Returns the number of steps so far.
    #[must_use]
    pub const fn n_steps(&self) -> u64 {
        self.n_steps
    }

    /// Returns the first and second moments (running means of the gradient and of its square), each of shape
    /// `[n_parameters]`.
    #[must_use]
    pub fn moments(&self) -> [&[f32]; 2] {
        [&self.first_moments, &self.second_moments]
    }

    /// Restores the state of an optimiser: its number of steps and its [`moments`](Self::moments).
    ///
    /// # Panics
    /// If a vector has another length.
    pub fn restore(&mut self, n_steps: u64, [first_moments, second_moments]: [&[f32]; 2]) {
        self.n_steps = n_steps;
        self.first_moments.copy_from_slice(first_moments);
        self.second_moments.copy_from_slice(second_moments);
    }

    /// Returns the learning rate divided by the bias correction of the first moment, and the factor that corrects the
    /// square root of the second moment.
    #[expect(clippy::cast_possible_truncation, reason = "both lie well within f32")]
    fn bias_corrected(&self) -> (f32, f32) {
        let n_steps = self.n_steps as f64;
        let first = 1.0 - libm::pow(0.9, n_steps);
        let second = 1.0 - libm::pow(0.999, n_steps);
        ((f64::from(self.learning_rate) / first) as f32, (1.0 / second.sqrt()) as f32)
    }
}

/// Moves `target` toward `online`: `target = keep * target + (1 - keep) * online`.
///
/// Both are flat parameter vectors of the same network, shape `[n_parameters]`. `keep` is Spinning Up's `polyak`;
/// the `tau` of CleanRL and Stable-Baselines3 is `1 - keep`.
///
/// # Panics
/// If the two vectors differ in length.
pub fn polyak_update(target: &mut [f32], online: &[f32], keep: f32) {
    assert_eq!(target.len(), online.len(), "target and online network differ");
    blend(target, online, keep);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn adam_follows_its_published_formula() {
        let gradients = [[0.5, -2.0, 0.0], [0.25, 1.0, 1e-6], [-0.1, 0.3, 0.0]];
        let mut adam = Adam::new(3, 0.01);
        let mut parameters = [1.0_f32, -1.0, 0.5];
        let mut expected = parameters.map(f64::from);
        let (mut first, mut second) = ([0.0_f64; 3], [0.0_f64; 3]);
        for (step, gradient) in (1..).zip(gradients) {
            adam.step(&mut parameters, &gradient);
            for i in 0..3 {
                let slope = f64::from(gradient[i]);
                first[i] = 0.9 * first[i] + 0.1 * slope;
                second[i] = 0.999 * second[i] + 0.001 * slope * slope;
                let (m, v) = (
                    first[i] / (1.0 - 0.9_f64.powi(step)),
                    second[i] / (1.0 - 0.999_f64.powi(step)),
                );
                expected[i] -= 0.01 * m / (v.sqrt() + 1e-8);
                assert!(
                    (f64::from(parameters[i]) - expected[i]).abs() < 3e-7,
                    "step {step}, parameter {i}"
                );
            }
        }
    }

    #[test]
    fn a_restored_optimiser_continues_with_the_same_bits() {
        let mut first = Adam::new(2, 0.1);
        let (mut a, mut b) = ([1.0, 2.0], [0.0; 2]);
        first.step(&mut a, &[0.3, -0.4]);
        b.copy_from_slice(&a);
        let mut second = Adam::new(2, 0.1);
        second.restore(first.n_steps(), first.moments());
        first.step(&mut a, &[0.1, 0.2]);
        second.step(&mut b, &[0.1, 0.2]);
        assert_eq!((a, first), (b, second));
    }

    #[test]
    fn polyak_averaging_keeps_a_fraction_of_the_target() {
        let mut target = [1.0, -2.0];
        polyak_update(&mut target, &[3.0, 2.0], 0.75);
        assert_eq!(target, [1.5, -1.0]);
    }
}
