//! How far a run of the sweep is, as its directory tells.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow};
use serde_json::Value as Json;
use tandem_learner::checkpoint;
use tandem_rl::RunConfig;
use tandem_system::{atomic_file, regular_file};
use toml::{Table, Value};

use super::file::{PlannedRun, flattened};
use crate::run_file;

/// A run and how far it is.
#[derive(Debug)]
pub(super) struct Standing {
    pub(super) run: PlannedRun,
    /// The run directory.
    pub(super) dir: PathBuf,
    pub(super) state: State,
    /// Why it failed when it was last tried.
    pub(super) failure: Option<String>,
}

/// How far a run is.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum State {
    /// Nothing was learned yet.
    New,
    /// Begun: it goes on from its newest checkpoint.
    Begun,
    /// Over; what it reached, as `tandem train --json` told.
    Finished(Json),
}

impl Standing {
    /// Looks into the run's directory below `out`.
    ///
    /// # Errors
    /// When the directory holds what was learned with other settings, or cannot be read; names what differs.
    pub(super) fn of(run: PlannedRun, out: &Path) -> anyhow::Result<Self> {
        let dir = out.join(&run.name);
        let state = state(&run, &dir)?;
        let failure = std::fs::read_to_string(failure_path(&dir)).ok();
        let failure = failure.filter(|_| !matches!(state, State::Finished(_)));
        Ok(Self { run, dir, state, failure })
    }

    /// What is to be done, in a word or two.
    pub(super) const fn todo(&self) -> &'static str {
        match self.state {
            State::New => "new",
            State::Begun => "begun",
            State::Finished(_) => "finished",
        }
    }

    /// Keeps what a run reached: from now on it is finished. The file is whole or not there.
    pub(super) fn finish(&mut self, summary: Json) -> anyhow::Result<()> {
        let path = self.dir.join("summary.json");
        let written = atomic_file::replace(&path, format!("{summary}\n").as_bytes());
        written.with_context(|| format!("cannot write {}", path.display()))?;
        drop(std::fs::remove_file(failure_path(&self.dir)));
        (self.state, self.failure) = (State::Finished(summary), None);
        Ok(())
    }

    /// Keeps why a run failed, for the next start to tell.
    pub(super) fn fail(&mut self, why: String) -> anyhow::Result<()> {
        let path = failure_path(&self.dir);
        std::fs::write(&path, &why).with_context(|| format!("cannot write {}", path.display()))?;
        self.failure = Some(why);
        Ok(())
    }
}

fn failure_path(dir: &Path) -> PathBuf {
    dir.join("failure.txt")
}

fn state(run: &PlannedRun, dir: &Path) -> anyhow::Result<State> {
    let run_toml = dir.join("run.toml");
    if !run_toml.exists() {
        return Ok(State::New);
    }
    let differences = match run_file::resolve(Some(&run_toml), &[]) {
        Ok(config) => differences(&config, &run.config)?,
        Err(failed) => vec![format!("{:#}", failed.into_error())],
    };
    let summary = summary(dir)?;
    if !differences.is_empty() || !same_teacher(run, dir) {
        if summary.is_none() && !has_learned(dir) {
            return Ok(State::New);
        }
        let differences = match differences.is_empty() {
            true => "its teacher".to_owned(),
            false => differences.join(", "),
        };
        return Err(anyhow!("{} was made with other settings: {differences}", run.name));
    }
    Ok(summary.map_or(State::Begun, State::Finished))
}

/// Where two configurations differ.
fn differences(there: &RunConfig, here: &RunConfig) -> anyhow::Result<Vec<String>> {
    let (there, here) = (flattened(&Table::try_from(there)?), flattened(&Table::try_from(here)?));
    let differing = there.iter().zip(&here).filter(|(there, here)| there != here);
    let told = differing.map(|((key, was), (_, is))| {
        format!("{key} is {} there, {} now", written(was), written(is))
    });
    Ok(told.collect())
}

/// A value as a person wrote it: single-precision settings without the digits that only double precision has.
#[expect(clippy::cast_possible_truncation, reason = "compared with what it was")]
fn written(value: &Value) -> String {
    match value {
        Value::Float(double) if f64::from(*double as f32) == *double => {
            (*double as f32).to_string()
        }
        value => value.to_string(),
    }
}

/// Whether the run's copy of its teacher is the teacher that the sweep file names.
fn same_teacher(run: &PlannedRun, dir: &Path) -> bool {
    let Some(teacher) = &run.teacher else { return true };
    let copy = regular_file::read(&dir.join("policy/teacher.safetensors"));
    // A file that is missing is reported by the run itself.
    let named = regular_file::read(teacher);
    copy.ok().zip(named.ok()).is_none_or(|(copy, named)| copy == named)
}

fn has_learned(dir: &Path) -> bool {
    let n_metrics = std::fs::metadata(dir.join("metrics.jsonl")).map_or(0, |file| file.len());
    n_metrics > 0 || !checkpoint::list(&dir.join("checkpoint")).is_empty()
}

fn summary(dir: &Path) -> anyhow::Result<Option<Json>> {
    let path = dir.join("summary.json");
    if !path.exists() {
        return Ok(None);
    }
    let text = std::fs::read_to_string(&path);
    let text = text.with_context(|| format!("cannot read {}", path.display()))?;
    let summary = serde_json::from_str(&text);
    summary.map(Some).with_context(|| format!("{} is damaged: remove it", path.display()))
}

#[cfg(test)]
mod tests {
    use serde_json::json;
    use tandem_core::Task;
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

    fn standing(out: &Path, discount: f32) -> Result<Standing, String> {
        Standing::of(planned(discount), out).map_err(|error| error.to_string())
    }

    #[test]
    fn a_run_is_new_then_begun_then_finished() {
        let out = tempfile::tempdir().expect("a directory");
        let out = out.path();
        assert_eq!(standing(out, 0.95).expect("fits").state, State::New);
        made_with(out, 0.95);
        let mut begun = standing(out, 0.95).expect("fits");
        assert_eq!(begun.state, State::Begun);
        begun.fail("the disk is full".to_owned()).expect("writes");
        assert_eq!(standing(out, 0.95).expect("fits").failure.as_deref(), Some("the disk is full"));
        begun.finish(json!({"digest": "d"})).expect("writes");
        let finished = standing(out, 0.95).expect("fits");
        assert_eq!(finished.state, State::Finished(json!({"digest": "d"})));
        assert_eq!(finished.failure, None);
    }

    #[test]
    fn what_was_learned_with_other_settings_is_refused_by_name() {
        let out = tempfile::tempdir().expect("a directory");
        made_with(out.path(), 0.9);
        assert_eq!(standing(out.path(), 0.95).expect("nothing was learned").state, State::New);
        std::fs::write(out.path().join("push-ea-seed1/metrics.jsonl"), "{}\n").expect("writes");
        let message = standing(out.path(), 0.95).expect_err("other settings");
        for word in ["push-ea-seed1", "ddpg.discount is 0.9", "0.95"] {
            assert!(message.contains(word), "{message:?} lacks {word:?}");
        }
        assert_eq!(standing(out.path(), 0.9).expect("fits").state, State::Begun);
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
            Standing::of(run, out.path()).map_err(|error| error.to_string())
        };
        assert!(with("mine").expect_err("another teacher").contains("teacher"));
        assert_eq!(with("policy/teacher.safetensors").expect("the same").state, State::Begun);
    }
}
