//! The Adam optimiser, and Polyak averaging for target networks.

use pulp::{Arch, Simd, WithSimd};

use crate::aligned::AlignedVec;
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
    first_moments: AlignedVec,
    second_moments: AlignedVec,
}

impl Adam {
    /// Creates an optimiser for `n_parameters` parameters. `learning_rate` is Adam's step size `alpha`, above 0.
    #[must_use]
    pub fn new(n_parameters: usize, learning_rate: f32) -> Self {
        Self {
            learning_rate,
            n_steps: 0,
            first_moments: AlignedVec::zeros(n_parameters),
            second_moments: AlignedVec::zeros(n_parameters),
        }
    }

    /// Updates `parameters` with `gradient`, both of shape `[n_parameters]`, so that the loss decreases.
    ///
    /// # Panics
    /// If a vector has another length.
    pub fn step(&mut self, parameters: &mut [f32], gradient: &[f32]) {
        let n = self.first_moments.len();
        assert_eq!((parameters.len(), gradient.len()), (n, n), "an optimiser for another network");
        self.step_in_parts(parameters, [n]).for_each(|mut part| part.apply(gradient));
    }

    /// Starts a step of `parameters`, shape `[n_parameters]`, whose parts can be updated side by side: the first
    /// parameters, as many as the first of `lengths`, and so on. The step is complete when every part is.
    ///
    /// # Panics
    /// If `parameters` has another length, or a part reaches beyond its end.
    pub fn step_in_parts<'a>(
        &'a mut self,
        parameters: &'a mut [f32],
        lengths: impl IntoIterator<Item = usize>,
    ) -> impl Iterator<Item = AdamPart<'a>> {
        let n = self.first_moments.len();
        assert_eq!(parameters.len(), n, "an optimiser for another network");
        self.n_steps += 1;
        let (step_size, second_scale) = self.bias_corrected();
        let mut rest = (parameters, &mut *self.first_moments, &mut *self.second_moments);
        lengths.into_iter().map(move |length| {
            let (parameters, first_moments, second_moments) = std::mem::take(&mut rest);
            let (parameters, parameters_after) = parameters.split_at_mut(length);
            let (first_moments, first_after) = first_moments.split_at_mut(length);
            let (second_moments, second_after) = second_moments.split_at_mut(length);
            rest = (parameters_after, first_after, second_after);
            AdamPart { step_size, second_scale, parameters, first_moments, second_moments }
        })
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

    /// Restores the state of an optimiser: its number of steps and its [`moments`](Self::moments). The learning rate
    /// stays.
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

/// A part of a step: see [`Adam::step_in_parts`].
#[derive(Debug)]
pub struct AdamPart<'a> {
    step_size: f32,
    second_scale: f32,
    parameters: &'a mut [f32],
    first_moments: &'a mut [f32],
    second_moments: &'a mut [f32],
}

impl AdamPart<'_> {
    /// Updates the parameters of the part with their gradient, of the same length. To be called once.
    ///
    /// # Panics
    /// If the gradient has another length.
    pub fn apply(&mut self, gradient: &[f32]) {
        assert_eq!(gradient.len(), self.parameters.len(), "a gradient of another length");
        Arch::new().dispatch(Kernel { part: self, gradient });
    }

    /// Returns the parameters of the part.
    #[must_use]
    pub const fn parameters(&self) -> &[f32] {
        self.parameters
    }
}

/// The update that [`AdamPart::apply`] compiles for each instruction set. A closure of this size would not be inlined.
struct Kernel<'a, 'b> {
    part: &'a mut AdamPart<'b>,
    gradient: &'a [f32],
}

impl WithSimd for Kernel<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let AdamPart { step_size, second_scale, parameters, first_moments, second_moments } =
            self.part;
        let numbers = parameters.iter_mut().zip(self.gradient);
        let moments = first_moments.iter_mut().zip(&mut **second_moments);
        for ((parameter, slope), (first, second)) in numbers.zip(moments) {
            *first = FIRST_DECAY * *first + FIRST_SHARE * *slope;
            *second = SECOND_DECAY * *second + SECOND_SHARE * (*slope * *slope);
            *parameter -= *step_size * *first / (second.sqrt() * *second_scale + EPSILON);
        }
    }
}

/// Moves `target` toward `online`: `target = keep * target + (1 - keep) * online`.
///
/// Both are flat parameter vectors of the same network, shape `[n_parameters]` (section 4.2 of the paper). `keep`, in
/// [0, 1], is Spinning Up's `polyak`; the `tau` of CleanRL and Stable-Baselines3 is `1 - keep`.
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
