//! A run as reports see it: its metrics and, from a run directory, its configuration and final evaluation.

use std::path::Path;
use std::str::FromStr;

use sha2::{Digest as _, Sha256};
use tandem_core::task::TaskDescription;
use tandem_core::text::hex;
use tandem_core::{Layout, Task, TaskSpec};
use tandem_telemetry::MetricsRow;
use toml::{Table, Value};

use crate::error::Error;
use crate::files::{read_if_present, read_rows};
use crate::run_summary::{self, RunLength};
use crate::test_evaluation::{RunSummary, TestEvaluation};

/// The settings of a run, from the text of its `run.toml`.
#[derive(Debug, Clone, PartialEq)]
pub struct Configuration {
    text: String,
    settings: Table,
}

impl FromStr for Configuration {
    type Err = toml::de::Error;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Ok(Self { text: text.to_owned(), settings: text.parse()? })
    }
}

impl Configuration {
    /// Returns the text of the file.
    #[must_use]
    pub fn text(&self) -> &str {
        &self.text
    }
}

/// A run as reports see it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Run {
    /// Name of the run directory, or stem of the metrics file.
    pub name: String,
    /// One row per evaluation, in order.
    pub rows: Vec<MetricsRow>,
    /// The resolved configuration `run.toml`, if there is one and it can be parsed.
    pub configuration: Option<Configuration>,
    /// Evaluation of the best policy on test goals, from `summary.json`, if there is one.
    pub test: Option<TestEvaluation>,
    /// Digest of the learner's state at the end, from `summary.json`, if there is one. Runs with equal settings and equal
    /// digests are the same run.
    pub digest: Option<String>,
    /// SHA-256 of the teacher's file in the run directory, the first digits, hexadecimal, if there is one.
    pub teacher: Option<String>,
}

impl Run {
    /// Reads the run directory `dir`.
    ///
    /// Metrics are read up to the first invalid line. That, an unusable `summary.json` and a `run.toml` that is no TOML
    /// add to `warnings`.
    ///
    /// # Errors
    /// If `metrics.jsonl` or `run.toml` cannot be read.
    pub fn load(dir: &Path, warnings: &mut Vec<String>) -> Result<Self, Error> {
        let rows = read_metrics(&dir.join("metrics.jsonl"), warnings)?;
        let configuration = read_configuration(&dir.join("run.toml"), warnings)?;
        let teacher = teacher_of(dir);
        let mut run =
            Self { name: directory_name(dir), rows, configuration, teacher, ..Self::default() };
        let summary = dir.join(run_summary::FILE);
        if summary.exists() {
            match RunSummary::load(&summary, run.length()) {
                Ok(Some(RunSummary { digest, test })) => (run.digest, run.test) = (digest, test),
                Ok(None) => {}
                Err(error) => warnings.push(error.to_string()),
            }
        }
        Ok(run)
    }

    /// Returns true if the run has taken advice.
    pub(crate) fn took_advice(&self) -> bool {
        self.rows.iter().any(|row| row.advice_spent > 0)
    }

    /// Reads a metrics file without a run directory.
    ///
    /// # Errors
    /// If the file cannot be read or its first line is not a metrics row.
    pub fn load_file(path: &Path, warnings: &mut Vec<String>) -> Result<Self, Error> {
        let name = path.file_stem().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        let rows = read_metrics(path, warnings)?;
        if rows.is_empty() {
            return Err(Error::NoMetrics { path: path.to_owned() });
        }
        Ok(Self { name, rows, ..Self::default() })
    }

    /// Returns the evaluation of the run's best policy, on the goals that selected it.
    ///
    /// If no row is marked as the best, returns the first row with the highest success.
    #[must_use]
    pub fn best(&self) -> Option<&MetricsRow> {
        let highest = || self.rows.iter().rev().max_by(|a, b| a.success.total_cmp(&b.success));
        self.rows.iter().rfind(|row| row.best).or_else(highest)
    }

    /// Returns the last evaluation.
    #[must_use]
    pub fn last(&self) -> Option<&MetricsRow> {
        self.rows.last()
    }

    /// Returns a top-level setting or section of the configuration.
    pub(crate) fn setting(&self, key: &str) -> Option<&Value> {
        self.configuration.as_ref()?.settings.get(key)
    }

    /// Returns the configuration, which is empty if there is none, with the digest of the teacher, which the
    /// configuration does not name.
    pub(crate) fn settings_with_teacher(&self) -> Table {
        let settings = self.configuration.as_ref().map(|configuration| &configuration.settings);
        let mut settings = settings.cloned().unwrap_or_default();
        if let Some(teacher) = self.teacher.as_ref().filter(|_| !settings.is_empty()) {
            settings.insert("teacher".to_owned(), Value::String(teacher.clone()));
        }
        settings
    }

