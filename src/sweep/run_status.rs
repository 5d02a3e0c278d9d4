//! The status of a run of the sweep, as found in its directory.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow};
use serde_json::Value as Json;
use tandem_learner::checkpoint;
use tandem_policy::Policy;
use tandem_report::run_summary;
use tandem_rl::RunConfig;
use tandem_system::{atomic_file, regular_file};
use tandem_teacher::policy::is_onnx;
use toml::{Table, Value};

use super::sweep_file::{PlannedRun, flattened};
use crate::exit::Failed;
use crate::service::policy_address;
use crate::train::teacher_file::path_of_new_run;
use crate::{policy_file, run_directory, run_file};

/// A run and its status.
#[derive(Debug)]
pub(super) struct RunStatus {
    pub(super) run: PlannedRun,
    /// The run directory.
    pub(super) dir: PathBuf,
    pub(super) state: State,
    /// The reason why the latest attempt failed.
    pub(super) failure: Option<String>,
    /// The reason why this start of the sweep did not train the run, although no attempt failed.
    pub(super) left_out: Option<String>,
    /// The environment steps to which a run that had fewer is extended.
    pub(super) extends_to: Option<u64>,
}

/// The progress of a run.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum State {
    /// The run has learned nothing yet.
    New,
    /// The run can be resumed from its newest checkpoint.
    Started,
    /// The run is complete, with this summary of `tandem train --json`.
    Finished(Json),
}

impl RunStatus {
    /// Reads the status from the run's directory in `out`.
    ///
    /// # Errors
    /// When the directory contains a run with other settings, which the error names, or cannot be read.
    pub(super) fn of(run: PlannedRun, out: &Path) -> anyhow::Result<Self> {
        let dir = out.join(&run.name);
        let (state, extends_to) = state(&run, &dir)?;
        let failure = std::fs::read_to_string(failure_path(&dir)).ok();
        let failure = failure.filter(|_| !matches!(state, State::Finished(_)));
        Ok(Self { run, dir, state, failure, left_out: None, extends_to })
    }

    /// Returns the name of the state.
    pub(super) const fn state_name(&self) -> &'static str {
        match self.state {
            State::Started if self.extends_to.is_some() => "extended",
            State::New => "new",
            State::Started => "begun",
            State::Finished(_) => "finished",
        }
    }

    /// Forgets why the former attempt failed: another one has begun.
    pub(super) fn begin(&mut self) {
        drop(std::fs::remove_file(failure_path(&self.dir)));
        self.failure = None;
    }

    /// Marks a run as finished, with the summary that it has written.
    pub(super) fn finish(&mut self, summary: Json) {
        drop(std::fs::remove_file(failure_path(&self.dir)));
        (self.state, self.failure) = (State::Finished(summary), None);
    }

    /// Leaves a run out of this start of the sweep, for the reason `why`.
    pub(super) fn leave_out(&mut self, why: String) {
        self.left_out = Some(why);
    }

    /// Marks a run as failed, and stores the reason, which the next start reports.
    pub(super) fn fail(&mut self, why: String) -> anyhow::Result<()> {
        let path = failure_path(&self.dir);
        let written = atomic_file::replace(&path, why.as_bytes());
        self.failure = Some(why);
        written.with_context(|| format!("cannot write {}", path.display()))
    }
}

fn summary_path(dir: &Path) -> PathBuf {
    dir.join(run_summary::FILE)
}

fn failure_path(dir: &Path) -> PathBuf {
    dir.join("failure.txt")
}

/// The setting in which a run may have less than the sweep file: such a run is extended.
pub(super) const LENGTH: &str = "stop.max_env_steps";

