//! Prints the outputs of a policy file for arbitrary inputs, which `scripts/check_policy.py` compares with its own:
//! `cargo run --release -p tandem-policy --example policy_probe -- FILE [ROWS] > probe.json`.

#![expect(clippy::print_stdout, reason = "an example that prints its results")]

use std::path::Path;

use serde_json::json;
use tandem_core::rng::uniform;
use tandem_core::{Stream, episode_rng};
use tandem_policy::Policy;

const DEFAULT_ROWS: usize = 64;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let file = std::env::args().nth(1).ok_or("usage: policy_probe FILE [ROWS]")?;
    let n_rows = std::env::args().nth(2).map_or(Ok(DEFAULT_ROWS), |rows| rows.parse::<usize>())?;
    let policy = Policy::load(Path::new(&file))?;
    let (mut actor, mut critic) = (policy.actor()?, policy.critic()?);
    let task = &policy.task;

    let mut rng = episode_rng(0, 0, Stream::Reset);
    let mut draw =
        |n: usize| (0..n_rows * n).map(|_| uniform(&mut rng, -0.5, 0.5)).collect::<Vec<f32>>();
    let (observations, goals) = (draw(task.n_observation()), draw(task.n_goal()));
    let mut actions = vec![0.0; n_rows * task.n_action()];
    let mut q = vec![0.0; n_rows * critic.n_heads()];
    actor.act(&observations, &goals, &mut actions);
    critic.q(&observations, &goals, &actions, &mut q);
    let probe = json!({
        "digest": policy.digest(),
        "observations": observations.chunks(task.n_observation()).collect::<Vec<_>>(),
        "goals": goals.chunks(task.n_goal()).collect::<Vec<_>>(),
        "actions": actions.chunks(task.n_action()).collect::<Vec<_>>(),
        "q": q.chunks(critic.n_heads()).collect::<Vec<_>>(),
    });
    println!("{probe}");
    Ok(())
}
