//! Random number streams: a generator is determined by a run's seed, a number and the purpose of the draws.

use rand::{Rng, RngExt as _};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng as _;
use rand_distr::{Distribution as _, StandardNormal};

/// The purpose of a generator. The streams of one episode are independent of each other.
///
/// The discriminants enter every result, so variants are only ever appended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u64)]
pub enum Stream {
    /// Initial state and goal of an episode.
    Reset = 0,
    /// Exploration noise and random actions of an episode.
    Exploration = 1,
    /// Batches drawn from the replay buffer; the number is that of the round.
    Replay = 2,
    /// Initial weights; the number is that of the network.
    Initialisation = 3,
    /// Hindsight goals that an episode adds to the statistics of the goal normaliser.
    Normaliser = 4,
}

/// Returns the generator for `stream` of episode (or round, or network) `number` in the run with seed `run_seed`:
/// ChaCha8 with seed and number as its key.
///
/// The seed does not depend on the worker that plays an episode or on the order in which episodes finish, so any
/// episode can be replayed in isolation.
#[must_use]
pub fn episode_rng(run_seed: u64, number: u64, stream: Stream) -> ChaCha8Rng {
    let mut seed = [0; 32];
    seed[..8].copy_from_slice(&run_seed.to_le_bytes());
    seed[8..16].copy_from_slice(&number.to_le_bytes());
    let mut rng = ChaCha8Rng::from_seed(seed);
    rng.set_stream(stream as u64);
    rng
}

/// Draws a number from `[low, high)`.
pub fn uniform(rng: &mut impl Rng, low: f32, high: f32) -> f32 {
    low + (high - low) * rng.random::<f32>()
}

/// Draws from the Bernoulli distribution: returns `true` with probability `probability`, in [0, 1].
pub fn bernoulli(rng: &mut impl Rng, probability: f32) -> bool {
    rng.random::<f32>() < probability
}

/// Draws an index from `0..n`.
///
/// # Panics
/// If `n` is 0.
pub fn index(rng: &mut impl Rng, n: usize) -> usize {
    assert!(n > 0, "no index below 0");
    rng.random_range(0..n)
}

/// Draws from the normal distribution with mean 0 and standard deviation 1.
pub fn standard_normal(rng: &mut impl Rng) -> f32 {
    StandardNormal.sample(rng)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_repeat_for_equal_seeds_numbers_and_streams_only() {
        let draws = |seed, number, stream| {
            let mut rng = episode_rng(seed, number, stream);
            [uniform(&mut rng, 0.0, 1.0), uniform(&mut rng, 0.0, 1.0)]
        };
        let here = draws(7, 3, Stream::Reset);
        assert_eq!(here, draws(7, 3, Stream::Reset));
        for other in [
            draws(8, 3, Stream::Reset),
            draws(7, 4, Stream::Reset),
            draws(7, 3, Stream::Exploration),
        ] {
            assert_ne!(here, other);
        }
    }

    #[test]
    fn normal_draws_have_mean_zero_and_standard_deviation_one() {
        let mut rng = episode_rng(1, 0, Stream::Exploration);
        let draws: Vec<f32> = (0..20_000).map(|_| standard_normal(&mut rng)).collect();
        let mean = draws.iter().sum::<f32>() / 20_000.0;
        let variance = draws.iter().map(|x| (x - mean).powi(2)).sum::<f32>() / 20_000.0;
        assert!(
            mean.abs() < 0.03 && (variance - 1.0).abs() < 0.05,
            "mean {mean}, variance {variance}"
        );
    }
}
