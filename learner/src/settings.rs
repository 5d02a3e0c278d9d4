//! Settings that must not change when a run resumes.

use std::fmt;

use serde_json::Value;
use tandem_core::task::TaskDescription;
use tandem_core::text::shortened;
use tandem_rl::config::{RunConfig, former_keys};

/// Settings that may change when a run resumes: its limits, and what is saved, logged and tested. All others affect
/// learning.
const FREE: [&str; 5] = [
    "stop.",
    "checkpoint.",
    "evaluation.early_points",
    "evaluation.recorded_episodes",
    "evaluation.test_episodes",
];

/// Key of the task's description, whose fields are left out where they have their default.
const DESCRIPTION: &str = "description";

/// Longest value in a message; the parts of a task's description may be long.
const MAX_SHOWN_CHARS: usize = 80;

/// A setting that differs from the one that the run started with.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Changed {
    /// Its dotted name.
    pub key: String,
    /// The requested value.
    pub here: String,
    /// The value that the run started with.
    pub there: String,
}

impl fmt::Display for Changed {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { key, here, there } = self;
        write!(formatter, "{key} is {here} here and {there} in the run")
    }
}

/// Advice about a setting that differs.
pub const ADVICE: &str = "only stop.*, checkpoint.*, evaluation.early_points, evaluation.recorded_episodes and \
                          evaluation.test_episodes may change when a run is resumed: keep the original value, or \
                          start a new run";

/// Returns the settings as one JSON object, with the shortest form of each number.
#[must_use]
pub fn to_json(config: &RunConfig) -> String {
    serde_json::to_string(config).expect("numbers and names can be written")
}

/// Returns the first setting that affects learning and has another value in `config` than in `began_with`, a text
/// written by [`to_json`]. A setting that only one of the two has is skipped: programs of two versions may know
/// different settings. A setting that was added later has the value in effect before. `began_with` may use former keys.
/// The task's descriptions are compared as a whole; one that cannot be read differs.
///
/// # Errors
/// When `began_with` is not such a text.
pub fn first_change(
    config: &RunConfig,
    began_with: &str,
) -> Result<Option<Changed>, serde_json::Error> {
    let mut there: Value = serde_json::from_str(began_with)?;
    // Both pass through text: a value that was read has no more digits than it was written with.
    let mut here: Value = serde_json::from_str(&to_json(config))?;
    let described_here = take_description(&mut here);
    let described_there = take_description(&mut there);
    let settings = below(&here, String::new()).into_iter();
    let mut fixed = settings.filter(|(key, _)| !FREE.iter().any(|free| key.starts_with(free)));
    let changed = fixed.find_map(|(key, here)| {
        let under_former_key = || lookup(&there, former_keys::former(&key)?);
        let before_added = || serde_json::from_str(former_keys::before_added(&key)?).ok();
        let there = lookup(&there, &key).or_else(under_former_key).cloned();
        let there = there.or_else(before_added).filter(|there| *there != here)?.to_string();
        let shown = |value: &str| shortened(value, MAX_SHOWN_CHARS);
        Some(Changed { key, here: shown(&here.to_string()), there: shown(&there) })
    });
    Ok(changed
        .or_else(|| removed_setting(&there))
        .or_else(|| changed_description(&described_here, &described_there)))
}

/// A task's description, or the reason for which it cannot be read; `None` if the task is built-in.
type Description = Option<Result<TaskDescription, serde_json::Error>>;

/// Removes the task's description from `settings` and returns it.
fn take_description(settings: &mut Value) -> Description {
    settings.as_object_mut()?.remove(DESCRIPTION).map(serde_json::from_value)
}

/// Returns the first field in which two descriptions differ.
fn changed_description(here: &Description, there: &Description) -> Option<Changed> {
    let (field, here, there) = match (here, there) {
        (None, None) => return None,
        (Some(Ok(here)), Some(Ok(there))) => {
            let difference = here.difference(there)?;
            (format!(".{}", difference.field), difference.first, difference.second)
        }
        (here, there) => {
            let shown = |description: &Description| match description {
                None => "none".to_owned(),
                Some(Ok(description)) => format!("that of {:?}", description.name),
                Some(Err(error)) => format!("unreadable ({error})"),
            };
            (String::new(), shown(here), shown(there))
        }
    };
    Some(Changed { key: format!("{DESCRIPTION}{field}"), here, there })
}

/// Returns a setting that no longer exists and whose value was not 0.
fn removed_setting(there: &Value) -> Option<Changed> {
    former_keys::REMOVED.into_iter().find_map(|key| {
        let value = lookup(there, key)?.as_f64().filter(|value| *value != 0.0)?;
        Some(Changed { key: key.to_owned(), here: "0".to_owned(), there: value.to_string() })
    })
}

