//! Prints the number of control steps per second that one core simulates, for each environment.
#![expect(
    clippy::print_stdout,
    clippy::disallowed_methods,
    reason = "a benchmark prints its results and reads the clock"
)]

use std::time::Instant;

use tandem_core::layout::EPISODE_STEPS;
use tandem_core::rng::uniform;
use tandem_core::{Layout, Stream, Task, WorldSettings, episode_rng};
use tandem_sim::{Env, SimError, WorldConfig};

const EPISODES: u64 = 40;

fn main() -> Result<(), SimError> {
    for substeps in [20, 10] {
        for task in Task::ALL {
            for n_arms in task.min_arms()..=2 {
                let config = WorldConfig { substeps, ..WorldConfig::default() };
                let steps_per_s = steps_per_s(Layout::new(task, n_arms), &config)?;
                println!(
                    "{task}, {n_arms} arms, {substeps} substeps: {steps_per_s:.0} control steps/s"
                );
            }
        }
    }
    Ok(())
}

/// Measures episodes with random actions that are held for four steps, including resets.
fn steps_per_s(layout: Layout, config: &WorldConfig) -> Result<f64, SimError> {
    let mut env = Env::new(layout, config)?;
    let mut action = vec![0.0; layout.n_action()];
    let mut observation = vec![0.0; layout.n_observation()];
    let start = Instant::now();
    for episode in 0..EPISODES {
        env.reset(&mut episode_rng(1, episode, Stream::Reset), WorldSettings::default());
        let mut exploration = episode_rng(1, episode, Stream::Exploration);
        for step in 0..EPISODE_STEPS {
            if step % 4 == 0 {
                action.fill_with(|| uniform(&mut exploration, -1.0, 1.0));
            }
            env.step(&action)?;
            env.observe(&mut observation);
        }
    }
    #[expect(clippy::cast_precision_loss, reason = "a few thousand")]
    let n_steps = EPISODES as f64 * EPISODE_STEPS as f64;
    Ok(n_steps / start.elapsed().as_secs_f64())
}
