//! Steps the two-arm push environment with random actions and prints the return and success of each episode:
//! `cargo run --release --example random_actions`.
#![expect(clippy::print_stdout, reason = "an example that prints its results")]

use tandem_core::layout::EPISODE_STEPS;
use tandem_core::reward::{achieved_goal, is_success, sparse_reward};
use tandem_core::rng::uniform;
use tandem_core::{Layout, Stream, Task, WorldSettings, episode_rng};
use tandem_sim::{Env, SimError, WorldConfig};

fn main() -> Result<(), SimError> {
    let layout = Layout::new(Task::Push, 2);
    let mut env = Env::new(layout, &WorldConfig::default())?;
    let mut observation = vec![0.0; layout.n_observation()];
    let mut action = vec![0.0; layout.n_action()];
    for episode in 0..10 {
        env.reset(&mut episode_rng(1, episode, Stream::Reset), WorldSettings::default());
        let mut rng = episode_rng(1, episode, Stream::Exploration);
        let mut episode_return = 0.0;
        for _ in 0..EPISODE_STEPS {
            action.fill_with(|| uniform(&mut rng, -1.0, 1.0));
            env.step(&action)?;
            env.observe(&mut observation);
            let achieved: Vec<f32> = achieved_goal(layout, &observation).collect();
            episode_return += sparse_reward(&achieved, env.goal());
        }
        let success = is_success(layout, &observation, env.goal());
        println!("episode {episode}: return {episode_return}, success {success}");
    }
    Ok(())
}

#[test]
fn random_actions_run() {
    main().unwrap();
}
