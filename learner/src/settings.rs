//! Settings that a run keeps, and which of them differ.

use std::fmt;

use serde_json::Value;

use tandem_rl::config::RunConfig;

/// What a run may go on with another value of: when it ends, what is saved and what is logged. Everything else decides
/// what it learns.
const FREE: [&str; 4] =
    ["stop.", "checkpoint.", "evaluation.recorded_episodes", "evaluation.test_episodes"];

/// A setting with which a run cannot go on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Changed {
    /// Its dotted name.
    pub key: String,
    /// The value that was asked for.
    pub here: String,
    /// The value that the run began with.
    pub there: String,
}

impl fmt::Display for Changed {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { key, here, there } = self;
        write!(formatter, "{key} is {here} here and {there} in the run")
    }
}

/// What to do about a setting that differs.
pub const ADVICE: &str = "only stop.*, checkpoint.*, evaluation.recorded_episodes and evaluation.test_episodes may \
                          change when a run is resumed: keep the original value, or start a new run";

/// The settings as one JSON object, numbers as a person writes them.
#[must_use]
pub fn to_json(config: &RunConfig) -> String {
    serde_json::to_string(config).expect("numbers and names can be written")
}

/// The first setting that decides what a run learns and has another value in `config` than in `began_with`, a text by
/// [`to_json`]. What only one of the two has is passed over: programs of two versions may know different settings.
///
/// # Errors
/// When `began_with` is no such text.
pub fn first_change(
    config: &RunConfig,
    began_with: &str,
) -> Result<Option<Changed>, serde_json::Error> {
    let there: Value = serde_json::from_str(began_with)?;
    // Both take the way through text: a value that was read has no more digits than it was written with.
    let here: Value = serde_json::from_str(&to_json(config))?;
    let settings = below(&here, String::new()).into_iter();
    let mut fixed = settings.filter(|(key, _)| !FREE.iter().any(|free| key.starts_with(free)));
    Ok(fixed.find_map(|(key, here)| {
        let pointer = format!("/{}", key.replace('.', "/"));
        let there = there.pointer(&pointer).filter(|there| **there != here)?;
        Some(Changed { key, here: here.to_string(), there: there.to_string() })
    }))
}

/// Dotted names and values of all settings in and below `value`, which is called `name`.
fn below(value: &Value, name: String) -> Vec<(String, Value)> {
    let Value::Object(section) = value else { return vec![(name, value.clone())] };
    let dotted = |key: &String| match name.as_str() {
        "" => key.clone(),
        name => format!("{name}.{key}"),
    };
    section.iter().flat_map(|(key, value)| below(value, dotted(key))).collect()
}

#[cfg(test)]
mod tests {
    use tandem_core::Task;

    use super::*;
    use tandem_rl::config::Recipe;

    fn config() -> RunConfig {
        RunConfig::defaults(Recipe::Tandem, Task::Push, 2)
    }

    #[test]
    fn a_setting_that_decides_what_is_learned_is_named_with_both_values() {
        let check = |change: fn(&mut RunConfig), expected: &str| {
            let mut changed = config();
            change(&mut changed);
            let found = first_change(&changed, &to_json(&config())).expect("JSON");
            assert_eq!(found.expect("it differs").to_string(), expected);
        };
        check(|c| c.ddpg.n_hidden = 64, "ddpg.n_hidden is 64 here and 256 in the run");
        check(|c| c.ddpg.discount = 0.9, "ddpg.discount is 0.9 here and 0.95 in the run");
        check(|c| c.seed = 7, "seed is 7 here and 1 in the run");
        check(|c| c.advice.budget = 9, "advice.budget is 9 here and 500000 in the run");
        check(
            |c| "ea".clone_into(&mut c.advice.strategy),
            "advice.strategy is \"ea\" here and \"mc-q:0.1\" in the run",
        );
        check(|c| c.evaluation.episodes = 8, "evaluation.episodes is 8 here and 240 in the run");
    }

    #[test]
    fn when_a_run_ends_and_what_is_kept_of_it_may_change() {
        let mut changed = config();
        changed.stop.max_env_steps += 1;
        changed.stop.until_success = 0.5;
        changed.stop.max_minutes = 3.5;
        changed.checkpoint.every_rounds = 7;
        changed.checkpoint.keep = 9;
        changed.evaluation.recorded_episodes = 0;
        changed.evaluation.test_episodes = 1;
        assert_eq!(first_change(&changed, &to_json(&config())).expect("JSON"), None);
    }

    #[test]
    fn settings_that_only_one_version_knows_are_passed_over() {
        let text = to_json(&config()).replace("\"n_hidden\"", "\"n_units\"");
        assert_eq!(first_change(&config(), &text).expect("JSON"), None);
        assert!(first_change(&config(), "no JSON").is_err());
    }
}
