//! Noise in the actions of repeated episodes, in which a policy without it would do the same again.

use rand_chacha::ChaCha8Rng;
use tandem_core::rng::standard_normal;

/// Standard deviation of the noise in each number of an action.
const NOISE_STD: f32 = 0.1;

/// Adds noise to `action`, within [−1, 1].
pub(super) fn add_noise(rng: &mut ChaCha8Rng, action: &mut [f32]) {
    for number in action {
        *number = (*number + NOISE_STD * standard_normal(rng)).clamp(-1.0, 1.0);
    }
}
