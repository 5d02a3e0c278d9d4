//! Conversions for `task.proto`: descriptions of tasks.

use tandem_core::TaskSpec;
use tandem_core::task::{
    ArmDescription, ArmManipulation, Condition, InvalidTask, Manipulation, Norm, Reflection,
    TaskDescription,
};

use crate::error::DecodeError;
use crate::pb;

impl From<InvalidTask> for DecodeError {
    fn from(InvalidTask { field, expected, got }: InvalidTask) -> Self {
        Self { field, expected, got }
    }
}

/// Encodes a task.
#[must_use]
pub fn encode_task(task: &TaskSpec) -> pb::TaskDescription {
    let task = task.description();
    pb::TaskDescription {
        name: task.name.clone(),
        n_observation: to_u32(task.n_observation),
        n_goal: to_u32(task.n_goal),
        n_action: to_u32(task.n_action),
        arms: task.arms.iter().map(encode_arm).collect(),
        achieved_goal: encode_indices(&task.achieved_goal),
        episode_steps: to_u32(task.episode_steps),
        tolerance: task.tolerance,
        norm: encode_norm(task.norm).into(),
        interchangeable_arms: task.interchangeable_arms,
        reports_contacts: task.reports_contacts,
        observation_bound: task.observation_bound.clone(),
        goal_bound: task.goal_bound.clone(),
        origin_distance: task.origin_distance,
        recombination_gap: task.recombination_gap,
        base: task.base,
        contact_distances: task.contact_distances.clone(),
        manipulation: encode_manipulation(&task.manipulation),
        reflection: encode_reflection(&task.reflection),
    }
}

/// Decodes a task.
///
/// # Errors
/// Returns an error if the norm is unknown, or the description is inconsistent or exceeds a limit; see
/// [`TaskSpec::new`].
pub fn decode_task(task: pb::TaskDescription) -> Result<TaskSpec, DecodeError> {
    let description = TaskDescription {
        name: task.name,
        n_observation: to_usize(task.n_observation),
        n_goal: to_usize(task.n_goal),
        n_action: to_usize(task.n_action),
        arms: task.arms.into_iter().map(decode_arm).collect(),
        achieved_goal: decode_indices(&task.achieved_goal),
        episode_steps: to_usize(task.episode_steps),
        tolerance: task.tolerance,
        norm: decode_norm(task.norm)?,
        interchangeable_arms: task.interchangeable_arms,
        reports_contacts: task.reports_contacts,
        origin_distance: task.origin_distance,
        recombination_gap: task.recombination_gap,
        base: task.base,
        contact_distances: task.contact_distances,
        observation_bound: task.observation_bound,
        goal_bound: task.goal_bound,
        manipulation: task.manipulation.map_or_else(Manipulation::default, decode_manipulation),
        reflection: task.reflection.map_or_else(Reflection::default, decode_reflection),
    };
    Ok(TaskSpec::new(description)?)
}

fn encode_arm(arm: &ArmDescription) -> pb::TaskArm {
    pb::TaskArm {
        observation: encode_indices(&arm.observation),
        goal: encode_indices(&arm.goal),
        action: encode_indices(&arm.action),
        position: encode_indices(&arm.position),
        lateral: encode_indices(&arm.lateral),
        hand: encode_indices(&arm.hand),
    }
}

#[expect(clippy::needless_pass_by_value, reason = "decoders consume their message")]
fn decode_arm(arm: pb::TaskArm) -> ArmDescription {
    ArmDescription {
        observation: decode_indices(&arm.observation),
        goal: decode_indices(&arm.goal),
        action: decode_indices(&arm.action),
        position: decode_indices(&arm.position),
        lateral: decode_indices(&arm.lateral),
        hand: decode_indices(&arm.hand),
    }
}

