//! Rates of simulation, inference, updates and replay.

use std::num::NonZero;
use std::time::Duration;

use tandem_core::layout::EPISODE_STEPS;
use tandem_core::rng::{Stream, episode_rng, uniform};
use tandem_core::{ArmIndex, Episode, Layout, Task, WorldSettings};
use tandem_policy::{Matrix, MatrixMut, MlpShape, NormalizerSnapshot, multiply};
use tandem_rl::RunConfig;
use tandem_rl::config::Recipe;
use tandem_rl::ddpg::{Batch, Ddpg, Rewards};
use tandem_rl::her::{Sampler, Statistics};
use tandem_rl::replay::ReplayBuffer;
use tandem_rl::trainer::Trainer;
use tandem_sim::{Env, WorldConfig};

use crate::{Clock, Error, Figure};

/// Duration of a sample and number of samples of a rate. The best sample is returned, as the least disturbed one.
const SAMPLE: Duration = Duration::from_millis(600);
const N_SAMPLES: usize = 5;
/// Edge of the square matrices whose product is the reference for the machine.
const SGEMM_EDGE: usize = 256;

/// Measures environment steps per second on one core with random actions, including resets and observations.
///
/// # Errors
/// When a step fails, which is a bug.
pub fn sim(clock: &Clock) -> Result<Vec<Figure>, Error> {
    let mut figures = Vec::new();
    let worlds = Task::ALL
        .into_iter()
        .flat_map(|task| (task.min_arms()..=2).map(move |n_arms| (task, n_arms)));
    for (task, n_arms) in worlds {
        let layout = Layout::new(task, n_arms);
        let mut world = Env::new(layout, &WorldConfig::default())?;
        let mut rng = episode_rng(1, 0, Stream::Exploration);
        let (mut observation, mut action) =
            (vec![0.0; layout.n_observation()], vec![0.0; layout.n_action()]);
        let mut n_episodes = 0;
        let mut failure = None;
        let episodes_per_s = rate(clock, || {
            world.reset(&mut episode_rng(1, n_episodes, Stream::Reset), WorldSettings::default());
            n_episodes += 1;
            for _ in 0..EPISODE_STEPS {
                action.iter_mut().for_each(|component| *component = uniform(&mut rng, -1.0, 1.0));
                failure = world.step(&action).err().or(failure.take());
                world.observe(&mut observation);
            }
        });
        if let Some(error) = failure {
            return Err(error.into());
        }
        let value = episodes_per_s * EPISODE_STEPS as f64;
        figures.push(Figure::new(format!("sim/{task}/{n_arms}-arm"), value, "env steps/s"));
    }
    Ok(figures)
}

/// Measures the time of one decision of the two-arm student, for one, two and eight episodes in lock step, and the
/// ratio of an episode's time among eight to its time alone.
///
/// # Errors
/// When the default settings give no policy, which is a bug.
pub fn inference(clock: &Clock) -> Result<Vec<Figure>, Error> {
    let config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    let trainer = Trainer::new(config)?;
    let policy = trainer.policy(std::collections::BTreeMap::new());
    let mut actor = policy.actor()?;
    let task = policy.task;
    let mut decision_us = |n: usize| {
        let (observations, goals) =
            (vec![0.1; n * task.n_observation()], vec![0.1; n * task.n_goal()]);
        let mut actions = vec![0.0; n * task.n_action()];
        1e6 / rate(clock, || actor.act(&observations, &goals, &mut actions))
    };
    let [one, two, eight] = [1, 2, 8].map(&mut decision_us);
    let named = |suffix| format!("inference/student-actor/{suffix}");
    Ok(vec![
        Figure::new(named("batch-1"), one, "us"),
        Figure::new(named("batch-2"), two, "us"),
        Figure::new(named("batch-8"), eight, "us"),
        Figure::new(named("batch-8-per-row-over-batch-1"), eight / 8.0 / one, "x batch-1"),
    ])
}

/// Measures updates of the two-arm student per second with one, two, four and so on up to as many threads as the
/// machine has cores, and their ratio to one thread and of that to the matrix product.
pub fn update(clock: &Clock) -> Vec<Figure> {
    let layout = Layout::new(Task::Push, 2);
    let config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2).ddpg;
    let flop = update_flop(
        layout,
        config.n_hidden,
        config.n_hidden_layers,
        config.transitions_per_update(),
        layout.n_arms,
    );
    let batch = random_batch(layout, config.transitions_per_update());
    let sgemm = sgemm_flop_per_s(clock);
    let updates_per_s = |n_threads: usize| {
        let mut ddpg = Ddpg::new(config.clone(), layout, Rewards::sparse(layout.n_arms), 1);
        ddpg.set_threads(n_threads);
        rate(clock, || {
            drop(ddpg.update(config.without_schedules(), &batch));
            ddpg.polyak();
        })
    };
    let one = updates_per_s(1);
    let n_cores = std::thread::available_parallelism().map_or(1, NonZero::get);
    let more: Vec<_> = thread_counts(n_cores).map(|n| (n, updates_per_s(n))).collect();
    let named = |n_threads, suffix| format!("update/student/{n_threads}-threads{suffix}");
    let mut figures = vec![
        Figure::new("update/sgemm-256", sgemm / 1e9, "GFLOP/s"),
        Figure::new("update/student/1-thread", one, "updates/s"),
    ];
    figures.extend(more.iter().map(|(n, rate)| Figure::new(named(n, ""), *rate, "updates/s")));
    figures.extend([
        Figure::new("update/student/flop", flop / 1e9, "GFLOP"),
        Figure::new("update/student/1-thread-share-of-sgemm", one * flop / sgemm, "of sgemm-256"),
    ]);
    let speed_ups =
        more.iter().map(|(n, rate)| Figure::new(named(n, "-speed-up"), rate / one, "x 1 thread"));
    figures.extend(speed_ups);
    figures
}

