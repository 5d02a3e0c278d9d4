//! The summary of a run: the JSON object that `tandem train` writes to `summary.json` at the end.

use serde_json::Value;

/// Name of the file in the run directory.
pub const FILE: &str = "summary.json";

/// The progress of a run, where known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RunLength {
    /// Number of environment steps after which the run ends, from its configuration; 0 for a run that ends otherwise.
    pub max_env_steps: Option<u64>,
    /// Environment steps that the run has made at least.
    pub env_steps: Option<u64>,
}

/// Returns true if `summary` is that of the run as it is now.
///
/// A learner that extends a run without `tandem train`, and an extension that is interrupted at once, leave the summary
/// of the shorter run. A summary of an earlier version that lacks its length counts as current.
#[must_use]
pub fn is_current(summary: &Value, run: RunLength) -> bool {
    let of_summary = |key: &str| summary.get(key).and_then(Value::as_u64);
    let lengths = of_summary("max_env_steps").zip(run.max_env_steps);
    let env_steps = of_summary("env_steps").zip(run.env_steps);
    lengths.is_none_or(|(summary, run)| summary == run)
        && env_steps.is_none_or(|(summary, run)| summary >= run)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_summary_is_that_of_a_run_of_the_same_length_and_not_of_an_earlier_part() {
        let check = |summary: Value, max_env_steps, env_steps, expected| {
            let run = RunLength { max_env_steps, env_steps };
            assert_eq!(is_current(&summary, run), expected, "{summary}, {run:?}");
        };
        let summary = || json!({"max_env_steps": 2400, "env_steps": 2400});
        check(summary(), Some(2400), Some(2400), true);
        check(summary(), Some(2400), Some(1600), true);
        check(summary(), None, None, true);
        check(summary(), Some(4800), Some(2400), false);
        check(summary(), Some(1200), None, false);
        // A run that the clock or its success has ended.
        let by_clock = || json!({"max_env_steps": 0, "env_steps": 1600});
        check(by_clock(), Some(0), Some(1600), true);
        check(by_clock(), Some(0), Some(2400), false);
        check(json!({"digest": "5f3a"}), Some(2400), Some(2400), true);
    }
}
