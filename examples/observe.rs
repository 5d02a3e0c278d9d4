//! Executes actions in an environment and writes the observations, so that other programs can compare theirs:
//! `cargo run --release --example observe -- TASK N_ARMS SEED EPISODE < actions > observations`.
//!
//! Both streams are little-endian float32. There is one observation more than actions: the initial one.

use std::io::{Read as _, Write as _, stdin, stdout};

use tandem_core::{Layout, Stream, WorldSettings, episode_rng};
use tandem_sim::{Env, WorldConfig};

type AnyError = Box<dyn std::error::Error>;

fn main() -> Result<(), AnyError> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [task, n_arms, seed, episode] = &arguments[..] else {
        return Err("usage: observe TASK N_ARMS SEED EPISODE < actions > observations".into());
    };
    let layout = Layout::new(task.parse()?, n_arms.parse()?);
    let mut bytes = Vec::new();
    stdin().read_to_end(&mut bytes)?;
    let observations = observe(layout, seed.parse()?, episode.parse()?, &bytes)?;
    stdout().write_all(&observations)?;
    Ok(())
}

/// Returns the observations of an episode with the actions in `bytes`, encoded as them.
fn observe(layout: Layout, seed: u64, episode: u64, bytes: &[u8]) -> Result<Vec<u8>, AnyError> {
    let (numbers, []) = bytes.as_chunks::<4>() else {
        return Err("the actions are not a sequence of float32".into());
    };
    let actions: Vec<f32> = numbers.iter().map(|number| f32::from_le_bytes(*number)).collect();
    let mut env = Env::new(layout, &WorldConfig::default())?;
    env.reset(&mut episode_rng(seed, episode, Stream::Reset), WorldSettings::default());
    let mut observation = vec![0.0; layout.n_observation()];
    env.observe(&mut observation);
    let mut encoded = encode(&observation);
    for action in actions.chunks(layout.n_action()) {
        env.step(action)?;
        env.observe(&mut observation);
        encoded.extend(encode(&observation));
    }
    Ok(encoded)
}

fn encode(numbers: &[f32]) -> Vec<u8> {
    numbers.iter().flat_map(|number| number.to_le_bytes()).collect()
}

#[test]
fn an_episode_without_actions_has_one_observation() {
    let layout = Layout::new(tandem_core::Task::Push, 2);
    assert_eq!(observe(layout, 1, 0, &[]).unwrap().len(), 4 * layout.n_observation());
    assert!(observe(layout, 1, 0, &[0; 3]).is_err());
}
