//! Tests of tasks whose vectors do not concatenate the arms' numbers.

use tandem_core::TaskDescription;

use super::*;
use crate::fakes::{FakeActor, FakeEnvironment, FakeTeacher, LAYOUT, TEACHER_ACTION, slot, terms};

/// The task of the fakes with the arms' numbers interleaved in every vector.
fn interleaved() -> TaskSpec {
    let every_other = |arm_idx: usize, n: usize| (0..n).map(|i| 2 * i + arm_idx).collect();
    let mut description = LAYOUT.description();
    description.name = "interleaved".to_owned();
    description.observation_bound.fill(25.0);
    for (arm_idx, arm) in description.arms.iter_mut().enumerate() {
        arm.observation = every_other(arm_idx, 28);
        arm.goal = every_other(arm_idx, 3);
        arm.action = every_other(arm_idx, 3);
        arm.position = Vec::new();
    }
    TaskSpec::new(TaskDescription { episode_steps: 20, ..description }).expect("valid")
}

#[test]
fn a_teacher_sees_and_returns_numbers_in_arm_order() {
    let task = interleaved();
    let terms = RunTerms { task: task.clone(), ..terms() };
    let mut teacher = FakeTeacher::new(|_, _, arm| arm == 1);
    let (mut env, mut actor) = (FakeEnvironment::new(), FakeActor::Constant(0.5));
    let order = slot(&[3], true);
    let episode = play_slot(&mut env, &order, &terms, &mut actor, &mut teacher)
        .expect("no step fails")
        .remove(0);
    assert_eq!((episode.n_steps(), teacher.requests.len()), (20, 20));
    for (step_idx, request) in teacher.requests.iter().enumerate() {
        let observation = task.observation_in_arm_order(episode.observation(step_idx));
        assert_eq!(request[0].observation, observation);
        assert_eq!(request[0].goal, task.goal_in_arm_order(&episode.goal));
        let executed = task.action_in_arm_order(episode.action(step_idx));
        assert_eq!(executed[..3], request[0].proposed_action[..3]);
        assert_eq!(executed[3..], TEACHER_ACTION);
        let second = [1, 3, 5].map(|idx| episode.action(step_idx)[idx]);
        assert_eq!(second, TEACHER_ACTION);
    }
}
