use tandem_core::layout::{EPISODE_STEPS, Layout};
use tandem_core::reward::sparse_reward;
use tandem_core::rng::{Stream, episode_rng};
use tandem_core::task::ArmDescription;
use tandem_core::{Contacts, Episode, Task};

use super::*;
use crate::config::{Recipe, RunConfig};
use crate::replay::fixtures::drifting_episode;

mod contacts;

const LAYOUT: Layout = Layout::new(Task::Push, 2);
const N_DRAWS: usize = 4000;

fn config(reward: RewardKind) -> ReplayConfig {
    ReplayConfig {
        capacity_transitions: 1000,
        her_ratio: 0.8,
        displaced_hindsight: false,
        displaced_fraction: 0.5,
        coda_fraction: 0.0,
        coda_contact_prob: 0.0,
        arm_swap_prob: 0.5,
        reflection_prob: 0.0,
        reward,
        joint_goal_statistics: false,
        goal_tolerance_m: 0.05,
        contact_cost: 0.0,
        contact_cost_growth: 1.0,
        contact_foresight_steps: 0,
    }
}

/// Arm 0's object drifts; goals are far away; every action component is its own index plus the step.
fn episode() -> Episode {
    let mut episode = drifting_episode(LAYOUT, 0, 0.01);
    episode.goal.fill(9.0);
    for (component, value) in episode.actions.iter_mut().enumerate() {
        *value = component as f32;
    }
    episode.advised_arms.fill(0b01);
    episode
}

fn sampled(reward: RewardKind, check: impl Fn(&Sampler, &ReplayBuffer)) {
    let mut buffer = ReplayBuffer::new(LAYOUT, 1000);
    buffer.push(&episode());
    buffer.push(&drifting_episode(LAYOUT, 1, 0.0));
    let mut sampler = Sampler::new(&config(reward), LAYOUT);
    let mut rng = episode_rng(1, 0, Stream::Replay);
    for _ in 0..N_DRAWS {
        sampler.sample_transition(&buffer, &mut rng);
        check(&sampler, &buffer);
    }
}

#[test]
fn a_hindsight_goal_was_achieved_later_in_the_episode() {
    sampled(RewardKind::PerArm, |sampler, buffer| {
        let drawn = &sampler.sample;
        let x = drawn.goal[0];
        if drawn.steps[0].episode_idx == 0 && x < 9.0 {
            assert!(
                x > buffer.achieved(0, drawn.steps[0].step_idx, ArmIndex(0))[0] + 0.005,
                "not later: {drawn:?}"
            );
        }
    });
}

#[test]
fn all_later_steps_are_equally_likely_hindsight_goals() {
    // All goals of hindsight, those of the later half, of the next step and of the last one.
    let counts = std::cell::Cell::new([0_u32; 4]);
    sampled(RewardKind::PerArm, |sampler, _| {
        let (x, first) = (sampler.sample.goal[0], sampler.sample.steps[0]);
        if first.episode_idx != 0 || x >= 9.0 || first.step_idx > EPISODE_STEPS - 10 {
            return;
        }
        let step = first.step_idx;
        let is_goal = |later: &usize| (x - 0.01 * *later as f32).abs() < 0.005;
        let goal = (step + 1..=EPISODE_STEPS).find(is_goal).expect("a later step");
        let is_late = 2 * (goal - step) > EPISODE_STEPS - step + 1;
        let is = [true, is_late, goal == step + 1, goal == EPISODE_STEPS];
        let mut now = counts.get();
        now.iter_mut().zip(is).for_each(|(count, is)| *count += u32::from(is));
        counts.set(now);
    });
    let [all, late, next, last] = counts.get();
    assert!((0.43..0.55).contains(&(f64::from(late) / f64::from(all))), "{late} of {all}");
    assert!(next > 0 && last > 0 && next + last < all / 2, "{next} and {last} of {all}");
}

