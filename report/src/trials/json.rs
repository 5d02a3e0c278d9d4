//! Export of trials as JSON.

use serde_json::{Map, Value, json as value};
use tandem_core::{Task, Wilson};

use super::{CAUSES, OTHER_CAUSES, TrialGroup, Trials};
use crate::paper::{N_PAPER_TRIALS, PaperTrials, TABLE_4};

/// Returns trials as one JSON object: `groups`, each with its statistics and its failures. Durations are in seconds.
///
/// The key `subject` is the name of the policy.
#[must_use]
pub fn json(trials: &Trials) -> Value {
    value!({ "groups": trials.groups.iter().map(group_json).collect::<Vec<_>>() })
}

fn group_json(group: &TrialGroup) -> Value {
    let Wilson { low, high } = group.interval();
    let n_successes = group.n_successes();
    let causes = CAUSES.into_iter().chain([OTHER_CAUSES]).zip(group.n_failed_by());
    let causes: Map<String, Value> =
        causes.map(|(cause, n)| (cause.to_owned(), value!(n))).collect();
    let failures = group.failed().map(|row| {
        value!({
            "trial": row.trial, "seed": row.seed, "cause": row.cause, "detail": row.detail,
            "goal_distances_m": row.goal_distances_m, "log": row.log,
        })
    });
    value!({
        "task": group.task,
        "subject": group.policy,
        "mode": group.mode,
        "trials": group.rows.len(),
        "successes": n_successes,
        "success": n_successes as f64 / group.rows.len().max(1) as f64,
        "success_low": low,
        "success_high": high,
        "failed_by": causes,
        "median_duration_s": group.median_duration_s(),
        "median_success_duration_s": group.median_success_duration_s(),
        "failures": failures.collect::<Vec<_>>(),
        "paper": paper_json(&group.task),
    })
}

/// Returns the paper's successes with two arms; `null` for a task that the paper does not have.
fn paper_json(task: &str) -> Value {
    let Some(task) = Task::ALL.into_iter().find(|known| known.name() == task) else {
        return Value::Null;
    };
    let row = |row: &PaperTrials| {
        let successes = row.n_successes(task)?;
        Some(value!({ "method": row.name, "successes": successes, "trials": N_PAPER_TRIALS }))
    };
    TABLE_4.iter().map(row).collect::<Option<Vec<Value>>>().map_or(Value::Null, Value::from)
}
