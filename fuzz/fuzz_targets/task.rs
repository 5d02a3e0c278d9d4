//! Descriptions of tasks: a message is refused by field, or gives a task whose parts can be used.
#![no_main]

use libfuzzer_sys::fuzz_target;
use prost::Message as _;
use tandem_core::TaskSpec;
use tandem_core::task::MAX_ARMS;
use tandem_fuzz::with_bounded_memory;
use tandem_proto::{decode_task, encode_task, pb};

/// Maximum length of an error message, which is sent in an HTTP/2 header.
const MAX_REFUSAL_BYTES: usize = 400;

fuzz_target!(|bytes: &[u8]| {
    let Ok(message) = pb::TaskDescription::decode(bytes) else { return };
    match with_bounded_memory(|| decode_task(message)) {
        Ok(task) => check(&task),
        Err(refusal) => {
            let text = refusal.to_string();
            assert!(!refusal.field.is_empty() && text.len() < MAX_REFUSAL_BYTES, "{text}");
        }
    }
});

/// Checks that every part of a task can be used.
fn check(task: &TaskSpec) {
    let again = decode_task(encode_task(task)).expect("an encoded task can be decoded");
    assert!(again == *task && task.difference(&again).is_none());
    let numbers = |n: usize| (0_u16..).map(f32::from).take(n).collect::<Vec<f32>>();
    let (observation, goal) = (numbers(task.n_observation()), numbers(task.n_goal()));
    let is_success = task.is_success(&observation, &goal);
    assert_eq!(is_success, task.arms().all(|arm| task.arm_succeeds(arm, &observation, &goal)));
    let achieved: Vec<f32> = task.achieved_goal(&observation).collect();
    assert_eq!(achieved.len(), task.n_goal());
    assert_eq!(task.sparse_reward(&achieved, &achieved), 0.0);
    // Every number of an action belongs to exactly one arm.
    let action = numbers(task.n_action());
    let mut restored = vec![f32::NAN; task.n_action()];
    task.write_action_in_arm_order(&task.action_in_arm_order(&action), &mut restored);
    assert_eq!(restored, action);
    if let Some(one_arm) = task.single_arm() {
        check_single(task, &one_arm);
    }
}

/// Checks the task of one arm against the parts of `task`.
fn check_single(task: &TaskSpec, one_arm: &TaskSpec) {
    assert_eq!(one_arm.n_arms(), 1);
    assert!(task.common_observation().is_empty() && task.common_goal().is_empty());
    for arm in task.arms() {
        assert_eq!(task.observation_of(arm).len(), one_arm.n_observation());
        assert_eq!(task.goal_of(arm).len(), one_arm.n_goal());
        assert_eq!(task.action_of(arm).len(), one_arm.n_action());
    }
    for n_arms in [2, MAX_ARMS] {
        // Refused if its vectors are too long.
        let Ok(several) = one_arm.concatenated(n_arms) else { continue };
        assert_eq!(several.n_arms(), n_arms);
        let again = several.single_arm().expect("concatenated arms have no common numbers");
        assert_eq!(again.n_observation(), one_arm.n_observation());
    }
}
