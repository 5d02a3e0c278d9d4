//! Conversions between the teacher's types and messages.

use std::ops::Range;

use tandem_core::{StepQuery, Task};
use tandem_proto::{DecodeError, decode_query, layout_of_query, pb};

use crate::advisor::TeacherInfo;
use crate::budget::{Balance, Lease};
use crate::maps::ArmMap;
use crate::strategy::Strategy;

/// The largest number of steps in a request.
const MAX_STEPS: usize = 1024;
/// The largest number of episodes in a request.
const MAX_EPISODES: usize = 65_536;

/// Decodes the queries of students of `task`.
pub(super) fn decode_queries(
    steps: Vec<pb::StepQuery>,
    task: Task,
) -> Result<Vec<StepQuery>, DecodeError> {
    check_count("steps", steps.len(), MAX_STEPS)?;
    let decode_indexed = |(step_idx, query)| {
        layout_of_query(&query, task)
            .and_then(|layout| decode_query(query, layout))
            .map_err(|error| error.within(format_args!("steps[{step_idx}]")))
    };
    steps.into_iter().enumerate().map(decode_indexed).collect()
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
    let layout = info.layout;
    pb::DescribeResponse {
        task_description: None,
        task: layout.task.name().to_owned(),
        n_observation_per_arm: index(layout.n_observation()),
        n_goal_per_arm: index(layout.n_goal()),
        n_action_per_arm: index(layout.n_action()),
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
