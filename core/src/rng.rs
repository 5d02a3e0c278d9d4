//! Where randomness comes from: every draw has an address of run seed, number and stream.

use rand::{Rng, RngExt as _};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng as _;
use rand_distr::{Distribution as _, StandardNormal};

/// What a generator is for. Streams of one episode are independent; append only, the numbers enter every result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u64)]
pub enum Stream {
    /// Start state and goal of an episode.
    Reset = 0,
    /// Exploration noise and random actions of an episode.
    Exploration = 1,
    /// Batches drawn from the replay buffer; the number is the round's.
    Replay = 2,
    /// Initial weights; the number is the network's.
    Initialisation = 3,
    /// Hindsight goals with which an episode feeds the normaliser.
    Normaliser = 4,
}

/// The generator for `stream` of number `number` (an episode's, a round's, a network's) in run `run_seed`.
///
/// Neither a worker's index nor the order in which episodes finish enters the seed, so an episode can be played
/// again alone, on any worker.
#[must_use]
pub fn episode_rng(run_seed: u64, number: u64, stream: Stream) -> ChaCha8Rng {
    let mut seed = [0; 32];
    seed[..8].copy_from_slice(&run_seed.to_le_bytes());
    seed[8..16].copy_from_slice(&number.to_le_bytes());
    let mut rng = ChaCha8Rng::from_seed(seed);
    rng.set_stream(stream as u64);
    rng
}

/// A number in `[low, high)`.
pub fn uniform(rng: &mut impl Rng, low: f32, high: f32) -> f32 {
    low + (high - low) * rng.random::<f32>()
}

/// Whether a coin that shows heads with probability `probability` shows heads.
pub fn coin(rng: &mut impl Rng, probability: f32) -> bool {
    rng.random::<f32>() < probability
}

/// An index in `0..n`.
///
/// # Panics
/// When `n` is 0.
pub fn index(rng: &mut impl Rng, n: usize) -> usize {
    assert!(n > 0, "no index below 0");
    rng.random_range(0..n)
}

/// A draw from the normal distribution of mean 0 and standard deviation 1.
pub fn standard_normal(rng: &mut impl Rng) -> f32 {
    StandardNormal.sample(rng)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_gives_the_same_draws_and_another_gives_others() {
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
    fn normal_draws_have_mean_zero_and_deviation_one() {
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