/// Returns the state of the run in `dir`, and the length to which it is extended.
pub(super) fn state(run: &PlannedRun, dir: &Path) -> anyhow::Result<(State, Option<u64>)> {
    let run_toml = dir.join("run.toml");
    if !run_toml.exists() {
        return Ok((State::New, None));
    }
    let existing = run_file::resolve(Some(&run_toml), &[]).map_err(Failed::into_error);
    let differences = match &existing {
        Ok(existing) => differences(existing, &run.config)?,
        Err(error) => vec![(String::new(), format!("{error:#}"))],
    };
    let length = run_directory::length(dir, existing.as_ref().ok());
    let summary = summary(dir)?.filter(|summary| run_summary::is_current(summary, length));
    let other_teacher = other_teacher(run, dir);
    if differences.is_empty() && other_teacher.is_none() {
        return Ok((summary.map_or(State::Started, State::Finished), None));
    }
    if summary.is_none() && !has_learned(dir) {
        return Ok((State::New, None));
    }
    let planned_length = run.config.stop.max_env_steps;
    let is_longer =
        length.max_env_steps.is_some_and(|length| length > 0 && planned_length > length);
    // A larger length alone extends the run.
    let refused = differences.into_iter().filter(|(key, _)| !is_longer || key != LENGTH);
    let mut texts: Vec<String> = refused.map(|(_, text)| text).collect();
    texts.extend(other_teacher.as_deref().map(teacher_difference));
    if texts.is_empty() {
        return Ok((State::Started, Some(planned_length)));
    }
    Err(anyhow!("{} was made with other settings: {}", run.name, texts.join(", ")))
}

/// Describes the teacher of an existing run, a copy, as another one than that of the sweep file.
fn teacher_difference(copy: &Path) -> String {
    let name = server_of(copy).unwrap_or_else(|| copy.display().to_string());
    format!(
        "its teacher is neither that of [teachers] nor, without one, the shipped one (to keep it, name {name:?} in \
         [teachers])"
    )
}

/// Returns the settings in which the configuration of an existing run differs from the sweep file, each with a text.
fn differences(existing: &RunConfig, planned: &RunConfig) -> anyhow::Result<Vec<(String, String)>> {
    let has_default_interval = run_file::has_default_interval(planned);
    let [existing, planned] = [existing, planned].map(Table::try_from);
    let by_key = |table: Table| flattened(&table).into_iter().collect::<BTreeMap<_, _>>();
    let (existing, planned) = (by_key(existing?), by_key(planned?));
    // A run of an earlier version has no early evaluations, and an extended run keeps the interval that followed from its
    // first length. Evaluations affect nothing that a run learns.
    let is_ignored = |key: &str| {
        let is_interval = key == "evaluation.every_env_steps" && has_default_interval;
        is_interval || key == "evaluation.early_points"
    };
    let keys: BTreeSet<&String> = existing.keys().chain(planned.keys()).collect();
    let differing = keys
        .into_iter()
        .map(|key| (key, existing.get(key), planned.get(key)))
        .filter(|(key, existing, planned)| existing != planned && !is_ignored(key));
    let shown = |value: Option<&Value>| value.map_or_else(|| "absent".to_owned(), shortest);
    let texts = differing.map(|(key, existing, planned)| {
        let text = format!("{key} is {} there, {} now", shown(existing), shown(planned));
        (key.clone(), text)
    });
    Ok(texts.collect())
}

/// Formats a value without the digits that a single-precision setting has in double precision only.
#[expect(clippy::cast_possible_truncation, reason = "compared with the original")]
fn shortest(value: &Value) -> String {
    match value {
        Value::Float(double) if f64::from(*double as f32) == *double => {
            (*double as f32).to_string()
        }
        value => value.to_string(),
    }
}

/// Files of a run's copy of its teacher: a policy file, the model of an actor, or the server of a policy.
const TEACHER_COPIES: [&str; 3] = ["teacher.safetensors", "teacher.onnx", "teacher.toml"];

/// Returns the run's copy of its teacher, if that is another one than the sweep file names or, if it names none, than
/// the shipped one.
///
/// A run without a copy of its teacher, and a teacher that does not exist, count as equal: `tandem train` reports both.
fn other_teacher(run: &PlannedRun, dir: &Path) -> Option<PathBuf> {
    if !run.config.advice.needs_teacher() {
        return None;
    }
    let copies = TEACHER_COPIES.map(|name| dir.join("policy").join(name));
    let copy = copies.into_iter().find(|path| path.exists())?;
    let teacher = path_of_new_run(run.teacher.as_deref(), &run.config).ok()?;
    let is_same = copy == teacher_copy(&teacher, dir) && is_copy_of(&copy, &teacher);
    (!is_same).then_some(copy)
}