#[test]
fn rewards_match_the_sampled_goal() {
    sampled(RewardKind::PerArm, |sampler, buffer| {
        for arm in LAYOUT.arms() {
            let achieved = buffer.achieved(
                sampler.sample.steps[0].episode_idx,
                sampler.sample.steps[0].step_idx + 1,
                arm,
            );
            let goal = &sampler.sample.goal[LAYOUT.goal_of(arm)];
            assert_eq!(sampler.sample.rewards[arm.0], sparse_reward(&achieved, goal));
        }
    });
    sampled(RewardKind::Joint, |sampler, buffer| {
        let observation = buffer
            .observation(sampler.sample.steps[0].episode_idx, sampler.sample.steps[0].step_idx + 1);
        let achieved: Vec<f32> = tandem_core::reward::achieved_goal(LAYOUT, observation).collect();
        assert_eq!(sampler.sample.rewards[0], sparse_reward(&achieved, &sampler.sample.goal));
    });
}

#[test]
fn fractions_are_as_configured() {
    let count = |reward, holds: fn(&SampledTransition) -> bool| {
        let hits = std::cell::Cell::new(0_usize);
        sampled(reward, |sampler, _| hits.set(hits.get() + usize::from(holds(&sampler.sample))));
        hits.get() as f64 / N_DRAWS as f64
    };
    let near = |share: f64, expected: f64| {
        assert!((share - expected).abs() < 0.03, "{share} is not {expected}");
    };
    near(count(RewardKind::PerArm, |drawn| drawn.swapped), 0.5);
    near(count(RewardKind::PerArm, |drawn| drawn.steps[0].episode_idx == 0), 0.75);
    near(
        count(RewardKind::PerArm, |drawn| drawn.steps[0].episode_idx == 0 && drawn.goal[0] < 9.0),
        0.6,
    );
    let one_arm_only = |drawn: &SampledTransition| {
        drawn.steps[0].episode_idx == 0 && (drawn.goal[0] < 9.0) != (drawn.goal[3] < 9.0)
    };
    near(count(RewardKind::PerArm, one_arm_only), 0.75 * 2.0 * 0.8 * 0.2);
    near(count(RewardKind::Joint, one_arm_only), 0.0);
}

#[test]
fn swapped_rows_exchange_all_data_of_the_arms() {
    let mut buffer = ReplayBuffer::new(LAYOUT, 1000);
    buffer.push(&episode());
    let mut sampler = Sampler::new(&config(RewardKind::PerArm), LAYOUT);
    let identity = |n: usize| NormalizerSnapshot { mean: vec![0.0; n], std: vec![10.0; n] };
    let (observation, goal) = (identity(LAYOUT.n_observation()), identity(LAYOUT.n_goal()));
    let mut batch = Batch::new(LAYOUT, 2, 64);
    let statistics = Statistics { observation: &observation, goal: &goal };
    sampler.fill(&buffer, statistics, &mut episode_rng(3, 0, Stream::Replay), &mut batch);
    let mut n_swapped = 0;
    for row in 0..64 {
        let (actions, cloned) =
            (&batch.actions[row * 6..row * 6 + 6], &batch.bc_mask[row * 6..row * 6 + 6]);
        let swapped = actions[0] > actions[3];
        n_swapped += usize::from(swapped);
        let advised_half =
            if swapped { [0.0, 0.0, 0.0, 1.0, 1.0, 1.0] } else { [1.0, 1.0, 1.0, 0.0, 0.0, 0.0] };
        assert_eq!(cloned, advised_half);
        let input = &batch.inputs[row * 62..row * 62 + 62];
        let drifting_x = if swapped { input[31] } else { input[3] };
        let still_x = if swapped { input[3] } else { input[31] };
        assert!(still_x == 0.0 && drifting_x >= 0.0);
        let steps = actions[if swapped { 3 } else { 0 }] / 6.0;
        assert!(
            (drifting_x * 10.0 - steps * 0.01).abs() < 1e-5,
            "observation and action of different steps"
        );
    }
    assert!((10..54).contains(&n_swapped));
}