/// Returns the value of the setting with the dotted name `key`.
fn lookup<'a>(settings: &'a Value, key: &str) -> Option<&'a Value> {
    settings.pointer(&format!("/{}", key.replace('.', "/")))
}

/// Returns the dotted names and the values of all settings in `value`, which is called `name`.
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
    use tandem_core::{JudgedAction, Layout, Task};

    use super::*;
    use tandem_rl::config::Recipe;

    fn config() -> RunConfig {
        RunConfig::defaults(Recipe::Tandem, Task::Push, 2)
    }

    #[test]
    fn a_changed_setting_that_affects_learning_is_named_with_both_values() {
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
    fn limits_and_saving_may_change() {
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
    fn a_changed_description_is_named_even_if_the_field_had_its_default() {
        type Change = fn(&mut TaskDescription);
        let described = |change: Change| {
            let mut description = Layout::new(Task::Push, 2).description();
            description.contact_distances = Vec::new();
            change(&mut description);
            RunConfig { description: Some(description), ..config() }
        };
        let check = |here: &RunConfig, there: &RunConfig, expected: &str| {
            let found = first_change(here, &to_json(there)).expect("JSON").expect("it differs");
            assert_eq!(found.to_string(), expected);
        };
        let plain = described(|_| ());
        assert_eq!(first_change(&plain, &to_json(&plain)).expect("JSON"), None);
        let touching = described(|task| task.contact_distances = vec![0.1, 0.2, 0.3]);
        let key = "description.contact_distances";
        check(&touching, &plain, &format!("{key} is [0.1, 0.2, 0.3] here and [] in the run"));
        check(&plain, &touching, &format!("{key} is [] here and [0.1, 0.2, 0.3] in the run"));
        let changes: [(Change, &str); 2] = [
            (|task| task.manipulation.shared_object = true, "description.manipulation"),
            (|task| task.reflection.observation = vec![0], "description.reflection"),
        ];
        for (change, key) in changes {
            let changed = described(change);
            for (here, there) in [(&changed, &plain), (&plain, &changed)] {
                let found = first_change(here, &to_json(there)).expect("JSON");
                assert_eq!(found.expect("it differs").key, key);
            }
        }
        check(&plain, &config(), "description is that of \"push\" here and none in the run");
        check(&config(), &plain, "description is none here and that of \"push\" in the run");
        let unknown = to_json(&plain).replace("\"n_goal\"", "\"n_goals\"");
        let found = first_change(&plain, &unknown).expect("JSON").expect("it cannot be read");
        assert_eq!((found.key.as_str(), found.here.as_str()), ("description", "that of \"push\""));
        assert!(found.there.starts_with("unreadable (unknown field `n_goals`"), "{found}");
    }

    #[test]
    fn former_keys_are_compared_with_the_current_ones() {
        let former = to_json(&config())
            .replace("\"bc_weight\"", "\"cloning_weight\"")
            .replace("\"substeps\"", "\"wide_start_share\":0.0,\"substeps\"");
        assert_eq!(first_change(&config(), &former).expect("JSON"), None);
        let mut changed = config();
        changed.ddpg.bc_weight = 1.0;
        let found = first_change(&changed, &former).expect("JSON").expect("it differs");
        assert_eq!(found.to_string(), "ddpg.bc_weight is 1.0 here and 2.0 in the run");
        let wide = former.replace("\"wide_start_share\":0.0", "\"wide_start_share\":0.5");
        let found = first_change(&config(), &wide).expect("JSON").expect("it differs");
        assert_eq!(found.to_string(), "world.wide_start_share is 0 here and 0.5 in the run");
    }

    #[test]
    fn a_setting_added_later_is_compared_with_what_was_in_effect_before() {
        let former = to_json(&config()).replace("\"judged_action\"", "\"unknown\"");
        assert_eq!(first_change(&config(), &former).expect("JSON"), None);
        let mut changed = config();
        changed.advice.judged_action = JudgedAction::Policy;
        let found = first_change(&changed, &former).expect("JSON").expect("it differs");
        let expected = "advice.judged_action is \"policy\" here and \"executed\" in the run";
        assert_eq!(found.to_string(), expected);
    }

    #[test]
    fn settings_that_only_one_version_knows_are_skipped() {
        let text = to_json(&config()).replace("\"n_hidden\"", "\"n_units\"");
        assert_eq!(first_change(&config(), &text).expect("JSON"), None);
        assert!(first_change(&config(), "no JSON").is_err());
    }
}
