//! Prints how fast this machine updates the two-arm push student, against its own matrix product:
//! `cargo run --release -p tandem-rl --example update_speed`.
//!
//! Each figure is the best of many short samples, taken in alternating blocks, so that other programs on the machine
//! matter little and each block finds the caches as it left them.

#![expect(clippy::print_stdout, reason = "its output is its purpose")]

use std::time::Instant;

use tandem_core::rng::uniform;
use tandem_core::{Layout, Stream, Task, episode_rng};
use tandem_policy::{Matrix, MatrixMut, multiply};
use tandem_rl::ddpg::{Batch, Ddpg, DdpgConfig, Rewards};

const N_BLOCKS: usize = 10;
const SAMPLES_PER_BLOCK: usize = 20;
const PRODUCTS_PER_SAMPLE: u32 = 20;
const SIDE: usize = 256;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let layout = Layout::new(Task::Push, 2);
    let config = DdpgConfig::default();
    let mut batch = Batch::new(layout, 2, config.transitions_per_update());
    let mut rng = episode_rng(1, 0, Stream::Replay);
    for x in batch.inputs.iter_mut().chain(&mut batch.next_inputs).chain(&mut batch.actions) {
        *x = uniform(&mut rng, -1.0, 1.0);
    }
    batch.rewards.fill(-1.0);
    let mut ddpg = Ddpg::new(config, layout, Rewards::sparse(2), 1);

    let n_cores = std::thread::available_parallelism()?.get();
    let mut updates_per_s: Vec<_> = std::iter::successors(Some(1), |n| Some(2 * n))
        .take_while(|n| *n <= n_cores)
        .map(|n_threads| (n_threads, 0.0_f64))
        .collect();
    let mut products_per_s = 0.0_f64;
    for _ in 0..N_BLOCKS {
        for _ in 0..SAMPLES_PER_BLOCK {
            products_per_s = products_per_s.max(sample_products());
        }
        for (n_threads, best) in &mut updates_per_s {
            ddpg.set_threads(*n_threads);
            for _ in 0..SAMPLES_PER_BLOCK {
                *best = best.max(sample_update(&mut ddpg, &batch)?);
            }
        }
    }

    let (_, one) = updates_per_s[0];
    let product_gflops = products_per_s * 2.0 * (SIDE * SIDE * SIDE) as f64 / 1e9;
    let update_gflop = ddpg.flops_per_update() as f64 / 1e9;
    println!(
        "product {SIDE}^3: {product_gflops:.1} GFLOP/s; an update with Polyak: {update_gflop:.3} GFLOP"
    );
    println!(
        "1 thread:  {one:.1} updates/s, {:.0} % of that rate",
        100.0 * one * update_gflop / product_gflops
    );
    for (n_threads, updates_per_s) in &updates_per_s[1..] {
        let speed_up = updates_per_s / one;
        println!("{n_threads} threads: {updates_per_s:.1} updates/s, {speed_up:.2} x one thread");
    }
    Ok(())
}

/// Updates per second, by one update and Polyak step.
fn sample_update(ddpg: &mut Ddpg, batch: &Batch) -> Result<f64, Box<dyn std::error::Error>> {
    let start = now();
    ddpg.update(ddpg.config().without_schedules(), batch)?;
    ddpg.polyak();
    Ok(1.0 / start.elapsed().as_secs_f64())
}

/// Products per second.
fn sample_products() -> f64 {
    let operand = vec![0.5; SIDE * SIDE];
    let mut product = vec![0.0; SIDE * SIDE];
    let operand = Matrix::new(&operand, SIDE, SIDE);
    let start = now();
    for _ in 0..PRODUCTS_PER_SAMPLE {
        multiply(&mut MatrixMut::new(&mut product, SIDE, SIDE), operand, operand);
    }
    f64::from(PRODUCTS_PER_SAMPLE) / start.elapsed().as_secs_f64()
}

#[expect(clippy::disallowed_methods, reason = "the clock of a benchmark")]
fn now() -> Instant {
    Instant::now()
}