/// For 64 seeds, a row of a batch from an episode of the shared world, and whether it is reflected.
fn reflected_rows(
    n_arms: usize,
    reflection_prob: f32,
    change: impl Fn(&mut Episode),
) -> Vec<(bool, Batch)> {
    let task = TaskSpec::built_in(Task::SharedPickAndPlace, n_arms);
    reflected_rows_of(&task, reflection_prob, change)
}

/// As [`reflected_rows`], for another description of the task.
fn reflected_rows_of(
    task: &TaskSpec,
    reflection_prob: f32,
    change: impl Fn(&mut Episode),
) -> Vec<(bool, Batch)> {
    let n_arms = task.n_arms();
    let mut episode = drifting_episode(task, 0, 0.01);
    for (idx, value) in episode.observations.iter_mut().enumerate() {
        *value += (idx % task.n_observation()) as f32 * 1e-4;
    }
    change(&mut episode);
    let mut buffer = ReplayBuffer::new(task, 1000);
    buffer.push(&episode);
    let config = ReplayConfig { reflection_prob, arm_swap_prob: 0.0, ..config(RewardKind::PerArm) };
    let mut sampler = Sampler::new(&config, task);
    let identity = |n: usize| NormalizerSnapshot { mean: vec![0.0; n], std: vec![1.0; n] };
    let (observation, goal) = (identity(task.n_observation()), identity(task.n_goal()));
    let statistics = Statistics { observation: &observation, goal: &goal };
    (0..64)
        .map(|row| {
            let mut batch = Batch::new(task, n_arms, 1);
            let mut rng = episode_rng(3, row, Stream::Replay);
            sampler.fill(&buffer, statistics, &mut rng, &mut batch);
            (sampler.sample.reflected, batch)
        })
        .collect()
}

/// With every probability above 0, reflections draw the same random numbers, so rows can be compared one by one.
#[test]
fn reflected_rows_are_the_mirror_images_of_the_same_rows() {
    for n_arms in [1, 2] {
        // Arms that stay behind their bases are apart.
        let behind = |episode: &mut Episode| {
            for (idx, value) in episode.observations.iter_mut().enumerate() {
                let is_x = [0, 3].contains(&(idx % 28));
                *value -= if is_x { 0.5 } else { 0.0 };
            }
        };
        let spec = TaskSpec::built_in(Task::SharedPickAndPlace, n_arms);
        let (half, all) =
            (reflected_rows(n_arms, 0.5, behind), reflected_rows(n_arms, 1.0, behind));
        let n_reflected = half.iter().filter(|(reflected, _)| *reflected).count();
        assert!((16..48).contains(&n_reflected), "{n_reflected} of 64");
        let n = spec.n_observation();
        for ((reflected, half), (_, all)) in half.into_iter().zip(all) {
            let (mut inputs, mut actions) = (half.inputs.clone(), half.actions.clone());
            for arm in spec.arms().filter(|_| !reflected) {
                spec.reflect_observation(arm, arm, &half.inputs[..n], &mut inputs[..n]);
                spec.reflect_goal(arm, arm, &half.inputs[n..], &mut inputs[n..]);
                spec.reflect_action(arm, arm, &half.actions, &mut actions);
            }
            assert_eq!((inputs, actions), (all.inputs, all.actions));
            assert_eq!((half.rewards, half.bc_mask), (all.rewards, all.bc_mask));
        }
    }
}

