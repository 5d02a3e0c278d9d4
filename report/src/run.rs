//! A run as reports see it: its metrics and, where there is a run directory, what it was made of.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use tandem_core::Task;
use tandem_system::regular_file;
use tandem_telemetry::trials::TRIALS_FILE;
use tandem_telemetry::{MetricsRow, TrialRow};
use toml::{Table, Value};

use crate::error::Error;
use crate::held_out::HeldOut;

/// How deep below a directory runs are looked for.
const MAX_DEPTH: usize = 6;

/// A run as reports see it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Run {
    /// The name of its directory, or of its metrics file.
    pub name: String,
    /// One row an evaluation, in order.
    pub rows: Vec<MetricsRow>,
    /// Its resolved configuration as it stands in `run.toml`, when there is one.
    pub configuration: Option<String>,
    /// What its best policy reached on held-out goals, when `summary.json` says so.
    pub held_out: Option<HeldOut>,
}

/// What was found of runs and trials, and what could not be used.
#[derive(Debug, Default)]
pub struct Found {
    /// The runs, in the order of the paths given, those of a directory by name.
    pub runs: Vec<Run>,
    /// The trials of every file of them, in the same order.
    pub trials: Vec<TrialRow>,
    /// A line for every file that is used in part or not at all.
    pub warnings: Vec<String>,
}

impl Run {
    /// Reads the run directory `dir`; what is unreadable in its metrics ends them, with a warning.
    ///
    /// # Errors
    /// When its `metrics.jsonl` or `run.toml` cannot be read.
    pub fn load(dir: &Path, warnings: &mut Vec<String>) -> Result<Self, Error> {
        let rows = read_rows(&dir.join("metrics.jsonl"), warnings)?;
        let configuration = read_if_there(&dir.join("run.toml"))?;
        let summary = dir.join("summary.json");
        let held_out = match summary.exists() {
            true => HeldOut::load(&summary).map_err(|error| warnings.push(error.to_string())).ok(),
            false => None,
        };
        Ok(Self { name: directory_name(dir), rows, configuration, held_out })
    }

    /// Reads a metrics file that stands by itself.
    ///
    /// # Errors
    /// When it cannot be read or its first line is no metrics row.
    pub fn load_file(path: &Path, warnings: &mut Vec<String>) -> Result<Self, Error> {
        let name = path.file_stem().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        let rows = read_rows(path, warnings)?;
        if rows.is_empty() {
            return Err(Error::NoRow { path: path.to_owned() });
        }
        Ok(Self { name, rows, ..Self::default() })
    }

    /// The evaluation of the policy that the run kept as its best; where none says so, the one with the highest success,
    /// of equals the first.
    #[must_use]
    pub fn best(&self) -> Option<&MetricsRow> {
        let highest = || self.rows.iter().rev().max_by(|a, b| a.success.total_cmp(&b.success));
        self.rows.iter().rfind(|row| row.best).or_else(highest)
    }

    /// The last evaluation.
    #[must_use]
    pub fn last(&self) -> Option<&MetricsRow> {
        self.rows.last()
    }

    /// The configuration as a table; empty when there is none.
    pub(crate) fn settings(&self) -> Table {
        self.configuration.as_ref().and_then(|text| text.parse().ok()).unwrap_or_default()
    }

    /// What the arms do, by the configuration or else by the name.
    #[must_use]
    pub fn task(&self) -> Option<Task> {
        match self.settings().get("task").and_then(Value::as_str) {
            Some(name) => name.parse().ok(),
            None => Task::ALL.into_iter().find(|task| self.name.contains(task.name())),
        }
    }

    /// The seed, by the configuration or else by the name's `-seedN`.
    #[must_use]
    pub fn seed(&self) -> Option<u64> {
        match self.settings().get("seed").and_then(Value::as_integer) {
            Some(seed) => u64::try_from(seed).ok(),
            None => self.name.rsplit_once("-seed")?.1.parse().ok(),
        }
    }

    /// The name without its `-seedN`.
    #[must_use]
    pub fn stem(&self) -> &str {
        match self.name.rsplit_once("-seed") {
            Some((stem, seed)) if seed.bytes().all(|byte| byte.is_ascii_digit()) => stem,
            _ => &self.name,
        }
    }
}