    /// Returns the length of the run, from its configuration and its last evaluation.
    fn length(&self) -> RunLength {
        let max_env_steps = || {
            let max_env_steps = self.setting("stop")?.get("max_env_steps")?.as_integer()?;
            u64::try_from(max_env_steps).ok()
        };
        let env_steps = self.last().map(|last| last.env_steps);
        RunLength { max_env_steps: max_env_steps(), env_steps }
    }

    /// Returns the name of the task, from the configuration or, for a built-in task, else from the run's name.
    #[must_use]
    pub fn task(&self) -> Option<String> {
        let in_name = |task: &Task| self.name.contains(task.name());
        match self.setting("task").and_then(Value::as_str) {
            Some(name) => Some(name.to_owned()),
            // Last first: `push` is contained in `shared-push`.
            None => Task::ALL.into_iter().rev().find(in_name).map(|task| task.name().to_owned()),
        }
    }

    /// Returns the task, from the configuration; `None` if there is none or its task is invalid.
    #[must_use]
    pub fn task_spec(&self) -> Option<TaskSpec> {
        if let Some(description) = self.setting("description") {
            let description: TaskDescription = description.clone().try_into().ok()?;
            return TaskSpec::new(description).ok();
        }
        let task = self.setting("task")?.as_str()?.parse().ok()?;
        let n_arms = usize::try_from(self.setting("arms")?.as_integer()?).ok()?;
        TaskSpec::new(Layout::new(task, n_arms).description()).ok()
    }

    /// Returns true if the task reports contacts or is unknown.
    #[must_use]
    pub fn reports_contacts(&self) -> bool {
        self.task_spec().is_none_or(|task| task.reports_contacts())
    }

    /// Returns the seed, from the configuration or else from the name's suffix `-seedN`.
    #[must_use]
    pub fn seed(&self) -> Option<u64> {
        match self.setting("seed").and_then(Value::as_integer) {
            Some(seed) => u64::try_from(seed).ok(),
            None => self.name.rsplit_once("-seed")?.1.parse().ok(),
        }
    }

    /// Returns the name without its suffix `-seedN`, or `-seedN.M` of a repeated run.
    #[must_use]
    pub fn stem(&self) -> &str {
        match self.name.rsplit_once("-seed") {
            Some((stem, seed)) if seed.split('.').all(is_number) => stem,
            _ => &self.name,
        }
    }
}

fn is_number(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit())
}

/// Reads the rows of a metrics file up to the first invalid line, which adds a warning.
fn read_metrics(path: &Path, warnings: &mut Vec<String>) -> Result<Vec<MetricsRow>, Error> {
    let (rows, invalid) = read_rows(path)?;
    warnings.extend(invalid.map(|invalid| invalid.warning(path, "metrics row")));
    Ok(rows)
}

/// Reads a `run.toml`. One that is no TOML adds a warning.
fn read_configuration(
    path: &Path,
    warnings: &mut Vec<String>,
) -> Result<Option<Configuration>, Error> {
    let Some(text) = read_if_present(path)? else { return Ok(None) };
    let configuration = text.parse().map_err(|error: toml::de::Error| {
        let problem = error.message().replace('\n', " ");
        warnings.push(format!(
            "{} is not TOML ({problem}): the settings of this run are unknown",
            path.display()
        ));
    });
    Ok(configuration.ok())
}

fn directory_name(dir: &Path) -> String {
    let absolute = dir.canonicalize().unwrap_or_else(|_| dir.to_owned());
    absolute.file_name().unwrap_or(dir.as_os_str()).to_string_lossy().into_owned()
}

/// Returns the first digits of the SHA-256 of the teacher's file in the run directory `dir`.
fn teacher_of(dir: &Path) -> Option<String> {
    const FILES: [&str; 3] = ["teacher.safetensors", "teacher.onnx", "teacher.toml"];
    let bytes = FILES.iter().find_map(|file| std::fs::read(dir.join("policy").join(file)).ok())?;
    Some(hex(&Sha256::digest(bytes)[..4]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn task_and_seed_come_from_the_configuration_before_the_name() {
        let run = |name: &str, configuration: Option<&str>| Run {
            name: name.to_owned(),
            configuration: configuration.and_then(|text| text.parse().ok()),
            ..Run::default()
        };
        let named = run("teacher-pick-and-place-seed12", None);
        assert_eq!(
            (named.task(), named.seed(), named.stem()),
            (Some("pick-and-place".to_owned()), Some(12), "teacher-pick-and-place")
        );
        let configured = run("mine", Some("task = \"push\"\nseed = 7"));
        assert_eq!(
            (configured.task(), configured.seed(), configured.stem()),
            (Some("push".to_owned()), Some(7), "mine")
        );
        assert_eq!(run("odd-seedling", None).stem(), "odd-seedling");
        assert_eq!(run("push-ea-seed1.2", None).stem(), "push-ea");
    }
}
