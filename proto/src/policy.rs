//! Conversions for `policy.proto`: a one-arm policy in another process.

use tandem_core::{Layout, Task, TaskSpec};

use crate::error::DecodeError;
use crate::numbers::{actions_from_bytes, finite_from_bytes, to_bytes};
use crate::pb;
use crate::task::decode_task;

/// The largest number of states of a request.
pub const MAX_POLICY_STATES: usize = 256;
/// The largest length of a name, in bytes.
const MAX_NAME: usize = 256;
/// The largest length of a digest, in characters.
const MAX_DIGEST: usize = 128;

/// A decoded description of a policy.
#[derive(Debug, Clone, PartialEq)]
pub struct PolicyDescription {
    /// The task, for one arm.
    pub task: TaskSpec,
    /// The policy's name, for logs.
    pub name: String,
    /// The text that identifies the policy.
    pub digest: String,
    /// True if the policy values actions.
    pub has_values: bool,
}

/// A policy's answers for `n` states.
#[derive(Debug, Clone, PartialEq)]
pub struct PolicyAnswers {
    /// The policy's actions, shape `[n, n_action]`.
    pub actions: Vec<f32>,
    /// The values of these actions, shape `[n]`; empty without values.
    pub values: Vec<f32>,
    /// The values of the proposed actions, shape `[n]`; empty without values.
    pub proposed_values: Vec<f32>,
}

/// Encodes a request to evaluate a policy with `digest` in `n` states.
///
/// Shapes: `observations` `[n, n_observation]`, `goals` `[n, n_goal]`, `proposed_actions` `[n, n_action]`.
#[must_use]
pub fn encode_policy_request(
    digest: &str,
    observations: &[f32],
    goals: &[f32],
    proposed_actions: &[f32],
) -> pb::EvaluatePolicyRequest {
    pb::EvaluatePolicyRequest {
        observations: to_bytes(observations),
        goals: to_bytes(goals),
        actions: to_bytes(proposed_actions),
        digest: digest.to_owned(),
    }
}

/// Decodes the description of a policy for one arm of a known task.
///
/// # Errors
/// Returns an error if the task is unknown, has several arms or other lengths, or a text is invalid.
pub fn decode_policy_description(
    message: pb::PolicyDescription,
) -> Result<PolicyDescription, DecodeError> {
    let task = message.task.ok_or_else(|| DecodeError::missing("task"))?;
    let task = decode_one_arm_task(task).map_err(|error| error.within("task"))?;
    let name = message.name;
    if name.len() > MAX_NAME || name.chars().any(char::is_control) {
        let expected = format_args!("at most {MAX_NAME} bytes of printable text").to_string();
        return Err(DecodeError::new("name", expected, name.escape_debug()));
    }
    let digest = message.digest;
    let is_valid = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.:".contains(&byte);
    if !(1..=MAX_DIGEST).contains(&digest.len()) || !digest.bytes().all(is_valid) {
        let expected = format_args!("1 to {MAX_DIGEST} letters, digits, '-', '_', '.' and ':'");
        return Err(DecodeError::new("digest", expected, digest.escape_debug()));
    }
    Ok(PolicyDescription { task, name, digest, has_values: message.has_values })
}

/// Decodes a task of one arm. The parts of the built-in tasks are known, so their descriptions need not contain them.
fn decode_one_arm_task(task: pb::TaskDescription) -> Result<TaskSpec, DecodeError> {
    if task.arms.len() != 1 {
        return Err(DecodeError::new("arms", "1 arm", task.arms.len()));
    }
    let Ok(known) = task.name.parse::<Task>() else {
        return decode_task(task);
    };
    let layout = Layout::new(known, 1);
    let lengths = [
        ("n_observation", task.n_observation, layout.n_observation()),
        ("n_goal", task.n_goal, layout.n_goal()),
        ("n_action", task.n_action, layout.n_action()),
    ];
    match lengths.into_iter().find(|(_, got, expected)| usize::try_from(*got) != Ok(*expected)) {
        None => Ok(layout.into()),
        Some((field, got, expected)) => {
            Err(DecodeError::new(field, format_args!("{expected} in task {known}"), got))
        }
    }
}

