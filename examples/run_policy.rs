//! Loads a shipped policy, runs it in the simulator and prints its success rate:
//! `cargo run --release --example run_policy`.
#![expect(clippy::print_stdout, reason = "an example that prints its results")]

use tandem_core::layout::EPISODE_STEPS;
use tandem_core::reward::is_success;
use tandem_core::{Stream, WorldSettings, episode_rng};
use tandem_policy::Policy;
use tandem_sim::{Env, WorldConfig};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let directory = concat!(env!("CARGO_MANIFEST_DIR"), "/policies");
    let policy = Policy::load(format!("{directory}/student-pick-and-place.safetensors").as_ref())?;
    let mut actor = policy.actor()?;
    let layout = policy.task.as_built_in().ok_or("a policy of a built-in task")?;
    let mut env = Env::new(layout, &WorldConfig::default())?;
    let mut observation = vec![0.0; policy.task.n_observation()];
    let mut action = vec![0.0; policy.task.n_action()];
    let mut n_successes = 0;
    for episode in 0..20 {
        env.reset(&mut episode_rng(1, episode, Stream::Reset), WorldSettings::default());
        for _ in 0..EPISODE_STEPS {
            env.observe(&mut observation);
            actor.act(&observation, env.goal(), &mut action);
            env.step(&action)?;
        }
        env.observe(&mut observation);
        n_successes += u32::from(is_success(layout, &observation, env.goal()));
    }
    println!("success rate {:.2} over 20 episodes", f64::from(n_successes) / 20.0);
    assert!(n_successes >= 18, "the shipped policy succeeds in 99 % of episodes");
    Ok(())
}

#[test]
fn a_shipped_policy_succeeds() {
    main().unwrap();
}
