//! Prints how large a checkpoint of the two-arm push student is with 300,000 transitions, and how long it takes to be
//! saved and loaded: `cargo run --release -p tandem-learner --example checkpoint_speed [DIRECTORY]`.
//!
//! The directory is one of the disk that is measured, the present one by default; what is written there is removed.

#![expect(clippy::print_stdout, reason = "its output is its purpose")]

use std::path::PathBuf;
use std::time::Instant;

use tandem_core::layout::EPISODE_STEPS;
use tandem_core::{Episode, Layout, Task};
use tandem_learner::checkpoint::{self, Resumption};
use tandem_rl::RunConfig;
use tandem_rl::config::Recipe;
use tandem_rl::trainer::Trainer;

const N_TRANSITIONS: usize = 300_000;
const N_TIMES: usize = 3;

#[expect(clippy::disallowed_methods, reason = "it measures")]
fn main() -> Result<(), Box<dyn std::error::Error>> {
    let directory = std::env::args_os().nth(1).map_or_else(PathBuf::new, PathBuf::from);
    let directory = directory.join(format!("checkpoint-speed-{}", std::process::id()));
    let config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    let mut trainer = Trainer::new(config.clone())?;
    let episode = Episode::zeros(Layout::new(Task::Push, 2), 0);
    for _ in 0..N_TRANSITIONS / EPISODE_STEPS {
        trainer.ingest(std::slice::from_ref(&episode));
    }
    let resumption = Resumption::of_new_run(trainer.publish());
    for _ in 0..N_TIMES {
        let start = Instant::now();
        let saved = checkpoint::save(&directory, &trainer, &resumption, 1)?;
        let save_s = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let restored = checkpoint::load(&saved.path, &config)?;
        let load_s = start.elapsed().as_secs_f64();
        let megabytes = std::fs::metadata(&saved.path)?.len() as f64 / 1e6;
        let n_episodes = restored.trainer.counters().episodes;
        println!(
            "{n_episodes} episodes, {megabytes:.1} MB: saved in {save_s:.2} s, loaded in {load_s:.2} s"
        );
    }
    std::fs::remove_dir_all(&directory)?;
    Ok(())
}