/// Returns true if `copy` is a copy of `teacher`, which is of the same kind.
fn is_copy_of(copy: &Path, teacher: &Path) -> bool {
    if let Some(address) = policy_address(teacher) {
        return server_of(copy).is_none_or(|server| server == address);
    }
    let Ok(teacher) = policy_file::file_of(teacher) else { return true };
    let [copied, current] = [copy, &*teacher].map(|path| regular_file::read(path).ok());
    let is_same_file = copied.zip(current).is_none_or(|(copied, current)| copied == current);
    is_same_file || has_same_digest(copy, &teacher)
}

/// Returns true if two policy files have the same digest: their networks are equal. Their other contents may differ.
fn has_same_digest(one: &Path, other: &Path) -> bool {
    let [one, other] = [one, other].map(|path| Policy::load(path).ok());
    one.zip(other).is_some_and(|(one, other)| one.digest() == other.digest())
}

/// Returns the URL of the server in a run's copy of its teacher; `None` in that of a policy file or a model.
fn server_of(copy: &Path) -> Option<String> {
    let table: Table = String::from_utf8(regular_file::read(copy).ok()?).ok()?.parse().ok()?;
    Some(table.get("address")?.as_str()?.to_owned())
}

/// Returns true if the run has a copy of its teacher, if it needs one that the sweep file names.
pub(super) fn has_teacher_copy(run: &PlannedRun, dir: &Path) -> bool {
    run.teacher.as_ref().is_none_or(|teacher| teacher_copy(teacher, dir).exists())
}

/// Returns the path of the run's copy of `teacher`.
fn teacher_copy(teacher: &Path, dir: &Path) -> PathBuf {
    let [policy, actor, server] = TEACHER_COPIES;
    let name = match policy_address(teacher) {
        Some(_) => server,
        None if is_onnx(teacher) => actor,
        None => policy,
    };
    dir.join("policy").join(name)
}

fn has_learned(dir: &Path) -> bool {
    let n_metrics = std::fs::metadata(dir.join("metrics.jsonl")).map_or(0, |file| file.len());
    n_metrics > 0 || !checkpoint::list(&run_directory::checkpoints(dir)).is_empty()
}

/// Reads the summary of the run in `dir`. A damaged one counts as missing: the run, resumed from its last checkpoint,
/// writes it again.
fn summary(dir: &Path) -> anyhow::Result<Option<Json>> {
    let path = summary_path(dir);
    if !path.exists() {
        return Ok(None);
    }
    let summary = std::fs::read(&path);
    let summary = summary.with_context(|| format!("cannot read {}", path.display()))?;
    Ok(serde_json::from_slice(&summary).ok().filter(Json::is_object))
}

#[cfg(test)]
mod tests {
    use serde_json::json;
    use tandem_core::task::Reflection;
    use tandem_core::{Layout, Task, TaskDescription, TaskSpec};
    use tandem_rl::config::Recipe;

    use super::*;

    fn planned(discount: f32) -> PlannedRun {
        let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
        config.name = "push-ea-seed1".to_owned();
        config.ddpg.discount = discount;
        PlannedRun { name: config.name.clone(), config, teacher: None }
    }

    fn made_with(out: &Path, discount: f32) {
        let dir = out.join("push-ea-seed1");
        std::fs::create_dir_all(&dir).expect("a directory");
        let text = run_file::to_toml(&planned(discount).config).expect("writes");
        std::fs::write(dir.join("run.toml"), text).expect("writes");
    }

    fn has_ended(out: &Path) {
        let path = summary_path(&out.join("push-ea-seed1"));
        std::fs::write(path, "{\"digest\": \"d\"}").expect("writes");
    }

    fn status(out: &Path, discount: f32) -> Result<RunStatus, String> {
        RunStatus::of(planned(discount), out).map_err(|error| error.to_string())
    }

