//! Evaluations on test goals: a run's `summary.json`, or the output of `tandem eval --json`.

use std::path::Path;

use serde_json::Value;
use tandem_core::Wilson;
use tandem_telemetry::ContactMetrics;

use crate::error::Error;
use crate::files::{read_error, read_text};
use crate::run_summary::{self, RunLength};

/// The evaluation of a policy on test goals, which no run uses to select its best policy.
#[derive(Debug, Clone, PartialEq)]
pub struct TestEvaluation {
    /// Name of the policy's task.
    pub task: String,
    /// Number of arms.
    pub n_arms: usize,
    /// Number of episodes, one per goal.
    pub n_episodes: u64,
    /// Success rate: share of episodes with every object at its goal, in [0, 1].
    pub success: f64,
    /// The 95 % interval of `success`.
    pub interval: Wilson,
    /// Share of episodes with the joint norm within the tolerance, in [0, 1].
    pub success_joint: f64,
    /// For each arm, the share of episodes with its own object at its goal. Empty if it is unknown.
    pub success_per_arm: Vec<f64>,
    /// Share of episodes with at least one contact between the arms, or between an arm and the table. `None` for a task
    /// that reports no contacts.
    pub collision_rate: Option<f64>,
    /// Measures that distinguish contacts between arms from contacts with the table, where known.
    pub contacts: ContactMetrics,
}

impl TestEvaluation {
    /// Reads the JSON object on the last line of `path`: the evaluation of a policy, and those of its baselines with their
    /// names.
    ///
    /// # Errors
    /// If the file cannot be read, or its last line is not the result of an evaluation.
    pub fn load(path: &Path) -> Result<(Self, Vec<(String, Self)>), Error> {
        let text = read_text(path).map_err(read_error(path))?;
        Self::parse(&text)
            .map_err(|problem| Error::InvalidEvaluation { path: path.to_owned(), problem })
    }

    /// Parses the JSON object on the last line of `text`. The error names the field.
    fn parse(text: &str) -> Result<(Self, Vec<(String, Self)>), String> {
        let object = last_object(text)?;
        let baselines = object.get("baselines").and_then(Value::as_array);
        let baselines = baselines.into_iter().flatten().map(|baseline| {
            let name = baseline["name"].as_str().ok_or("a baseline has no \"name\"")?;
            Ok((name.to_owned(), Self::of(baseline)?))
        });
        Ok((Self::of(&object)?, baselines.collect::<Result<_, String>>()?))
    }

    fn of(object: &Value) -> Result<Self, String> {
        let number = |key: &str| {
            share(&object[key]).ok_or_else(|| format!("{key:?} is not a share from 0 to 1"))
        };
        let count =
            |key: &str| object[key].as_u64().ok_or_else(|| format!("{key:?} is not a count"));
        let task = object["task"].as_str().ok_or("\"task\" is not a name")?;
        Ok(Self {
            task: task.to_owned(),
            n_arms: usize::try_from(count("arms")?).map_err(|error| error.to_string())?,
            n_episodes: count("episodes")?,
            success: number("success")?,
            interval: Wilson { low: number("success_low")?, high: number("success_high")? },
            success_joint: number("success_joint")?,
            success_per_arm: shares(&object["success_per_arm"])
                .ok_or("\"success_per_arm\" is not a list of shares from 0 to 1")?,
            collision_rate: match object.get("collision_rate") {
                // Of a task that reports no contacts.
                Some(Value::Null) => None,
                _ => Some(number("collision_rate")?),
            },
            contacts: serde_json::from_value(object.clone())
                .map_err(|error| format!("a measure of contacts is not a number ({error})"))?,
        })
    }
}

fn share(value: &Value) -> Option<f64> {
    value.as_f64().filter(|share| (0.0..=1.0).contains(share))
}

/// Returns the shares in a list, which is empty if it is missing.
fn shares(value: &Value) -> Option<Vec<f64>> {
    match value {
        Value::Null => Some(Vec::new()),
        value => value.as_array()?.iter().map(share).collect(),
    }
}

/// The parts of a run's `summary.json` that reports use.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct RunSummary {
    /// Digest of the learner's state at the end. `None` in a summary of another program than `tandem train`.
    pub(crate) digest: Option<String>,
    /// The test of the best policy. `None` for a run without test goals, whose summary has no success.
    pub(crate) test: Option<TestEvaluation>,
}

impl RunSummary {
    /// Reads the summary of a run that is as far as `run`; `None` if it is not [current](run_summary::is_current).
    ///
    /// # Errors
    /// If the file cannot be read, or its last line is not a summary.
    pub(crate) fn load(path: &Path, run: RunLength) -> Result<Option<Self>, Error> {
        let text = read_text(path).map_err(read_error(path))?;
        let problem = |problem| Error::InvalidSummary { path: path.to_owned(), problem };
        let object = last_object(&text).map_err(problem)?;
        let digest = object.get("digest").and_then(Value::as_str).map(str::to_owned);
        if digest.is_some() && !run_summary::is_current(&object, run) {
            return Ok(None);
        }
        if digest.is_some() && object.get("success").is_none() {
            return Ok(Some(Self { digest, test: None }));
        }
        let test = TestEvaluation::of(&object).map_err(problem)?;
        Ok(Some(Self { digest, test: Some(test) }))
    }
}

/// Parses the JSON object on the last line of `text`.
fn last_object(text: &str) -> Result<Value, String> {
    let line = text.lines().rfind(|line| !line.trim().is_empty()).unwrap_or_default();
    serde_json::from_str(line)
        .map_err(|error| format!("the last line is not a JSON object ({error})"))
}

