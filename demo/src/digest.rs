//! A digest of simulated episodes: two processors on which simulator and policies compute the same bits give equal
//! digests.

use sha2::{Digest as _, Sha256};
use tandem_core::layout::EPISODE_STEPS;
use tandem_core::text::hex;
use tandem_core::{Stream, WorldSettings, episode_rng};
use tandem_policy::Policy;
use tandem_sim::{Env, WorldConfig};

use crate::error::Error;
use crate::live::built_in;

/// Number of episodes of a digest; 1,000 control steps.
pub const N_EPISODES: u64 = 20;
/// Seed of the episodes.
const SEED: u64 = 1;

/// Returns the SHA-256 digest, hexadecimal, of all observations of [`N_EPISODES`] episodes that `policy` plays.
///
/// The observations before every step and after the last one enter as little-endian single-precision numbers. Each
/// depends on all actions before it, so the digest covers inference as well as physics.
///
/// # Errors
/// If the policy is of no built-in task, or if the world cannot be built or stepped.
pub fn digest(policy: &Policy) -> Result<String, Error> {
    let layout = built_in(policy)?;
    let mut env = Env::new(layout, &WorldConfig::default())?;
    let mut actor = policy.actor().map_err(|error| Error::Policy(error.into()))?;
    let mut observation = vec![0.0; layout.n_observation()];
    let mut action = vec![0.0; layout.n_action()];
    let mut hasher = Sha256::new();
    for episode in 0..N_EPISODES {
        env.reset(&mut episode_rng(SEED, episode, Stream::Reset), WorldSettings::default());
        env.observe(&mut observation);
        add(&mut hasher, &observation);
        for _ in 0..EPISODE_STEPS {
            actor.act(&observation, env.goal(), &mut action);
            env.step(&action)?;
            env.observe(&mut observation);
            add(&mut hasher, &observation);
        }
    }
    Ok(hex(&hasher.finalize()))
}

fn add(hasher: &mut Sha256, numbers: &[f32]) {
    for number in numbers {
        hasher.update(number.to_le_bytes());
    }
}