    #[test]
    fn a_run_is_new_then_begun_then_finished() {
        let out = tempfile::tempdir().expect("a directory");
        let out = out.path();
        assert_eq!(status(out, 0.95).expect("fits").state, State::New);
        made_with(out, 0.95);
        let mut begun = status(out, 0.95).expect("fits");
        assert_eq!(begun.state, State::Started);
        begun.fail("the disk is full".to_owned()).expect("writes");
        assert_eq!(status(out, 0.95).expect("fits").failure.as_deref(), Some("the disk is full"));
        begun.begin();
        assert_eq!((&begun.failure, status(out, 0.95).expect("fits").failure), (&None, None));
        begun.fail("the disk is full".to_owned()).expect("writes");
        begun.finish(json!({"digest": "d"}));
        has_ended(out);
        let finished = status(out, 0.95).expect("fits");
        assert_eq!(finished.state, State::Finished(json!({"digest": "d"})));
        assert_eq!(finished.failure, None);
        let of_shorter_run = "{\"digest\": \"d\", \"max_env_steps\": 800}";
        for of_another_run_or_damaged in [of_shorter_run, "{\"digest\": \"d", "", "null"] {
            std::fs::write(summary_path(&finished.dir), of_another_run_or_damaged).expect("writes");
            assert_eq!(status(out, 0.95).expect("fits").state, State::Started);
        }
    }

    #[test]
    fn what_was_learned_with_other_settings_is_refused_by_name() {
        let out = tempfile::tempdir().expect("a directory");
        made_with(out.path(), 0.9);
        assert_eq!(status(out.path(), 0.95).expect("nothing was learned").state, State::New);
        std::fs::write(out.path().join("push-ea-seed1/metrics.jsonl"), "{}\n").expect("writes");
        let message = status(out.path(), 0.95).expect_err("other settings");
        for word in ["push-ea-seed1", "ddpg.discount is 0.9", "0.95"] {
            assert!(message.contains(word), "{message:?} lacks {word:?}");
        }
        assert_eq!(status(out.path(), 0.9).expect("fits").state, State::Started);
    }

    #[test]
    fn a_setting_that_one_of_two_runs_lacks_is_the_only_difference() {
        let described = |name: &str, reflection: Reflection| {
            let layout = Layout::new(Task::SharedPush, 2).description();
            let task = TaskDescription { name: name.to_owned(), reflection, ..layout };
            let mut config = RunConfig::defaults_of(
                Recipe::Tandem,
                &TaskSpec::new(task.clone()).expect("valid"),
            );
            config.description = Some(task);
            config
        };
        let reflection = Layout::new(Task::SharedPush, 2).description().reflection;
        let (with, without) =
            (described("lab/push", reflection), described("lab/push", Reflection::default()));
        let mut same_otherwise = with.clone();
        same_otherwise.replay.reflection_prob = without.replay.reflection_prob;
        let found = differences(&without, &same_otherwise).expect("tables");
        assert!(!found.is_empty());
        for (key, text) in found {
            assert!(key.starts_with("description.reflection."), "{text}");
            assert!(text.contains("is absent there"), "{text}");
        }
    }

    #[test]
    fn a_longer_sweep_extends_its_runs_and_a_shorter_one_is_refused() {
        let out = tempfile::tempdir().expect("a directory");
        made_with(out.path(), 0.95);
        let of_length = |factor: u64, discount: f32| {
            let mut run = planned(discount);
            run.config.stop.max_env_steps = run.config.stop.max_env_steps / 2 * factor;
            RunStatus::of(run, out.path()).map_err(|error| error.to_string())
        };
        assert_eq!(of_length(4, 0.95).expect("nothing was learned").extends_to, None);
        has_ended(out.path());
        let extended = of_length(4, 0.95).expect("longer");
        assert_eq!((&extended.state, extended.state_name()), (&State::Started, "extended"));
        assert_eq!(extended.extends_to, Some(2 * planned(0.95).config.stop.max_env_steps));
        // The interval of a short run follows from its length.
        let mut run = planned(0.95);
        (run.config.stop.max_env_steps, run.config.evaluation.every_env_steps) = (800, 160);
        let dir = out.path().join("push-ea-seed1");
        let text = run_file::to_toml(&run.config).expect("writes");
        std::fs::write(dir.join("run.toml"), text).expect("writes");
        assert!(of_length(2, 0.95).expect("longer").extends_to.is_some());
        run.config.evaluation.every_env_steps = 100;
        let refused = RunStatus::of(run, out.path()).map_err(|error| error.to_string());
        assert!(refused.expect_err("an interval that is set").contains("every_env_steps"));
        made_with(out.path(), 0.95);
        assert!(of_length(1, 0.95).expect_err("shorter").contains("stop.max_env_steps"));
        assert!(of_length(4, 0.9).expect_err("other settings too").contains("ddpg.discount"));
    }

