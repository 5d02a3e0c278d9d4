//! Conversions for `teacher.proto`: queries to a teacher and its advice.

use tandem_core::bounds::MAX_MAGNITUDE;
use tandem_core::{ArmAdvice, ArmIndex, StepAdvice, StepQuery, TaskSpec};

use crate::error::DecodeError;
use crate::numbers::{actions, bounded, one_finite, one_within};
use crate::pb;

/// Largest length of an account's name, bytes.
const MAX_NAME_BYTES: usize = 256;

/// Checks the name of an account, from field `field`.
///
/// # Errors
/// Returns an error if the name is empty or longer than 256 bytes.
pub fn decode_account_name(field: &str, name: String) -> Result<String, DecodeError> {
    match name.len() {
        1..=MAX_NAME_BYTES => Ok(name),
        n_bytes => {
            Err(DecodeError::new(field, format_args!("1 to {MAX_NAME_BYTES} bytes"), n_bytes))
        }
    }
}

/// Encodes a query.
#[must_use]
pub fn encode_query(query: &StepQuery) -> pb::StepQuery {
    pb::StepQuery {
        episode: query.episode,
        step: query.step,
        observation: query.observation.clone(),
        goal: query.goal.clone(),
        proposed_action: query.proposed_action.clone(),
        judged_action: query.judged_action.clone().unwrap_or_default(),
        payer: query.payer,
    }
}

/// Decodes the query of a student of `task`.
///
/// Any step number is valid; the teacher's account limits the length of an episode.
///
/// # Errors
/// Returns an error if a vector has the wrong length, a number is not finite or beyond both [`MAX_MAGNITUDE`] and the
/// task's bound, or an action is outside [−1, 1].
pub fn decode_query(
    query: pb::StepQuery,
    task: impl Into<TaskSpec>,
) -> Result<StepQuery, DecodeError> {
    let task = task.into();
    // Students may be trained by other programs in other worlds, so the bound is that of a task only if it is larger.
    let largest = |idx| MAX_MAGNITUDE.max(task.observation_bound(idx));
    let largest_goal = |idx| MAX_MAGNITUDE.max(task.goal_bound(idx));
    let judged = (!query.judged_action.is_empty()).then_some(query.judged_action);
    let decode_judged = |judged| actions("judged_action", judged, task.n_action());
    Ok(StepQuery {
        episode: query.episode,
        step: query.step,
        observation: bounded("observation", query.observation, task.n_observation(), largest)?,
        goal: bounded("goal", query.goal, task.n_goal(), largest_goal)?,
        proposed_action: actions("proposed_action", query.proposed_action, task.n_action())?,
        judged_action: judged.map(decode_judged).transpose()?,
        payer: query.payer,
    })
}

/// Encodes advice.
#[must_use]
pub fn encode_advice(advice: &StepAdvice) -> pb::StepAdvice {
    pb::StepAdvice {
        action: advice.action.clone(),
        charged: advice.charged,
        arms: advice.arms.iter().map(encode_arm).collect(),
        repeated: advice.repeated,
    }
}

fn encode_arm(arm: &ArmAdvice) -> pb::ArmAdvice {
    pb::ArmAdvice {
        teacher_action: arm.teacher_action.clone(),
        q_teacher: arm.q_teacher,
        q_student: arm.q_student,
        importance: arm.importance,
        distance: arm.distance,
        overridden: arm.overridden,
    }
}

/// Decodes advice to a student of `task`.
///
/// # Errors
/// Returns an error if a length does not match the task, a number is not finite, an action is outside [−1, 1] or a
/// distance is negative.
pub fn decode_advice(
    advice: pb::StepAdvice,
    task: impl Into<TaskSpec>,
) -> Result<StepAdvice, DecodeError> {
    let task = task.into();
    if advice.arms.len() != task.n_arms() {
        let expected = format_args!("{} arms", task.n_arms()).to_string();
        return Err(DecodeError::new("arms", expected, format_args!("{} arms", advice.arms.len())));
    }
    let decode_indexed = |(arm_idx, arm)| {
        decode_arm(arm, &task)
            .map_err(|error: DecodeError| error.within(format_args!("arms[{arm_idx}]")))
    };
    Ok(StepAdvice {
        action: actions("action", advice.action, task.n_action())?,
        charged: advice.charged,
        arms: advice.arms.into_iter().enumerate().map(decode_indexed).collect::<Result<_, _>>()?,
        repeated: advice.repeated,
    })
}

fn decode_arm(arm: pb::ArmAdvice, task: &TaskSpec) -> Result<ArmAdvice, DecodeError> {
    Ok(ArmAdvice {
        teacher_action: actions(
            "teacher_action",
            arm.teacher_action,
            task.action_of(ArmIndex(0)).len(),
        )?,
        q_teacher: one_finite("q_teacher", arm.q_teacher)?,
        q_student: one_finite("q_student", arm.q_student)?,
        importance: one_finite("importance", arm.importance)?,
        distance: one_within("distance", arm.distance, &(0.0..=f32::INFINITY))?,
        overridden: arm.overridden,
    })
}

#[cfg(test)]
mod tests {
    use prost::Message as _;
    use tandem_core::{Layout, Task};

    use super::*;

    const LAYOUT: Layout = Layout::new(Task::PickAndPlace, 2);

    fn query() -> StepQuery {
        StepQuery {
            episode: u64::MAX,
            step: 49,
            observation: (0_u8..56).map(|i| f32::from(i) / 7.0).collect(),
            goal: vec![0.1, -0.2, 0.3, 0.4, 0.5, -0.6],
            proposed_action: vec![-1.0, 1.0, 0.0, 0.25, 0.5, -0.5, 0.75, -0.75],
            judged_action: Some(vec![0.5; 8]),
            payer: Some(0),
        }
    }

