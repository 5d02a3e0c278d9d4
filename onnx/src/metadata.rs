//! Entries of a model's metadata (`metadata_props`).
//!
//! They say what the vectors of a model mean, so that a program can use a model without other documents.

use std::collections::BTreeMap;
use std::ops::Range;

use serde_json::{Value, json};
use tandem_core::{ArmIndex, Layout, Wilson};
use tandem_policy::Policy;

/// Name of the task.
pub const TASK: &str = "task";
/// Number of arms.
pub const N_ARMS: &str = "n_arms";
/// Description of the task as JSON, if the task is not built-in: the fields of
/// [`TaskDescription`](tandem_core::TaskDescription).
pub const TASK_DESCRIPTION: &str = "task_description";
/// Digest of the policy that was exported; see `docs/policy-format.md`.
pub const POLICY_DIGEST: &str = "policy_digest";
/// Start of the keys of the policy's own metadata.
pub const TRAINING: &str = "training.";

const FRAME: &str = "each arm's own frame: origin on the table ahead of its base, x away from the base, z up; the \
    numbers of several arms are concatenated in arm order";

/// A part of one arm's observation: first index, name and unit. It ends where the next one starts.
type Part = (usize, &'static str, &'static str);

const OBSERVATION: [Part; 9] = [
    (0, "end_effector_position", "m"),
    (3, "object_position", "m"),
    (6, "object_position_minus_end_effector_position", "m"),
    (9, "finger_openings", "m"),
    (12, "object_orientation_quaternion_xyzw", "1"),
    (16, "object_velocity_minus_end_effector_velocity", "m per control step"),
    (19, "object_angular_velocity", "rad per control step"),
    (22, "end_effector_velocity", "m per control step"),
    (25, "finger_opening_rates", "m per control step"),
];
const GOAL: [Part; 1] = [(0, "object_target_position", "m")];
const ACTION: [Part; 2] =
    [(0, "end_effector_displacement", "5 cm per control step"), (3, "gripper_opening", "1")];

/// Returns the entries that describe `policy`.
#[must_use]
pub fn of(policy: &Policy) -> BTreeMap<String, String> {
    let task = &policy.task;
    let mut entries: BTreeMap<&str, String> = BTreeMap::from([
        (TASK, task.name().to_owned()),
        (N_ARMS, task.n_arms().to_string()),
        (POLICY_DIGEST, policy.digest()),
        ("value", value_text(policy.n_heads)),
    ]);
    match task.as_built_in() {
        Some(layout) => entries.extend(of_vectors(layout)),
        None => drop(entries.insert(TASK_DESCRIPTION, json!(task.description()).to_string())),
    }
    let mut entries: BTreeMap<String, String> =
        entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
    entries.extend(success(&policy.metadata));
    let training = policy.metadata.iter();
    entries.extend(training.map(|(key, value)| (format!("{TRAINING}{key}"), value.clone())));
    entries
}

/// Returns the entries about the vectors of a built-in task.
fn of_vectors(layout: Layout) -> [(&'static str, String); 5] {
    let parts = |parts: &[Part], of: &dyn Fn(ArmIndex) -> Range<usize>| {
        let of_arm = |arm: ArmIndex| described(parts, arm, of(arm));
        Value::from(layout.arms().flat_map(of_arm).collect::<Vec<_>>()).to_string()
    };
    [
        ("observation", parts(&OBSERVATION, &|arm| layout.observation_of(arm))),
        ("goal", parts(&GOAL, &|arm| layout.goal_of(arm))),
        ("action", parts(&ACTION, &|arm| layout.action_of(arm))),
        ("frame", FRAME.to_owned()),
        ("control_step_s", layout.task.world().control_step_s().to_string()),
    ]
}

/// Describes the parts of one arm's `range` of a vector.
fn described(parts: &[Part], arm: ArmIndex, range: Range<usize>) -> Vec<Value> {
    let ends = parts.iter().skip(1).map(|(first, ..)| *first).chain([usize::MAX]);
    let described = parts.iter().zip(ends).map(|((first, name, unit), end)| {
        let (start, end) = (range.start + first, range.start.saturating_add(end).min(range.end));
        json!({ "arm": arm.0, "name": name, "unit": unit, "start": start, "end": end })
    });
    described.filter(|part| part["start"].as_u64() < part["end"].as_u64()).collect()
}

fn value_text(n_heads: usize) -> String {
    let of = if n_heads == 1 { "of the joint reward" } else { "of each arm's reward" };
    format!(
        "expected discounted sum {of} in training: -1 for each step that misses the goal by more than the tolerance of \
         training, otherwise 0, less the costs that training charges, such as those of contacts"
    )
}

/// Returns the success rate of the evaluation that chose the policy, with its 95 % interval (Wilson), if the policy's
/// metadata has it.
fn success(training: &BTreeMap<String, String>) -> Vec<(String, String)> {
    let number = |key: &str| training.get(key)?.parse::<f64>().ok();
    let measured = number("evaluation_success").zip(number("evaluation_episodes"));
    let Some((success, n_episodes)) =
        measured.filter(|(success, n)| (0.0..=1.0).contains(success) && (1.0..=1e9).contains(n))
    else {
        return Vec::new();
    };
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "from 0 to 1e9")]
    let interval = Wilson::of((success * n_episodes).round() as usize, n_episodes as usize);
    let entries = [
        ("success_rate", success.to_string()),
        ("success_rate_low", interval.low.to_string()),
        ("success_rate_high", interval.high.to_string()),
        ("success_episodes", n_episodes.to_string()),
    ];
    entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
}