    #[test]
    fn a_run_of_another_teacher_is_refused() {
        let out = tempfile::tempdir().expect("a directory");
        made_with(out.path(), 0.95);
        let dir = out.path().join("push-ea-seed1");
        std::fs::create_dir(dir.join("policy")).expect("a directory");
        for (path, text) in
            [("metrics.jsonl", "{}\n"), ("policy/teacher.safetensors", "one"), ("mine", "two")]
        {
            std::fs::write(dir.join(path), text).expect("writes");
        }
        let with = |teacher: &str| {
            let run = PlannedRun { teacher: Some(dir.join(teacher)), ..planned(0.95) };
            RunStatus::of(run, out.path()).map_err(|error| error.to_string())
        };
        assert!(with("mine").expect_err("another teacher").contains("teacher"));
        assert_eq!(with("policy/teacher.safetensors").expect("the same").state, State::Started);
    }

    #[test]
    fn without_a_named_teacher_a_run_has_the_shipped_one_if_it_needs_one() {
        let out = tempfile::tempdir().expect("a directory");
        made_with(out.path(), 0.95);
        has_ended(out.path());
        let policies = out.path().join("push-ea-seed1/policy");
        std::fs::create_dir(&policies).expect("a directory");
        let shipped = path_of_new_run(None, &planned(0.95).config).expect("ships");
        let copy = |name: &str, content: &[u8]| {
            std::fs::write(policies.join(name), content).expect("writes");
            status(out.path(), 0.95).map(|status| status.state_name())
        };
        let content = std::fs::read(shipped).expect("a policy");
        assert_eq!(copy("teacher.safetensors", &content).expect("the shipped one"), "finished");
        let refused = copy("teacher.safetensors", b"another").expect_err("another teacher");
        assert!(refused.contains("policy/teacher.safetensors\" in [teachers])"), "{refused}");
        let mut longer = planned(0.95);
        longer.config.stop.max_env_steps *= 2;
        let refused = RunStatus::of(longer, out.path()).expect_err("another teacher").to_string();
        assert!(refused.contains("in [teachers])") && !refused.contains(LENGTH), "{refused}");
        let refused = status(out.path(), 0.9).expect_err("a setting and the teacher");
        assert!(refused.contains("ddpg.discount") && refused.contains("[teachers]"), "{refused}");
        std::fs::remove_file(policies.join("teacher.safetensors")).expect("removes");
        assert_eq!(status(out.path(), 0.95).expect("no copy").state_name(), "finished");
        let server = b"address = \"http://127.0.0.1:7005\"\ndigest = \"5f3a\"\n";
        let refused = copy("teacher.toml", server).expect_err("the policy of a server");
        assert!(refused.contains("name \"http://127.0.0.1:7005\" in [teachers]"), "{refused}");
        let of_server = |address: &str| {
            let run = PlannedRun { teacher: Some(address.into()), ..planned(0.95) };
            RunStatus::of(run, out.path()).map(|status| status.state_name())
        };
        assert_eq!(of_server("http://127.0.0.1:7005").expect("the same server"), "finished");
        assert!(of_server("http://127.0.0.1:7006").is_err(), "another server");
        let mut unadvised = planned(0.95);
        unadvised.config.advice.strategy = "none".to_owned();
        assert_eq!(other_teacher(&unadvised, &out.path().join("push-ea-seed1")), None);
    }
}