#[test]
fn arms_that_are_near_each_other_are_reflected_with_the_whole_scene_only() {
    let none = |rows: Vec<(bool, Batch)>| rows.iter().all(|(reflected, _)| !reflected);
    let mut of_arms = TaskSpec::built_in(Task::SharedPickAndPlace, 2).description().clone();
    "described-pick-and-place".clone_into(&mut of_arms.name);
    of_arms.reflection.whole_scene = false;
    let of_arms = TaskSpec::new(of_arms).unwrap();
    // Hands and objects 16 cm in front of their origins, which are 24 cm apart.
    let in_front = |episode: &mut Episode| {
        for (idx, value) in episode.observations.iter_mut().enumerate() {
            *value += if [0, 3].contains(&(idx % 28)) { 0.16 } else { 0.0 };
        }
    };
    assert!(none(reflected_rows_of(&of_arms, 1.0, in_front)));
    assert!(reflected_rows(2, 1.0, in_front).iter().all(|(reflected, _)| *reflected));
    assert!(none(reflected_rows(1, 0.0, |_| ())));
}

#[test]
fn three_arms_are_reflected_with_the_whole_scene() {
    let mut three = TaskSpec::built_in(Task::SharedPickAndPlace, 1).description().clone();
    "three-arms".clone_into(&mut three.name);
    three.reflection.whole_scene = true;
    let (n_observation, n_goal, n_action) = (three.n_observation, three.n_goal, three.n_action);
    (three.n_observation, three.n_goal, three.n_action) =
        (3 * n_observation, 3 * n_goal, 3 * n_action);
    three.observation_bound = three.observation_bound.repeat(3);
    three.goal_bound = three.goal_bound.repeat(3);
    let (first, achieved) = (three.arms.remove(0), std::mem::take(&mut three.achieved_goal));
    let after = |indices: &[usize], n: usize| indices.iter().map(|idx| idx + n).collect::<Vec<_>>();
    for arm in 0..3 {
        three.achieved_goal.extend(after(&achieved, arm * n_observation));
        three.arms.push(ArmDescription {
            observation: after(&first.observation, arm * n_observation),
            goal: after(&first.goal, arm * n_goal),
            action: after(&first.action, arm * n_action),
            ..ArmDescription::default()
        });
    }
    let three = TaskSpec::new(three).unwrap();
    assert!(reflected_rows_of(&three, 1.0, |_| ()).iter().all(|(reflected, _)| *reflected));
}

/// A batch of 256 rows from `buffer`, its numbers as they are.
fn filled(change: impl FnOnce(&mut ReplayConfig), buffer: &ReplayBuffer) -> Batch {
    let mut config = config(RewardKind::PerArm);
    change(&mut config);
    let mut sampler = Sampler::new(&config, LAYOUT);
    let identity = |n: usize| NormalizerSnapshot { mean: vec![0.0; n], std: vec![1.0; n] };
    let (observation, goal) = (identity(LAYOUT.n_observation()), identity(LAYOUT.n_goal()));
    let mut batch = Batch::new(LAYOUT, 2, 256);
    let statistics = Statistics { observation: &observation, goal: &goal };
    sampler.fill(buffer, statistics, &mut episode_rng(3, 0, Stream::Replay), &mut batch);
    batch
}