/// A message without it means the default.
fn encode_manipulation(manipulation: &Manipulation) -> Option<pb::TaskManipulation> {
    let is_default = *manipulation == Manipulation::default();
    let encode = |arm: &ArmManipulation| pb::ArmManipulation {
        gripper: arm.gripper.map(to_u32),
        holding: arm.holding.iter().map(encode_condition).collect(),
        conditions: arm.conditions.iter().map(encode_condition).collect(),
    };
    (!is_default).then(|| pb::TaskManipulation {
        shared_object: manipulation.shared_object,
        one_arm_task: manipulation.one_arm_task.clone(),
        success_steps: to_u32(manipulation.success_steps),
        arms: manipulation.arms.iter().map(encode).collect(),
    })
}

fn decode_manipulation(manipulation: pb::TaskManipulation) -> Manipulation {
    let decode = |arm: pb::ArmManipulation| ArmManipulation {
        gripper: arm.gripper.map(to_usize),
        holding: arm.holding.into_iter().map(decode_condition).collect(),
        conditions: arm.conditions.into_iter().map(decode_condition).collect(),
    };
    Manipulation {
        shared_object: manipulation.shared_object,
        one_arm_task: manipulation.one_arm_task,
        success_steps: to_usize(manipulation.success_steps).max(1),
        arms: manipulation.arms.into_iter().map(decode).collect(),
    }
}

/// A message without it means none.
fn encode_reflection(reflection: &Reflection) -> Option<pb::Reflection> {
    let moved = |[to, from]: &[usize; 2]| pb::MovedNumber { to: to_u32(*to), from: to_u32(*from) };
    (!reflection.is_none()).then(|| pb::Reflection {
        observation: encode_indices(&reflection.observation),
        goal: encode_indices(&reflection.goal),
        action: encode_indices(&reflection.action),
        moved: reflection.moved.iter().map(moved).collect(),
        position: encode_indices(&reflection.position),
        plane: reflection.plane,
        whole_scene: reflection.whole_scene,
    })
}

#[expect(clippy::needless_pass_by_value, reason = "decoders consume their message")]
fn decode_reflection(reflection: pb::Reflection) -> Reflection {
    let moved = |pb::MovedNumber { to, from }: &pb::MovedNumber| [to_usize(*to), to_usize(*from)];
    Reflection {
        observation: decode_indices(&reflection.observation),
        goal: decode_indices(&reflection.goal),
        action: decode_indices(&reflection.action),
        moved: reflection.moved.iter().map(moved).collect(),
        position: decode_indices(&reflection.position),
        plane: reflection.plane,
        whole_scene: reflection.whole_scene,
    }
}

fn encode_condition(condition: &Condition) -> pb::Condition {
    pb::Condition {
        numbers: encode_indices(&condition.numbers),
        target: condition.target.clone(),
        tolerance: condition.tolerance,
    }
}

fn decode_condition(condition: pb::Condition) -> Condition {
    Condition {
        numbers: decode_indices(&condition.numbers),
        target: condition.target,
        tolerance: condition.tolerance,
    }
}

const fn encode_norm(norm: Norm) -> pb::Norm {
    match norm {
        Norm::Euclidean => pb::Norm::Euclidean,
        Norm::Maximum => pb::Norm::Maximum,
    }
}

fn decode_norm(norm: i32) -> Result<Norm, DecodeError> {
    match pb::Norm::try_from(norm) {
        Ok(pb::Norm::Euclidean) => Ok(Norm::Euclidean),
        Ok(pb::Norm::Maximum) => Ok(Norm::Maximum),
        Ok(pb::Norm::Unspecified) | Err(_) => {
            Err(DecodeError::new("norm", "1 (Euclidean) or 2 (maximum)", norm))
        }
    }
}

fn encode_indices(indices: &[usize]) -> Vec<u32> {
    indices.iter().map(|idx| to_u32(*idx)).collect()
}

fn decode_indices(indices: &[u32]) -> Vec<usize> {
    indices.iter().map(|idx| to_usize(*idx)).collect()
}

