//! The whole of learning, without processes and physics: an object that goes where it is told is brought to its goal.

use std::collections::BTreeMap;

use tandem_core::layout::{EPISODE_STEPS, Layout, OBJECT_POSITION};
use tandem_core::rng::{Stream, episode_rng, standard_normal, uniform};
use tandem_core::work::{EpisodeExploration, EpisodeOrder};
use tandem_core::{Contacts, Episode, EpisodeKind, Task};
use tandem_policy::Actor;
use tandem_rl::RunConfig;
use tandem_rl::config::Recipe;
use tandem_rl::trainer::Trainer;

const LAYOUT: Layout = Layout::new(Task::Push, 1);
/// Displacement of the object by an action of 1, metres.
const ACTION_M: f32 = 0.02;
/// Starts and goals lie within this of the origin on each axis, metres.
const REACH_M: f32 = 0.15;

fn config() -> RunConfig {
    let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 1);
    config.ddpg.n_hidden = 64;
    config.ddpg.n_hidden_layers = 2;
    config.ddpg.batch_size = 128;
    config.rounds.slots = 4;
    config
}

/// Plays an episode in the toy world, with noise unless `noise_std` is 0.
fn play(actor: &mut Actor, order: EpisodeOrder, noise_std: f32) -> Episode {
    let mut start = episode_rng(order.seed, order.number, Stream::Reset);
    let mut noise = episode_rng(order.seed, order.number, Stream::Exploration);
    let mut place = || std::array::from_fn::<f32, 3, _>(|_| uniform(&mut start, -REACH_M, REACH_M));
    let (mut object, goal) = (place(), place().to_vec());
    let (mut observations, mut actions) = (Vec::new(), Vec::new());
    for _ in 0..EPISODE_STEPS {
        let observation = observe(object);
        let mut action = [0.0; 3];
        actor.act(&observation, &goal, &mut action);
        for (component, position) in action.iter_mut().zip(&mut object) {
            *component = (*component + noise_std * standard_normal(&mut noise)).clamp(-1.0, 1.0);
            *position += ACTION_M * *component;
        }
        observations.extend(observation);
        actions.extend(action);
    }
    observations.extend(observe(object));
    Episode {
        number: order.number,
        kind: EpisodeKind::Training,
        parameter_version: 0,
        task: LAYOUT.into(),
        observations,
        goal,
        actions,
        advised_arms: vec![0; EPISODE_STEPS],
        contacts: vec![Contacts::NONE; EPISODE_STEPS],
        advice_charged: 0,
        avoidance_steps: None,
        queried_steps: None,
    }
}

fn observe(object: [f32; 3]) -> Vec<f32> {
    let mut observation = vec![0.0; LAYOUT.n_observation()];
    observation[OBJECT_POSITION].copy_from_slice(&object);
    observation
}

fn actor_of(trainer: &Trainer) -> Actor {
    trainer.policy(BTreeMap::new()).actor().expect("whole")
}

fn success(trainer: &Trainer) -> f64 {
    let mut actor = actor_of(trainer);
    let order = |number| EpisodeOrder {
        number,
        seed: 99,
        advised: false,
        exploration: EpisodeExploration::Noise,
        record: false,
        advised_steps: None,
    };
    let n_hits =
        (0..200).filter(|number| play(&mut actor, order(*number), 0.0).succeeded()).count();
    n_hits as f64 / 200.0
}

fn train(n_rounds: u64) -> Trainer {
    let mut trainer = Trainer::new(config()).expect("valid");
    for round in 0..n_rounds {
        let mut actor = actor_of(&trainer);
        let orders = trainer.training_orders(round, round);
        let ordered = orders.iter().flat_map(|slot| &slot.episodes);
        let episodes: Vec<Episode> = ordered.map(|order| play(&mut actor, *order, 0.3)).collect();
        trainer.ingest(&episodes);
        trainer.learn(|_| ()).expect("finite");
    }
    trainer
}

#[test]
fn the_goal_is_reached_from_sparse_rewards_alone() {
    let before = success(&train(0));
    let trained = train(25);
    let after = success(&trained);
    println!("success {before:.3} before, {after:.3} after {} updates", trained.counters().updates);
    assert!(before < 0.3, "the toy is too easy: {before} without learning");
    assert!(after > 0.9, "{after} after learning");
}

#[test]
fn the_same_seed_learns_the_same_bits() {
    assert_eq!(train(2).digest(), train(2).digest());
}