#[test]
fn an_intervention_costs_the_step_before_it_unless_the_goal_is_one_of_hindsight() {
    let mut buffer = ReplayBuffer::new(LAYOUT, 1000);
    let mut advised = drifting_episode(LAYOUT, 0, 0.0);
    advised.goal.fill(9.0);
    advised.advised_arms[10..20].fill(0b01);
    advised.advised_arms[15..30].fill(0b11);
    buffer.push(&advised);
    // Arm 0 leads to an intervention on step 9, arm 1 on step 14.
    let led_to = |step: StepIndex, arm: usize| step.step_idx == [9, 14][arm];
    for reward in [RewardKind::PerArm, RewardKind::Joint] {
        let mut sampler = Sampler::new(&config(reward), LAYOUT);
        sampler.set_intervention_cost(1.0);
        let mut rng = episode_rng(1, 0, Stream::Replay);
        let mut n_costs = 0;
        for _ in 0..N_DRAWS {
            sampler.sample_transition(&buffer, &mut rng);
            let drawn = &sampler.sample;
            for (head, got) in drawn.rewards.iter().enumerate() {
                let arms = if reward == RewardKind::PerArm { head..head + 1 } else { 0..2 };
                let is_desired = |arm: usize| drawn.goal[LAYOUT.goal_of(ArmIndex(arm))][0] == 9.0;
                let achieved = !arms.clone().any(is_desired);
                let cost = arms.clone().any(|arm| is_desired(arm) && led_to(drawn.steps[arm], arm));
                n_costs += u32::from(cost);
                let expected = if achieved { 0.0 } else { -1.0 } - if cost { 1.0 } else { 0.0 };
                assert_eq!(*got, expected, "{reward:?}: {drawn:?}");
            }
        }
        assert!(n_costs > 10, "{reward:?}: {n_costs}");
    }
}

/// Both handles of a bar drift from their starts, 0 and 1 m along x.
#[test]
fn arms_that_share_an_object_get_the_goals_of_one_later_step_after_which_it_has_moved() {
    let task = TaskSpec::built_in(Task::CarryBar, 2);
    let mut episode = Episode::zeros(&task, 0);
    episode.goal.fill(9.0);
    for (step_idx, observation) in
        episode.observations.chunks_exact_mut(task.n_observation()).enumerate()
    {
        for arm in task.arms() {
            let x = task.achieved_goal_of(arm).index(0);
            observation[x] = arm.0 as f32 + 0.01 * step_idx as f32;
        }
    }
    let mut still = Episode::zeros(&task, 1);
    still.goal.fill(9.0);
    let mut buffer = ReplayBuffer::new(&task, 1000);
    buffer.push(&episode);
    buffer.push(&still);
    let config = RunConfig::defaults(Recipe::Tandem, Task::CarryBar, 2).replay;
    let mut sampler = Sampler::new(&config, &task);
    let mut rng = episode_rng(1, 0, Stream::Replay);
    let mut n_hindsight = 0;
    for _ in 0..N_DRAWS {
        sampler.sample_transition(&buffer, &mut rng);
        let SampledTransition { steps, goal, keeps_goal, .. } = &sampler.sample;
        assert_eq!((steps[0], keeps_goal[0]), (steps[1], keeps_goal[1]));
        if keeps_goal[0] {
            assert_eq!(*goal, [9.0; 6]);
            continue;
        }
        n_hindsight += 1;
        assert_eq!(steps[0].episode_idx, 0, "the other bar has not moved");
        assert!(goal[0] > 0.05 && goal[0] > 0.01 * steps[0].step_idx as f32, "{goal:?}");
        assert!((goal[3] - goal[0] - 1.0).abs() < 1e-6, "goals of two steps: {goal:?}");
    }
    assert!(n_hindsight > N_DRAWS / 3, "{n_hindsight}");
}

#[test]
fn arms_of_different_steps_are_combined_where_they_cannot_meet() {
    let mut touching = drifting_episode(LAYOUT, 1, 0.0);
    touching.contacts.fill(Contacts::ARM_ARM);
    let mut buffer = ReplayBuffer::new(LAYOUT, 1000);
    buffer.push(&episode());
    buffer.push(&touching);
    let mut config = config(RewardKind::PerArm);
    config.coda_fraction = 1.0;
    let mut sampler = Sampler::new(&config, LAYOUT);
    let mut rng = episode_rng(1, 0, Stream::Replay);
    let (mut n_combined, mut largest_x) = (0, 0.0_f32);
    for _ in 0..N_DRAWS {
        sampler.sample_transition(&buffer, &mut rng);
        let [first, second] = sampler.sample.steps[..] else { panic!("two arms") };
        if first == second {
            continue;
        }
        n_combined += 1;
        assert_eq!((first.episode_idx, second.episode_idx), (0, 0), "one of them touches");
        largest_x = largest_x.max(buffer.achieved(0, first.step_idx + 1, ArmIndex(0))[0]);
        let goal = sampler.sample.goal[LAYOUT.goal_of(ArmIndex(0))][0];
        assert!(goal > buffer.achieved(0, first.step_idx, ArmIndex(0))[0], "another's future");
    }
    assert!(n_combined > N_DRAWS / 10);
    assert!((largest_x - 0.14).abs() < 0.005, "0.24 m apart, {largest_x} m towards the other");
}