/// Returns the numbers of threads that [`update`] compares with one: the powers of two above 1 and below `n_cores`, and
/// `n_cores` if it is above 1.
pub fn thread_counts(n_cores: usize) -> impl Iterator<Item = usize> {
    let below = std::iter::successors(Some(2), |n| Some(2 * n)).take_while(move |n| *n < n_cores);
    below.chain((n_cores > 1).then_some(n_cores))
}

/// Measures the time to sample one batch with hindsight from a buffer of 2,000 episodes.
pub fn replay(clock: &Clock) -> Vec<Figure> {
    let layout = Layout::new(Task::Push, 2);
    let config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    let mut buffer = ReplayBuffer::new(layout, 2000 * EPISODE_STEPS);
    (0..2000_u16).for_each(|number| {
        buffer.push(&drifting_episode(layout, u64::from(number), f32::from(number % 7) * 1e-3));
    });
    let mut sampler = Sampler::new(&config.replay, layout);
    let mut batch = Batch::new(layout, layout.n_arms, config.ddpg.transitions_per_update());
    let (observation, goal) = (
        NormalizerSnapshot::identity(layout.n_observation()),
        NormalizerSnapshot::identity(layout.n_goal()),
    );
    let statistics = Statistics { observation: &observation, goal: &goal };
    let mut rng = episode_rng(1, 0, Stream::Replay);
    let per_s = rate(clock, || sampler.fill(&buffer, statistics, &mut rng, &mut batch));
    vec![Figure::new("replay/batch-256", 1e6 / per_s, "us")]
}

/// Returns the calls of `work` per second, the best of several samples.
fn rate(clock: &Clock, mut work: impl FnMut()) -> f64 {
    work();
    let mut sample = || {
        let start = clock();
        let mut n_calls = 0_u32;
        while clock() - start < SAMPLE {
            work();
            n_calls += 1;
        }
        f64::from(n_calls) / (clock() - start).as_secs_f64()
    };
    (0..N_SAMPLES).map(|_| sample()).fold(0.0, f64::max)
}

/// Returns an episode in which the object of the first arm moves by `drift_m` per step along x.
fn drifting_episode(layout: Layout, number: u64, drift_m: f32) -> Episode {
    let mut episode = Episode::zeros(layout, number);
    let x = layout.achieved_goal_of(ArmIndex(0)).start;
    let rows = episode.observations.chunks_exact_mut(layout.n_observation());
    for (position, row) in std::iter::successors(Some(0.0), |x| Some(x + drift_m)).zip(rows) {
        row[x] = position;
    }
    episode
}

/// Counts the floating-point operations of one update: five forward passes, the two gradients of the critic, the
/// gradient through the critic to the actions, and the two gradients of the actor. A multiplication and an addition
/// count as two operations.
fn update_flop(
    layout: Layout,
    n_hidden: usize,
    n_layers: usize,
    batch_size: usize,
    n_heads: usize,
) -> f64 {
    let products = |shape: MlpShape| {
        let hidden = (shape.n_hidden_layers - 1) * shape.n_hidden * shape.n_hidden;
        (shape.n_input * shape.n_hidden + hidden + shape.n_hidden * shape.n_output) as f64
    };
    let actor = MlpShape::actor(layout, n_hidden, n_layers);
    let critic = MlpShape::critic(layout, n_hidden, n_layers, n_heads);
    let (first_actor, first_critic) =
        ((actor.n_input * n_hidden) as f64, (critic.n_input * n_hidden) as f64);
    let (a, q) = (products(actor), products(critic));
    let forward = 2.0 * a + 3.0 * q;
    let critic_backward = 2.0 * q - first_critic;
    let through_critic = q - first_critic + (layout.n_action() * n_hidden) as f64;
    let actor_backward = 2.0 * a - first_actor;
    2.0 * batch_size as f64 * (forward + critic_backward + through_critic + actor_backward)
}

fn random_batch(layout: Layout, batch_size: usize) -> Batch {
    let mut batch = Batch::new(layout, layout.n_arms, batch_size);
    let mut rng = episode_rng(1, 0, Stream::Replay);
    for values in [&mut batch.inputs, &mut batch.next_inputs, &mut batch.actions] {
        values.iter_mut().for_each(|value| *value = uniform(&mut rng, -1.0, 1.0));
    }
    batch.rewards.fill(-1.0);
    batch
}

fn sgemm_flop_per_s(clock: &Clock) -> f64 {
    let n = SGEMM_EDGE;
    let (lhs, rhs, mut product) = (vec![0.5; n * n], vec![0.25; n * n], vec![0.0; n * n]);
    let per_s = rate(clock, || {
        multiply(
            &mut MatrixMut::new(&mut product, n, n),
            Matrix::new(&lhs, n, n),
            Matrix::new(&rhs, n, n),
        );
    });
    per_s * 2.0 * (n * n * n) as f64
}
