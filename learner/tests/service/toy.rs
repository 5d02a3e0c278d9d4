//! A world without physics, and a small run in it: an object that goes where it is told.

use tandem_core::layout::{EPISODE_STEPS, Layout, OBJECT_POSITION};
use tandem_core::rng::{Stream, episode_rng, standard_normal, uniform};
use tandem_core::work::{EpisodeOrder, SlotOrder};
use tandem_core::{Contacts, Episode, EpisodeKind, Task};
use tandem_policy::Actor;
use tandem_rl::RunConfig;
use tandem_rl::config::Recipe;

pub(crate) const LAYOUT: Layout = Layout::new(Task::Push, 1);
/// Units that every advised episode is charged: its first steps are advised.
pub(crate) const UNITS: u32 = 7;
/// Displacement of the object by an action of 1, metres.
const ACTION_M: f32 = 0.02;
/// Starts and goals lie within this of the origin on each axis, metres.
const REACH_M: f32 = 0.06;

/// Nine rounds of four slots, an evaluation of ten episodes every other round, a checkpoint every third. The replay
/// buffer overflows on the way.
pub(crate) fn config(lag: u32) -> RunConfig {
    let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 1);
    config.name = "toy".to_owned();
    config.rounds.slots = 4;
    config.rounds.lag = lag;
    config.rounds.updates_per_env_step = 0.1;
    config.ddpg.n_hidden = 16;
    config.ddpg.n_hidden_layers = 2;
    config.ddpg.batch_size = 16;
    config.replay.capacity_transitions = 2000;
    config.evaluation.every_env_steps = 800;
    config.evaluation.early_points = 0;
    config.evaluation.episodes = 10;
    config.stop.max_env_steps = 3600;
    config.stop.max_minutes = 0.0;
    config.checkpoint.every_rounds = 3;
    config
}

/// Plays a slot. The episodes depend on the order and the actor, and on nothing else.
pub(crate) fn play(actor: &mut Actor, slot: &SlotOrder) -> Vec<Episode> {
    slot.episodes.iter().map(|order| play_episode(actor, slot, *order)).collect()
}

fn play_episode(actor: &mut Actor, slot: &SlotOrder, order: EpisodeOrder) -> Episode {
    let noise_std = if slot.kind == EpisodeKind::Training { 0.3 } else { 0.0 };
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
    // Evaluations differ from version to version, and the best is not the last.
    let is_put_there =
        slot.kind == EpisodeKind::Evaluation && order.number < 3 * slot.parameter_version % 10;
    let end = if is_put_there { [goal[0], goal[1], goal[2]] } else { object };
    observations.extend(observe(end));
    let mut episode = Episode {
        number: order.number,
        kind: slot.kind,
        parameter_version: slot.parameter_version,
        task: LAYOUT.into(),
        observations,
        goal,
        actions,
        advised_arms: vec![0; EPISODE_STEPS],
        contacts: vec![Contacts::NONE; EPISODE_STEPS],
        advice_charged: 0,
        avoidance_steps: None,
        queried_steps: None,
    };
    if order.advised {
        claim(&mut episode, UNITS);
    }
    episode
}

/// Makes an episode claim that its first `units` steps were advised.
pub(crate) fn claim(episode: &mut Episode, units: u32) {
    episode.advice_charged = units;
    for (step, arms) in (0..).zip(&mut episode.advised_arms) {
        *arms = u8::from(step < units);
    }
}

fn observe(object: [f32; 3]) -> Vec<f32> {
    let mut observation = vec![0.0; LAYOUT.n_observation()];
    observation[OBJECT_POSITION].copy_from_slice(&object);
    observation
}
