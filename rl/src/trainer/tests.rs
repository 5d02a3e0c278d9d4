//! Tests of the learning state.

use std::ops::Range;

use tandem_core::work::{EpisodeExploration, EpisodeOrder};
use tandem_core::{Layout, Task};

use super::*;
use crate::config::Recipe;
use crate::replay::fixtures::drifting_episode;

mod learn;

#[test]
fn a_statistic_ruined_by_one_implausible_number_is_named() {
    let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    config.ddpg.n_hidden = 4;
    let mut trainer = Trainer::new(config).expect("valid");
    assert_eq!(trainer.implausible_statistic(), None);
    let mut row = vec![0.0; trainer.task.n_observation()];
    trainer.observation_normalizer.update(&row);
    row[31] = 25.0;
    trainer.observation_normalizer.update(&row);
    assert_eq!(trainer.implausible_statistic(), None, "an object may fall");
    row[31] = 1e29;
    trainer.observation_normalizer.update(&row);
    let named = trainer.implausible_statistic().expect("ruined");
    assert!(named.starts_with("number 31 of the observations has mean 3.3"), "{named}");
    trainer.observation_normalizer = Normalizer::new(row.len());
    trainer.goal_normalizer.update(&[f32::NAN; 6]);
    let named = trainer.implausible_statistic().expect("not finite");
    assert!(named.starts_with("number 0 of the goals has mean NaN"), "{named}");
}

/// Returns the goals' means after episode 0, whose objects drift apart from goals at 9 m.
fn goal_means(joint_goal_statistics: bool) -> Vec<f32> {
    let layout = Layout::new(Task::Push, 2);
    let mut config = RunConfig::defaults(Recipe::Paper, Task::Push, 2);
    config.ddpg.n_hidden = 4;
    config.replay.joint_goal_statistics = joint_goal_statistics;
    let mut trainer = Trainer::new(config).expect("valid");
    let mut episode = drifting_episode(layout, 0, 0.0);
    episode.goal.fill(9.0);
    for step_idx in 0..=50 {
        for arm in layout.arms() {
            let achieved = layout.achieved_goal_of(arm);
            episode.observations[step_idx * 56..][achieved].fill(0.1 * step_idx as f32);
        }
    }
    trainer.ingest(&[episode]);
    trainer.goal_normalizer.snapshot().mean.clone()
}

#[test]
fn joint_goal_statistics_take_the_same_later_step_for_all_arms() {
    let joint = goal_means(true);
    assert_eq!(joint[..3], joint[3..]);
    let per_arm = goal_means(false);
    assert_ne!(per_arm[..3], per_arm[3..]);
    assert_eq!(joint[..1], goal_means(true)[..1]);
}

#[test]
fn without_a_horizon_the_student_asks_on_all_steps_and_at_horizon_zero_on_none() {
    let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    config.ddpg.n_hidden = 4;
    let orders = |trainer: &Trainer| -> Vec<EpisodeOrder> {
        let slots = trainer.training_orders(0, 0);
        slots.into_iter().flat_map(|slot| slot.episodes).collect()
    };
    let trainer = Trainer::new(config.clone()).expect("valid");
    assert!(orders(&trainer).iter().all(|order| order.advised_steps.is_none()));
    assert_eq!(orders(&trainer).iter().filter(|order| order.advised).count(), 8, "every other one");
    "jsrl:1".clone_into(&mut config.advice.strategy);
    let mut trainer = Trainer::new(config).expect("valid");
    let asks = |order: &EpisodeOrder| [0, 1].map(|step_idx| order.asks_on(step_idx));
    assert_eq!(asks(&orders(&trainer)[1]), [true, false]);
    let jump_start = trainer.jump_start.as_mut().expect("a horizon");
    jump_start.finish_round(32, 32);
    jump_start.finish_round(32, 32);
    assert!(orders(&trainer).iter().all(|order| !order.advised), "no leases, no queries");
}

#[test]
fn greedy_episodes_are_a_share_of_those_without_advice_and_after_the_warm_up() {
    let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    config.ddpg.n_hidden = 4;
    config.rounds.final_greedy_share = 0.5;
    config.stop.max_env_steps = 100 * config.env_steps_per_round();
    let trainer = Trainer::new(config).expect("valid");
    let count = |rounds: Range<u64>| {
        let slots = rounds.flat_map(|round| trainer.training_orders(round, 0));
        let orders: Vec<EpisodeOrder> = slots.flat_map(|slot| slot.episodes).collect();
        let greedy = |order: &&EpisodeOrder| order.exploration == EpisodeExploration::Greedy;
        assert!(orders.iter().filter(greedy).all(|order| !order.advised));
        let n_without_advice = orders.iter().filter(|order| !order.advised).count();
        orders.iter().filter(greedy).count() as f64 / n_without_advice as f64
    };
    assert_eq!(count(0..25), 0.0, "the first quarter of the run");
    assert!((count(25..75) - 0.25).abs() < 0.02, "the share rises");
    assert!((count(75..100) - 0.5).abs() < 0.02, "half of them at the end");
}
