//! Conversions between the teacher's types and messages.

use std::ops::Range;

use tandem_core::{StepQuery, TaskSpec};
use tandem_proto::{DecodeError, decode_query, encode_task, pb};

use crate::advisor::TeacherInfo;
use crate::budget::{Balance, Lease};
use crate::maps::ArmMap;
use crate::strategy::Strategy;

/// The largest number of steps in a request.
const MAX_STEPS: usize = 1024;
/// The largest number of episodes in a request.
const MAX_EPISODES: usize = 65_536;

/// Decodes the queries of students; `students` are their tasks, with 1, 2, … arms.
pub(super) fn decode_queries(
    steps: Vec<pb::StepQuery>,
    students: &[TaskSpec],
) -> Result<Vec<StepQuery>, DecodeError> {
    check_count("steps", steps.len(), MAX_STEPS)?;
    let decode_indexed = |(step_idx, query)| {
        student_of(&query, students)
            .and_then(|student| decode_query(query, student))
            .map_err(|error| error.within(format_args!("steps[{step_idx}]")))
    };
    steps.into_iter().enumerate().map(decode_indexed).collect()
}

/// Returns the task of the student whose observation has the query's length.
fn student_of<'a>(
    query: &pb::StepQuery,
    students: &'a [TaskSpec],
) -> Result<&'a TaskSpec, DecodeError> {
    let (n_numbers, most) = (query.observation.len(), students.len());
    let n_per_arm = students.first().map_or(0, TaskSpec::n_observation);
    let of_length = |student: &&TaskSpec| student.n_observation() == n_numbers;
    students.iter().find(of_length).ok_or_else(|| {
        let expected = format_args!("{n_per_arm} numbers for each of 1 to {most} arms").to_string();
        DecodeError::new("observation", expected, format_args!("{n_numbers} numbers"))
    })
}

/// Refuses a request with more episodes than a round can have.
pub(super) fn check_episodes(episodes: &[u64]) -> Result<(), DecodeError> {
    check_count("episodes", episodes.len(), MAX_EPISODES)
}

fn check_count(field: &str, count: usize, max: usize) -> Result<(), DecodeError> {
    if count <= max {
        return Ok(());
    }
    Err(DecodeError::new(field, format_args!("at most {max}"), count))
}

pub(super) fn describe(info: &TeacherInfo) -> pb::DescribeResponse {
    let task = &info.task;
    pb::DescribeResponse {
        task_description: Some(encode_task(task)),
        task: task.name().to_owned(),
        n_observation_per_arm: index(task.n_observation()),
        n_goal_per_arm: index(task.n_goal()),
        n_action_per_arm: index(task.n_action()),
        arms: info.maps.arms().iter().map(encode_map).collect(),
        strategies: Strategy::names(info.has_values).into_iter().map(str::to_owned).collect(),
        policy_digest: info.digest.clone(),
    }
}

fn encode_map(map: &ArmMap) -> pb::ArmMap {
    let range = |range: &Range<usize>| {
        Some(pb::IndexRange { start: index(range.start), end: index(range.end) })
    };
    pb::ArmMap {
        observation: range(&map.observation),
        goal: range(&map.goal),
        action: range(&map.action),
    }
}

fn index(index: usize) -> u32 {
    u32::try_from(index).expect("vectors have a few hundred numbers")
}

pub(super) fn encode_balance(name: String, balance: &Balance) -> pb::Account {
    pb::Account {
        name,
        budget: balance.terms.budget,
        strategy: balance.terms.strategy.to_string(),
        spent: balance.spent,
        leased: balance.leased,
        left: balance.left,
        warning: String::new(),
    }
}

pub(super) const fn encode_lease(lease: &Lease) -> pb::Lease {
    pb::Lease { episode: lease.episode, units: lease.units, early_units: lease.early_units }
}