    fn advice() -> StepAdvice {
        let arm = |teacher_action: [f32; 4], overridden| ArmAdvice {
            teacher_action: teacher_action.to_vec(),
            q_teacher: -1.5,
            q_student: -2.0,
            importance: 0.5,
            distance: 0.75,
            overridden,
        };
        StepAdvice {
            action: vec![0.1, 0.2, 0.3, 0.4, -0.5, -0.6, -0.7, -0.8],
            charged: true,
            arms: vec![arm([0.0, 0.1, 0.2, 0.3], false), arm([-0.5, -0.6, -0.7, -0.8], true)],
            repeated: true,
        }
    }

    /// Encodes and decodes a message.
    fn sent<M: prost::Message + Default>(message: &M) -> M {
        M::decode(message.encode_to_vec().as_slice()).unwrap()
    }

    #[test]
    fn a_query_round_trips() {
        let unjudged = StepQuery { judged_action: None, payer: None, ..query() };
        for query in [query(), unjudged] {
            assert_eq!(decode_query(sent(&encode_query(&query)), LAYOUT), Ok(query));
        }
    }

    #[test]
    fn advice_round_trips() {
        assert_eq!(decode_advice(sent(&encode_advice(&advice())), LAYOUT), Ok(advice()));
    }

    #[test]
    fn a_malformed_query_is_refused_by_name() {
        let check = |corrupt: fn(&mut pb::StepQuery), message: &str| {
            let mut malformed = encode_query(&query());
            corrupt(&mut malformed);
            assert_eq!(decode_query(malformed, LAYOUT).unwrap_err().to_string(), message);
        };
        check(|q| q.observation.truncate(55), "observation: expected 56 numbers, got 55 numbers");
        check(|q| q.goal.push(0.0), "goal: expected 6 numbers, got 7 numbers");
        check(|q| q.proposed_action.clear(), "proposed_action: expected 8 numbers, got 0 numbers");
        check(
            |q| q.observation[17] = f32::NAN,
            "observation[17]: expected a finite number, got NaN",
        );
        check(
            |q| q.observation[3] = -1e4,
            "observation[3]: expected a number in [-1000, 1000], got -1e4",
        );
        check(|q| q.goal[1] = 1001.0, "goal[1]: expected a number in [-1000, 1000], got 1.001e3");
        check(|q| q.goal[0] = f32::INFINITY, "goal[0]: expected a finite number, got inf");
        check(
            |q| q.proposed_action[7] = -1.25,
            "proposed_action[7]: expected a number in [-1, 1], got -1.25",
        );
        check(|q| q.judged_action.truncate(7), "judged_action: expected 8 numbers, got 7 numbers");
    }

    #[test]
    fn malformed_advice_is_refused_by_name() {
        let check = |corrupt: fn(&mut pb::StepAdvice), message: &str| {
            let mut malformed = encode_advice(&advice());
            corrupt(&mut malformed);
            assert_eq!(decode_advice(malformed, LAYOUT).unwrap_err().to_string(), message);
        };
        check(|a| a.arms.truncate(1), "arms: expected 2 arms, got 1 arms");
        check(|a| a.action[3] = 1.5, "action[3]: expected a number in [-1, 1], got 1.5");
        check(
            |a| a.arms[1].teacher_action.truncate(3),
            "arms[1].teacher_action: expected 4 numbers, got 3 numbers",
        );
        check(
            |a| a.arms[0].q_teacher = f32::NAN,
            "arms[0].q_teacher: expected a finite number, got NaN",
        );
        check(
            |a| a.arms[0].importance = f32::INFINITY,
            "arms[0].importance: expected a finite number, got inf",
        );
        check(
            |a| a.arms[1].distance = -0.5,
            "arms[1].distance: expected a finite number, 0 or more, got -0.5",
        );
    }

    #[test]
    fn the_name_of_an_account_has_1_to_256_bytes() {
        assert_eq!(decode_account_name("name", "run-7".to_owned()), Ok("run-7".to_owned()));
        assert!(decode_account_name("name", String::new()).is_err());
        assert!(decode_account_name("name", "x".repeat(257)).is_err());
    }

    /// An `AdviseRequest` as encoded by the first version of the protocol.
    const STORED_REQUEST: &str = "\
        0a0572756e2d3712930108ac0210071a70000000000000803e0000003f0000403f0000803f0000a03f0000c03f0000e03f00\
        00004000001040000020400000304000004040000050400000604000007040000080400000884000009040000098400000a0\
        400000a8400000b0400000b8400000c0400000c8400000d0400000d840220c0000003f000080be000000002a0c0000803f00\
        0080bf0000003e";

    #[test]
    fn old_bytes_still_decode() {
        let bytes: Vec<u8> = (0..STORED_REQUEST.len())
            .step_by(2)
            .map(|at| u8::from_str_radix(&STORED_REQUEST[at..at + 2], 16).unwrap())
            .collect();
        let request = pb::AdviseRequest::decode(bytes.as_slice()).unwrap();
        assert_eq!(request.account, "run-7");
        let expected = StepQuery {
            episode: 300,
            step: 7,
            observation: (0_u8..28).map(|i| f32::from(i) / 4.0).collect(),
            goal: vec![0.5, -0.25, 0.0],
            proposed_action: vec![1.0, -1.0, 0.125],
            judged_action: None,
            payer: None,
        };
        assert_eq!(
            decode_query(request.steps[0].clone(), Layout::new(Task::Push, 1)),
            Ok(expected)
        );
        assert_eq!(request.encode_to_vec(), bytes);
    }
}