fn to_u32(count: usize) -> u32 {
    u32::try_from(count).expect("the counts of a checked task are small")
}

fn to_usize(count: u32) -> usize {
    usize::try_from(count).expect("indices have 32 bits or more")
}

#[cfg(test)]
mod tests {
    use prost::Message as _;
    use tandem_core::{Layout, Task};

    use super::*;

    fn interleaved() -> TaskSpec {
        let arm = |first: usize| ArmDescription {
            observation: vec![first, first + 2],
            goal: vec![1 - first],
            action: vec![1 - first],
            position: vec![first],
            lateral: Vec::new(),
            hand: vec![first, first + 2, first],
        };
        TaskSpec::new(TaskDescription {
            name: "lab/reach-1".to_owned(),
            n_observation: 4,
            n_goal: 2,
            n_action: 2,
            arms: vec![arm(0), arm(1)],
            achieved_goal: vec![1, 0],
            episode_steps: 20,
            tolerance: 0.1,
            norm: Norm::Maximum,
            interchangeable_arms: true,
            reports_contacts: false,
            origin_distance: 1.0,
            recombination_gap: 0.2,
            base: -0.5,
            contact_distances: vec![0.1, 0.2, 0.3],
            observation_bound: vec![2.0, 2.5, 3.0, 3.5],
            goal_bound: vec![1.0, 1.5],
            manipulation: Manipulation::default(),
            reflection: Reflection {
                observation: vec![0],
                goal: vec![0],
                action: vec![],
                moved: vec![[0, 1], [1, 0]],
                position: vec![1],
                plane: 0.5,
                whole_scene: true,
            },
        })
        .unwrap()
    }

    /// Arms that share an object, each of which holds it while its first number is near 0.5.
    fn shared() -> TaskSpec {
        let holds = |arm: usize| ArmManipulation {
            gripper: Some(1 - arm),
            holding: vec![Condition { numbers: vec![arm], target: vec![0.5], tolerance: 0.1 }],
            conditions: vec![Condition { numbers: vec![arm + 2], target: vec![], tolerance: 0.2 }],
        };
        let mut description = interleaved().description().clone();
        description.arms.iter_mut().for_each(|arm| arm.position.clear());
        description.manipulation = Manipulation {
            shared_object: true,
            one_arm_task: "lab/hold".to_owned(),
            success_steps: 3,
            arms: vec![holds(0), holds(1)],
        };
        TaskSpec::new(description).unwrap()
    }

    #[test]
    fn every_task_round_trips() {
        for task in [interleaved(), shared(), Layout::new(Task::Push, 2).into()] {
            let bytes = encode_task(&task).encode_to_vec();
            let message = pb::TaskDescription::decode(bytes.as_slice()).unwrap();
            assert_eq!(decode_task(message), Ok(task));
        }
    }

    #[test]
    fn a_malformed_task_is_refused_by_name() {
        let check = |corrupt: fn(&mut pb::TaskDescription), message: &str| {
            let mut malformed = encode_task(&interleaved());
            corrupt(&mut malformed);
            assert_eq!(decode_task(malformed).unwrap_err().to_string(), message);
        };
        check(|t| t.norm = 0, "norm: expected 1 (Euclidean) or 2 (maximum), got 0");
        check(|t| t.n_action = u32::MAX, "n_action: expected 1 to 4096, got 4294967295");
        check(|t| t.arms[1].goal[0] = 9, "arms[1].goal[0]: expected 0 to 1, got 9");
        check(|t| t.arms = vec![t.arms[0].clone(); 9], "number of arms: expected 1 to 8, got 9");
        check(|t| t.tolerance = 0.0, "tolerance: expected a finite number above 0, got 0");
        check(|t| t.observation_bound[2] = f32::INFINITY, {
            "observation_bound[2]: expected a finite number above 0, got inf"
        });
    }
}