/// Reads every run and every trial that `paths` name: run directories, directories with runs and trials below, bare
/// metrics and trials files.
///
/// # Errors
/// When a path cannot be read or has neither. What is wrong with single runs and trials of a directory is a warning.
pub fn find(paths: &[PathBuf]) -> Result<Found, Error> {
    let mut found = Found::default();
    for path in paths {
        if path.is_file() {
            found.read_file(path)?;
        } else {
            found.read_below(path)?;
        }
    }
    Ok(found)
}

impl Found {
    fn read_file(&mut self, path: &Path) -> Result<(), Error> {
        if is_trials_file(path)? {
            self.trials.extend(read_trials(path, &mut self.warnings)?);
        } else {
            self.runs.push(Run::load_file(path, &mut self.warnings)?);
        }
        Ok(())
    }

    fn read_below(&mut self, path: &Path) -> Result<(), Error> {
        let mut places = Places::default();
        places.look_in(path, MAX_DEPTH, Within::Directory)?;
        if places.runs.is_empty() && places.trials.is_empty() {
            return Err(Error::NoRun { path: path.to_owned() });
        }
        let mut refused = None;
        let n_before = self.runs.len() + self.trials.len();
        for dir in &places.runs {
            match Run::load(dir, &mut self.warnings) {
                Ok(run) => self.runs.push(run),
                Err(error) => {
                    self.warnings.push(format!("{} is left out: {error}", dir.display()));
                }
            }
        }
        for file in &places.trials {
            match read_trials(file, &mut self.warnings) {
                Ok(rows) => self.trials.extend(rows),
                Err(error) => {
                    self.warnings.push(format!("left out: {error}"));
                    refused.get_or_insert(error);
                }
            }
        }
        let n_found = self.runs.len() + self.trials.len() - n_before;
        refused.filter(|_| n_found == 0).map_or(Ok(()), Err)
    }
}

/// Where runs and trials lie below a directory.
#[derive(Debug, Default)]
struct Places {
    /// Run directories.
    runs: Vec<PathBuf>,
    /// Files.
    trials: Vec<PathBuf>,
}

/// What a directory is part of: what lies below a run belongs to it, but for trials.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Within {
    Directory,
    Run,
}

impl Places {
    /// Notes `dir` itself and what is below it, sorted.
    fn look_in(&mut self, dir: &Path, depth: usize, within: Within) -> Result<(), Error> {
        let is_run = within == Within::Directory && dir.join("metrics.jsonl").is_file();
        if is_run {
            self.runs.push(dir.to_owned());
        }
        let trials = dir.join(TRIALS_FILE);
        if trials.is_file() {
            self.trials.push(trials);
        }
        let within = if is_run { Within::Run } else { within };
        let entries = std::fs::read_dir(dir).map_err(read_error(dir))?;
        let is_dir =
            |entry: &std::fs::DirEntry| entry.file_type().is_ok_and(|file_type| file_type.is_dir());
        let mut below: Vec<PathBuf> =
            entries.flatten().filter(is_dir).map(|entry| entry.path()).collect();
        below.sort();
        for dir in below.iter().filter(|_| depth > 0) {
            match self.look_in(dir, depth - 1, within) {
                // A run's other directories are its own affair.
                Err(_) if within == Within::Run => {}
                other => other?,
            }
        }
        Ok(())
    }
}

/// Whether a file by itself is one of trials, by its name or else by its first line.
fn is_trials_file(path: &Path) -> Result<bool, Error> {
    if path.file_name().is_some_and(|name| name == TRIALS_FILE) {
        return Ok(true);
    }
    let bytes = regular_file::read(path).map_err(read_error(path))?;
    let first = bytes.split(|byte| *byte == b'\n').next().unwrap_or_default();
    Ok(serde_json::from_slice::<TrialRow>(first).is_ok())
}

/// The trials of a file up to the first line that is none, of which a warning tells; a file without one is refused.
fn read_trials(path: &Path, warnings: &mut Vec<String>) -> Result<Vec<TrialRow>, Error> {
    let (rows, broken) = read_lines::<TrialRow>(path)?;
    if rows.is_empty() {
        let problem = broken.map_or_else(
            || "it is empty".to_owned(),
            |Broken { line, problem }| format!("line {line} is none ({problem})"),
        );
        return Err(Error::NoTrial { path: path.to_owned(), problem });
    }
    warnings.extend(broken.map(|broken| broken.warning(path, "trial")));
    Ok(rows)
}

/// The rows of a metrics file up to the first line that is none, of which a warning tells.
fn read_rows(path: &Path, warnings: &mut Vec<String>) -> Result<Vec<MetricsRow>, Error> {
    let (rows, broken) = read_lines(path)?;
    warnings.extend(broken.map(|broken| broken.warning(path, "metrics row")));
    Ok(rows)
}