/// Decodes the answers of `policy` for `n` states.
///
/// # Errors
/// Returns an error if a length does not match, an action is outside [-1, 1], or a value is not finite.
pub fn decode_policy_answers(
    response: &pb::EvaluatePolicyResponse,
    n: usize,
    policy: &PolicyDescription,
) -> Result<PolicyAnswers, DecodeError> {
    let n_values = if policy.has_values { n } else { 0 };
    let actions = actions_from_bytes("actions", &response.actions, n * policy.task.n_action())?;
    Ok(PolicyAnswers {
        actions,
        values: finite_from_bytes("values", &response.values, n_values)?,
        proposed_values: finite_from_bytes("proposed_values", &response.proposed_values, n_values)?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn description() -> pb::PolicyDescription {
        let task = pb::TaskDescription {
            name: "push".to_owned(),
            n_observation: 28,
            n_goal: 3,
            n_action: 3,
            arms: vec![pb::TaskArm::default()],
            ..pb::TaskDescription::default()
        };
        pb::PolicyDescription {
            task: Some(task),
            name: "mine".to_owned(),
            digest: "sha256:0a".to_owned(),
            has_values: true,
        }
    }

    fn decoded() -> PolicyDescription {
        decode_policy_description(description()).unwrap()
    }

    #[test]
    fn a_description_that_does_not_fit_the_task_is_refused_with_its_field() {
        type Change = fn(&mut pb::PolicyDescription);
        let check = |change: Change, message: &str| {
            let mut changed = description();
            change(&mut changed);
            assert_eq!(decode_policy_description(changed).unwrap_err().to_string(), message);
        };
        assert_eq!(decoded().task, TaskSpec::built_in(Task::Push, 1));
        check(|policy| policy.task = None, "task: expected a message, got none");
        check(
            |policy| policy.task.as_mut().unwrap().name = "lift".to_owned(),
            "task.norm: expected 1 (Euclidean) or 2 (maximum), got 0",
        );
        check(
            |policy| policy.task.as_mut().unwrap().n_action = 4,
            "task.n_action: expected 3 in task push, got 4",
        );
        check(
            |policy| policy.task.as_mut().unwrap().arms.push(pb::TaskArm::default()),
            "task.arms: expected 1 arm, got 2",
        );
        check(
            |policy| policy.digest = "a b".to_owned(),
            "digest: expected 1 to 128 letters, digits, '-', '_', '.' and ':', got a b",
        );
        check(
            |policy| policy.name = "a\nb".to_owned(),
            "name: expected at most 256 bytes of printable text, got a\\nb",
        );
    }

    #[test]
    fn answers_have_the_length_of_the_request_and_no_invalid_number() {
        let response = |actions: &[f32], values: &[f32]| pb::EvaluatePolicyResponse {
            actions: to_bytes(actions),
            values: to_bytes(values),
            proposed_values: to_bytes(values),
        };
        let check = |actions: &[f32], values: &[f32], message: &str| {
            let refused = decode_policy_answers(&response(actions, values), 1, &decoded());
            assert_eq!(refused.unwrap_err().to_string(), message);
        };
        let answers = decode_policy_answers(&response(&[0.5; 6], &[2.0; 2]), 2, &decoded());
        assert_eq!(answers.unwrap().values, [2.0; 2]);
        check(&[0.5; 6], &[2.0], "actions: expected 3 numbers, got 6 numbers");
        check(&[0.5, 0.5, 1.5], &[2.0], "actions[2]: expected a number in [-1, 1], got 1.5");
        check(&[0.5; 3], &[f32::NAN], "values[0]: expected a finite number, got NaN");
        check(&[0.5; 3], &[], "values: expected 1 numbers, got 0 numbers");

        let without = PolicyDescription { has_values: false, ..decoded() };
        assert!(decode_policy_answers(&response(&[0.5; 3], &[]), 1, &without).is_ok());
        assert!(decode_policy_answers(&response(&[0.5; 3], &[2.0]), 1, &without).is_err());
    }
}
