//! Loads a shipped policy, runs it in the simulator and prints its success rate:
//! `cargo run --release --example run_policy`.
#![expect(clippy::print_stdout, reason = "an example that prints its results")]

use std::error::Error;

use tandem_core::layout::EPISODE_STEPS;
use tandem_core::reward::is_success;
use tandem_core::{Stream, episode_rng};
use tandem_policy::Policy;
use tandem_sim::{Env, Starts, WorldConfig};

const POLICY: &str =
    concat!(env!("CARGO_MANIFEST_DIR"), "/policies/student-pick-and-place.safetensors");

fn main() -> Result<(), Box<dyn Error>> {
    println!("success rate over 20 episodes: {:.2}", success_rate(20)?);
    Ok(())
}

fn success_rate(n_episodes: u32) -> Result<f64, Box<dyn Error>> {
    let policy = Policy::load(POLICY.as_ref())?;
    let (layout, mut actor) = (policy.layout, policy.actor()?);
    let mut env = Env::new(layout, &WorldConfig::default())?;
    let (mut observation, mut action) =
        (vec![0.0; layout.n_observation()], vec![0.0; layout.n_action()]);
    let mut n_successes = 0;
    for episode in 0..n_episodes {
        env.reset(&mut episode_rng(1, episode.into(), Stream::Reset), Starts::default());
        for _ in 0..EPISODE_STEPS {
            env.observe(&mut observation);
            actor.act(&observation, env.goal(), &mut action);
            env.step(&action)?;
        }
        env.observe(&mut observation);
        n_successes += u32::from(is_success(layout, &observation, env.goal()));
    }
    Ok(f64::from(n_successes) / f64::from(n_episodes))
}