/// Where a file of lines stops making sense.
struct Broken {
    /// The line, from 1.
    line: usize,
    problem: String,
}

impl Broken {
    fn warning(&self, path: &Path, what: &str) -> String {
        let Self { line, problem } = self;
        format!("{}, line {line}, is no {what} ({problem}): used up to there", path.display())
    }
}

fn read_lines<T: DeserializeOwned>(path: &Path) -> Result<(Vec<T>, Option<Broken>), Error> {
    let bytes = regular_file::read(path).map_err(read_error(path))?;
    let mut rows = Vec::new();
    for (line_idx, line) in bytes.split_inclusive(|byte| *byte == b'\n').enumerate() {
        match serde_json::from_slice(line) {
            Ok(row) => rows.push(row),
            Err(error) => {
                let text = error.to_string();
                // The parser counts lines within the line that it was given.
                let problem = text.split(" at line ").next().unwrap_or(&text).to_owned();
                return Ok((rows, Some(Broken { line: line_idx + 1, problem })));
            }
        }
    }
    Ok((rows, None))
}

fn read_if_there(path: &Path) -> Result<Option<String>, Error> {
    match read_text(path) {
        Ok(text) => Ok(Some(text)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => Err(read_error(path)(error)),
    }
}

/// Reads a text from a regular file.
pub(crate) fn read_text(path: &Path) -> std::io::Result<String> {
    let not_utf8 = |_| std::io::Error::new(ErrorKind::InvalidData, "it is not UTF-8");
    String::from_utf8(regular_file::read(path)?).map_err(not_utf8)
}

fn read_error(path: &Path) -> impl FnOnce(std::io::Error) -> Error {
    move |source| Error::Io { action: "read", path: path.to_owned(), source }
}

fn directory_name(dir: &Path) -> String {
    let absolute = dir.canonicalize().unwrap_or_else(|_| dir.to_owned());
    absolute.file_name().unwrap_or(dir.as_os_str()).to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(round: u64) -> String {
        let row = MetricsRow { round, success: 0.5, ..MetricsRow::default() };
        serde_json::to_string(&row).unwrap() + "\n"
    }

    fn write(path: &Path, text: &str) {
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }

    #[test]
    fn runs_are_found_wherever_they_lie_below_a_directory() {
        let dir = tempfile::tempdir().unwrap();
        write(&dir.path().join("b/metrics.jsonl"), &line(1));
        write(&dir.path().join("deep/a/metrics.jsonl"), &line(1));
        write(&dir.path().join("deep/a/checkpoint/metrics.jsonl"), &line(1));
        write(&dir.path().join("lone.jsonl"), &line(1));
        let found = find(&[dir.path().to_owned(), dir.path().join("lone.jsonl")]).unwrap();
        let names: Vec<&str> = found.runs.iter().map(|run| run.name.as_str()).collect();
        assert_eq!(names, ["b", "a", "lone"]);
        assert!(found.warnings.is_empty(), "{:?}", found.warnings);
    }

    #[test]
    fn a_metrics_file_counts_up_to_what_is_no_row() {
        let check = |tail: &str| {
            let dir = tempfile::tempdir().unwrap();
            write(&dir.path().join("metrics.jsonl"), &(line(1) + &line(2) + tail));
            let found = find(&[dir.path().to_owned()]).unwrap();
            let rounds: Vec<u64> = found.runs[0].rows.iter().map(|row| row.round).collect();
            assert_eq!(rounds, [1, 2], "{tail:?}");
            assert_eq!(found.warnings.len(), 1, "{:?}", found.warnings);
            assert!(found.warnings[0].contains("line 3"), "{:?}", found.warnings);
        };
        check(&line(3)[..40]);
        check(&(line(3)[..40].to_owned() + "\n" + &line(4)));
        check("nonsense\n");
        check("\u{0}\n");
    }

    fn trial(trial: u64) -> String {
        let row = TrialRow {
            subject: "student".to_owned(),
            mode: "open-loop".to_owned(),
            task: "push".to_owned(),
            trial,
            seed: 1,
            success: true,
            cause: None,
            detail: None,
            goal_distances_m: vec![0.01],
            rehearsed_m: None,
            duration_s: 2.0,
            n_steps: 50,
            n_shortened: 0,
            arms_gap_m: None,
            table_gap_m: 0.01,
            starts: Vec::new(),
            goals: Vec::new(),
            ends: Vec::new(),
            path: Vec::new(),
            log: None,
        };
        serde_json::to_string(&row).unwrap() + "\n"
    }

    #[test]
    fn trials_are_found_beside_runs_below_them_and_by_themselves() {
        let dir = tempfile::tempdir().unwrap();
        write(&dir.path().join("a/metrics.jsonl"), &line(1));
        write(&dir.path().join("a/trials/trials.jsonl"), &trial(1));
        write(&dir.path().join("b/trials.jsonl"), &(trial(2) + &trial(3)));
        write(&dir.path().join("kept.jsonl"), &trial(4));
        let found = find(&[dir.path().to_owned(), dir.path().join("kept.jsonl")]).unwrap();
        let numbers: Vec<u64> = found.trials.iter().map(|row| row.trial).collect();
        assert_eq!((numbers, found.runs.len()), (vec![1, 2, 3, 4], 1));
        assert!(found.warnings.is_empty(), "{:?}", found.warnings);
    }

    #[test]
    fn a_trials_file_counts_up_to_what_is_no_trial() {
        let dir = tempfile::tempdir().unwrap();
        for tail in [&trial(3)[..200], "nonsense\n", &trial(3).replace("\"seed\":1", "\"seed\":-1")]
        {
            write(&dir.path().join("trials.jsonl"), &(trial(1) + &trial(2) + tail));
            let found = find(&[dir.path().to_owned()]).unwrap();
            assert_eq!(found.trials.len(), 2, "{tail:?}");
            let [warning] = &found.warnings[..] else { panic!("{:?}", found.warnings) };
            assert!(warning.contains("trials.jsonl, line 3, is no trial ("), "{warning}");
            assert!(!warning.contains("line 1"), "{warning}");
        }
    }

    #[test]
    fn a_file_without_a_trial_is_an_error_unless_there_is_something_else() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("mine/trials.jsonl");
        for (content, reason) in [("", "it is empty"), ("{}\n", "line 1 is none (missing field")] {
            write(&file, content);
            for path in [dir.path().to_owned(), file.clone()] {
                let error = find(&[path]).unwrap_err();
                assert!(matches!(error, Error::NoTrial { .. }), "{error:?}");
                assert!(error.to_string().contains(reason), "{error}");
            }
        }
        write(&dir.path().join("a/metrics.jsonl"), &line(1));
        let found = find(&[dir.path().to_owned()]).unwrap();
        assert_eq!((found.runs.len(), found.trials.len(), found.warnings.len()), (1, 0, 1));
    }

    #[test]
    fn a_metrics_file_without_a_row_is_an_error_by_itself_and_a_young_run_in_its_directory() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("metrics.jsonl");
        for content in ["", "\u{1b}[31mred\n"] {
            write(&file, content);
            assert!(
                matches!(find(std::slice::from_ref(&file)), Err(Error::NoRow { .. })),
                "{content:?}"
            );
            assert!(find(&[dir.path().to_owned()]).unwrap().runs[0].rows.is_empty());
        }
    }

    #[test]
    fn a_result_that_may_have_no_end_is_not_read() {
        let error = HeldOut::load(Path::new("/dev/zero")).unwrap_err();
        assert!(matches!(error, Error::Io { .. }), "{error:?}");
    }

    #[test]
    fn a_path_without_a_run_is_an_error() {
        let dir = tempfile::tempdir().unwrap();
        assert!(matches!(find(&[dir.path().to_owned()]), Err(Error::NoRun { .. })));
        assert!(matches!(find(&[dir.path().join("missing")]), Err(Error::Io { .. })));
    }

    #[test]
    fn task_and_seed_come_from_the_configuration_before_the_name() {
        let run = |name: &str, configuration: Option<&str>| Run {
            name: name.to_owned(),
            configuration: configuration.map(str::to_owned),
            ..Run::default()
        };
        let named = run("teacher-pick-and-place-seed12", None);
        assert_eq!(
            (named.task(), named.seed(), named.stem()),
            (Some(Task::PickAndPlace), Some(12), "teacher-pick-and-place")
        );
        let configured = run("mine", Some("task = \"push\"\nseed = 7"));
        assert_eq!(
            (configured.task(), configured.seed(), configured.stem()),
            (Some(Task::Push), Some(7), "mine")
        );
        assert_eq!(run("odd-seedling", None).stem(), "odd-seedling");
    }
}