#[cfg(test)]
mod tests {
    use super::*;

    const LINE: &str = r#"{"task":"push","arms":2,"episodes":240,"success":0.958,"success_low":0.925,"success_high":0.977,
        "success_joint":0.9,"collision_rate":0.175}"#;

    #[test]
    fn the_last_line_is_read() {
        let test =
            TestEvaluation::parse(&format!("chatter\n{}\n", LINE.replace('\n', ""))).unwrap().0;
        assert_eq!((test.task.as_str(), test.n_arms, test.n_episodes), ("push", 2, 240));
        assert_eq!((test.success, test.interval), (0.958, Wilson { low: 0.925, high: 0.977 }));
        assert_eq!((test.success_joint, test.collision_rate), (0.9, Some(0.175)));
        assert_eq!(test.contacts, ContactMetrics::default(), "of an earlier version");
    }

    #[test]
    fn the_success_of_each_arm_is_read_if_there_is_one() {
        let parse = |per_arm: &str| {
            let more = format!(r#""success_per_arm":{per_arm},"collision_rate""#);
            let line = LINE.replace(r#""collision_rate""#, &more).replace('\n', "");
            TestEvaluation::parse(&line).map(|(test, _)| test.success_per_arm)
        };
        assert_eq!(parse("[0.75,1]"), Ok(vec![0.75, 1.0]));
        assert_eq!(parse("null"), Ok(Vec::new()));
        for invalid in ["0.75", "[0.75,2]", r#"["high"]"#] {
            assert!(parse(invalid).unwrap_err().contains("success_per_arm"), "{invalid}");
        }
        let earlier = TestEvaluation::parse(&LINE.replace('\n', "")).unwrap().0;
        assert!(earlier.success_per_arm.is_empty());
    }

    #[test]
    fn success_without_contact_is_read() {
        let more = r#""success_without_contact":0.75,"success_without_contact_low":0.7,
            "success_without_contact_high":0.8,"avoidance_rate":0.5,"collision_rate""#;
        let line = LINE.replace(r#""collision_rate""#, more).replace('\n', "");
        let test = TestEvaluation::parse(&line).unwrap().0;
        let interval = Wilson { low: 0.7, high: 0.8 };
        assert_eq!(test.contacts.success(), Some((0.75, interval)));
        assert_eq!(
            (test.contacts.avoidance_rate, test.contacts.arm_contact_rate),
            (Some(0.5), None)
        );
    }

    #[test]
    fn baselines_are_read_with_their_names() {
        let line = LINE.replace('\n', "");
        let baseline = line.replacen('{', r#"{"name":"blind policy","#, 1).replace("0.958", "0.9");
        let both = line.replacen('{', &format!(r#"{{"baselines":[{baseline}],"#), 1);
        let (policy, baselines) = TestEvaluation::parse(&both).unwrap();
        let [(name, blind)] = &baselines[..] else { panic!("{baselines:?}") };
        assert_eq!((policy.success, name.as_str(), blind.success), (0.958, "blind policy", 0.9));
        let nameless = both.replace(r#""name":"blind policy","#, "");
        assert!(TestEvaluation::parse(&nameless).unwrap_err().contains("name"));
    }

    #[test]
    fn an_error_names_the_missing_field() {
        let check = |text: &str, word: &str| {
            let problem = TestEvaluation::parse(text).unwrap_err();
            assert!(problem.contains(word), "{problem:?} lacks {word:?}");
        };
        check("", "JSON");
        check("{}", "task");
        check(&LINE.replace("success_low", "low").replace('\n', ""), "success_low");
    }

    #[test]
    fn a_summary_without_test_goals_has_no_evaluation() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("summary.json");
        let load = |text: &str| {
            std::fs::write(&path, text).unwrap();
            RunSummary::load(&path, RunLength::default())
        };
        let served = r#"{"task":"lab/reach","arms":2,"env_steps":2400,"digest":"5f3a"}"#;
        let untested = RunSummary { digest: Some("5f3a".to_owned()), test: None };
        assert_eq!(load(served).unwrap(), Some(untested));
        assert!(load(r#"{"task":"lab/reach","arms":2}"#).is_err(), "not a summary");
        assert!(load(r#"{"task":"push","success":"high","digest":"5f3a"}"#).is_err());
        let damaged = load(r#"{"task":"push","succ"#).unwrap_err().to_string();
        assert!(damaged.contains("is not the summary of a run"), "{damaged}");
        let tested = load(&LINE.replace('\n', "")).unwrap().unwrap();
        assert_eq!(tested.test.map(|test| test.task), Some("push".to_owned()));
        assert_eq!(tested.digest, None);
    }

    #[test]
    fn the_summary_of_a_shorter_run_has_no_evaluation_of_the_extended_one() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("summary.json");
        let of_2400 = r#""digest":"5f3a","max_env_steps":2400,"collision_rate""#;
        std::fs::write(&path, LINE.replace('\n', "").replace(r#""collision_rate""#, of_2400))
            .unwrap();
        let is_current = |max_env_steps| {
            let run = RunLength { max_env_steps, env_steps: None };
            RunSummary::load(&path, run).unwrap().is_some()
        };
        assert!(is_current(Some(2400)) && is_current(None));
        assert!(!is_current(Some(4800)));
    }

    #[test]
    fn a_device_is_not_read() {
        let error = TestEvaluation::load(Path::new("/dev/zero")).unwrap_err();
        assert!(matches!(error, Error::Io { .. }), "{error:?}");
    }
}