/// The task of [`LAYOUT`] with the arms' numbers interleaved in every vector: number `i` of arm `a` has index `2 i + a`.
fn interleaved() -> TaskSpec {
    let every_other = |arm_idx: usize, n: usize| (0..n).map(|i| 2 * i + arm_idx).collect();
    let mut description = LAYOUT.description();
    description.name = "interleaved".to_owned();
    for (arm_idx, arm) in description.arms.iter_mut().enumerate() {
        arm.observation = every_other(arm_idx, 28);
        arm.goal = every_other(arm_idx, 3);
        arm.action = every_other(arm_idx, 3);
        arm.position = vec![arm_idx, 6 + arm_idx];
    }
    description.achieved_goal = (6..12).collect();
    description.observation_bound = (0..56).map(|_| 100.0).collect();
    TaskSpec::new(description).expect("valid")
}

/// Interleaves the halves of every row of two-arm vectors.
fn interleave(rows: &[f32], n_row: usize) -> Vec<f32> {
    let index = |i: usize| i / n_row * n_row + (i % n_row) / 2 + (i % 2) * (n_row / 2);
    (0..rows.len()).map(|i| rows[index(i)]).collect()
}

#[test]
fn the_order_of_the_numbers_in_a_vector_changes_no_batch() {
    let task = interleaved();
    let mut original = episode();
    for (idx, number) in original.observations.iter_mut().enumerate() {
        *number += 0.001 * (idx % 56) as f32;
    }
    original.goal = vec![0.1, 0.2, 0.3, 0.4, 0.5, 0.6];
    let rearranged = Episode {
        task: task.clone(),
        observations: interleave(&original.observations, 56),
        goal: interleave(&original.goal, 6),
        actions: interleave(&original.actions, 6),
        ..original.clone()
    };
    let batch_of = |episode: &Episode, reward| {
        let mut buffer = ReplayBuffer::new(&episode.task, 1000);
        buffer.push(episode);
        let config = ReplayConfig { coda_fraction: 0.5, ..config(reward) };
        let identity = |n| NormalizerSnapshot { mean: vec![0.0; n], std: vec![1.0; n] };
        let (observation, goal) = (identity(56), identity(6));
        let statistics = Statistics { observation: &observation, goal: &goal };
        let mut batch = Batch::new(&episode.task, reward.n_heads(&episode.task), 200);
        let mut rng = episode_rng(3, 0, Stream::Replay);
        Sampler::new(&config, &episode.task).fill(&buffer, statistics, &mut rng, &mut batch);
        batch
    };
    for reward in [RewardKind::PerArm, RewardKind::Joint] {
        let (first, second) = (batch_of(&original, reward), batch_of(&rearranged, reward));
        assert_eq!(first.rewards, second.rewards);
        assert_eq!(interleave(&first.actions, 6), second.actions);
        assert_eq!(interleave(&first.bc_mask, 6), second.bc_mask);
        for (first, second) in
            [(&first.inputs, &second.inputs), (&first.next_inputs, &second.next_inputs)]
        {
            for (first, second) in first.chunks_exact(62).zip(second.chunks_exact(62)) {
                assert_eq!(interleave(&first[..56], 56), second[..56]);
                assert_eq!(interleave(&first[56..], 6), second[56..]);
            }
        }
    }
}
