//! Finds and reads the runs and trials of a report.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use tandem_telemetry::TrialRow;
use tandem_telemetry::trials::TRIALS_FILE;

use crate::error::Error;
use crate::files::{InvalidLine, read_bytes, read_error, read_rows};
use crate::run::Run;
use crate::run_summary;

/// The files of a run directory that are read.
const RUN_FILES: [&str; 3] = ["metrics.jsonl", "run.toml", run_summary::FILE];
/// The directories in a run directory with the run's policies, among them the copy of its teacher, and its checkpoints.
const RUN_DIRECTORIES: [&str; 2] = ["policy", "checkpoint"];
/// Depth to which directories are searched.
const MAX_DEPTH: usize = 6;

/// The runs and trials of a report.
#[derive(Debug, Default)]
pub struct ReportInputs {
    /// Runs, in the order of the paths; those of one directory by name.
    pub runs: Vec<Run>,
    /// Trials of all files, in the same order.
    pub trials: Vec<TrialRow>,
    /// One line for each file that is ignored in part or as a whole.
    pub warnings: Vec<String>,
    /// The canonical paths of the runs and files that were read.
    read: BTreeSet<PathBuf>,
}

impl ReportInputs {
    /// Reads all runs and trials of `paths`: run directories, directories that contain runs or trials at any depth up
    /// to six, and single metrics or trials files. Within a run directory, subdirectories that have a configuration are
    /// further runs.
    ///
    /// Unusable runs and trials within a directory add to `warnings`.
    ///
    /// # Errors
    /// If a path cannot be read or contains neither runs nor trials.
    pub fn load(paths: &[PathBuf]) -> Result<Self, Error> {
        let mut inputs = Self::default();
        for path in paths {
            if path.is_dir() {
                inputs.read_directory(path)?;
            } else if inputs.is_new(path) {
                inputs.read_file(path)?;
            }
        }
        Ok(inputs)
    }

    /// Returns true if the run or file `path` was not read before. A path that is named again adds a warning and is not
    /// read.
    fn is_new(&mut self, path: &Path) -> bool {
        let Ok(canonical) = path.canonicalize() else { return true };
        let is_new = self.read.insert(canonical);
        if !is_new {
            self.warnings.push(format!("{} is named twice and counted once", path.display()));
        }
        is_new
    }

    /// Returns true if `path` is one of the files that were read, or is in the directory of the policies or of the
    /// checkpoints of a run that was read: writing it would destroy an input or change a run.
    #[must_use]
    pub fn contains(&self, path: &Path) -> bool {
        let Some(path) = resolved(path) else { return false };
        let is_in_run = |path: &Path, names: &[&str]| {
            let is_of_run = path.parent().is_some_and(|parent| self.read.contains(parent));
            is_of_run && names.iter().any(|name| path.file_name().is_some_and(|own| own == *name))
        };
        self.read.contains(&path)
            || is_in_run(&path, &RUN_FILES)
            || path.ancestors().skip(1).any(|directory| is_in_run(directory, &RUN_DIRECTORIES))
    }

    fn read_file(&mut self, path: &Path) -> Result<(), Error> {
        if is_trials_file(path)? {
            self.trials.extend(read_trials(path, &mut self.warnings)?);
        } else {
            self.runs.push(Run::load_file(path, &mut self.warnings)?);
        }
        Ok(())
    }

    fn read_directory(&mut self, path: &Path) -> Result<(), Error> {
        let mut found = FoundPaths::default();
        found.search(path, MAX_DEPTH, Parent::Directory)?;
        if found.run_dirs.is_empty() && found.trials_files.is_empty() {
            return Err(Error::NoResults { path: path.to_owned() });
        }
        let mut first_error = None;
        let n_before = self.runs.len() + self.trials.len();
        for dir in &found.run_dirs {
            if !self.is_new(dir) {
                continue;
            }
            match Run::load(dir, &mut self.warnings) {
                Ok(run) => self.runs.push(run),
                Err(error) => {
                    self.warnings.push(format!("{} is ignored: {error}", dir.display()));
                    first_error.get_or_insert(error);
                }
            }
        }
        for file in &found.trials_files {
            if !self.is_new(file) {
                continue;
            }
            match read_trials(file, &mut self.warnings) {
                Ok(rows) => self.trials.extend(rows),
                Err(error) => {
                    self.warnings.push(format!("ignored: {error}"));
                    first_error.get_or_insert(error);
                }
            }
        }
        let n_read = self.runs.len() + self.trials.len() - n_before;
        first_error.filter(|_| n_read == 0).map_or(Ok(()), Err)
    }
}

/// Returns the path without links and `..`; that of a new file if its directory exists.
fn resolved(path: &Path) -> Option<PathBuf> {
    path.canonicalize().ok().or_else(|| {
        let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
        let parent = parent.unwrap_or(Path::new(".")).canonicalize().ok()?;
        Some(parent.join(path.file_name()?))
    })
}

/// Paths of runs and trials in a directory.
#[derive(Debug, Default)]
struct FoundPaths {
    run_dirs: Vec<PathBuf>,
    trials_files: Vec<PathBuf>,
    /// The canonical paths of the directories that were searched: links may lead to one several times, or in circles.
    searched: BTreeSet<PathBuf>,
}

/// The kind of directory that contains a searched one. Within a run directory, a metrics file alone does not make a
/// run: the directory of another run has a configuration as well.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Parent {
    Directory,
    Run,
}

impl FoundPaths {
    /// Adds `dir` itself and its subdirectories, in alphabetical order. Links are followed.
    fn search(&mut self, dir: &Path, depth: usize, parent: Parent) -> Result<(), Error> {
        if !self.searched.insert(dir.canonicalize().unwrap_or_else(|_| dir.to_owned())) {
            return Ok(());
        }
        let is_run = dir.join("metrics.jsonl").is_file()
            && (parent == Parent::Directory || dir.join("run.toml").is_file());
        if is_run {
            self.run_dirs.push(dir.to_owned());
        }
        let trials_file = dir.join(TRIALS_FILE);
        if trials_file.is_file() {
            self.trials_files.push(trials_file);
        }
        let parent = if is_run { Parent::Run } else { parent };
        let entries = std::fs::read_dir(dir).map_err(read_error(dir))?;
        let paths = entries.flatten().map(|entry| entry.path());
        let mut children: Vec<PathBuf> = paths.filter(|path| path.is_dir()).collect();
        children.sort();
        for child in children.iter().filter(|_| depth > 0) {
            match self.search(child, depth - 1, parent) {
                // An unreadable subdirectory of a run does not make the run unreadable.
                Err(_) if parent == Parent::Run => {}
                other => other?,
            }
        }
        Ok(())
    }
}

/// Returns true if a single file contains trials, judging by its name or else by its first line.
fn is_trials_file(path: &Path) -> Result<bool, Error> {
    if path.file_name().is_some_and(|name| name == TRIALS_FILE) {
        return Ok(true);
    }
    let bytes = read_bytes(path)?;
    let first = bytes.split(|byte| *byte == b'\n').next().unwrap_or_default();
    Ok(serde_json::from_slice::<TrialRow>(first).is_ok())
}

/// Reads the trials of a file up to the first invalid line, which adds a warning. A file without a trial is an error.
fn read_trials(path: &Path, warnings: &mut Vec<String>) -> Result<Vec<TrialRow>, Error> {
    let (rows, invalid) = read_rows::<TrialRow>(path)?;
    if rows.is_empty() {
        let problem = invalid.map_or_else(
            || "it is empty".to_owned(),
            |InvalidLine { line, problem }| format!("line {line} is not a trial ({problem})"),
        );
        return Err(Error::NoTrials { path: path.to_owned(), problem });
    }
    warnings.extend(invalid.map(|invalid| invalid.warning(path, "trial")));
    Ok(rows)
}

#[cfg(test)]
mod tests {
    use tandem_telemetry::MetricsRow;

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
    fn runs_are_found_at_any_depth_of_a_directory() {
        let dir = tempfile::tempdir().unwrap();
        write(&dir.path().join("b/metrics.jsonl"), &line(1));
        write(&dir.path().join("deep/a/metrics.jsonl"), &line(1));
        write(&dir.path().join("deep/a/checkpoint/metrics.jsonl"), &line(1));
        write(&dir.path().join("lone.jsonl"), &line(1));
        let inputs =
            ReportInputs::load(&[dir.path().to_owned(), dir.path().join("lone.jsonl")]).unwrap();
        let names: Vec<&str> = inputs.runs.iter().map(|run| run.name.as_str()).collect();
        assert_eq!(names, ["b", "a", "lone"]);
        assert!(inputs.warnings.is_empty(), "{:?}", inputs.warnings);
    }

    #[test]
    fn runs_within_the_directory_of_a_run_are_found() {
        let dir = tempfile::tempdir().unwrap();
        let run = |name: &str| {
            write(&dir.path().join(name).join("metrics.jsonl"), &line(1));
            write(&dir.path().join(name).join("run.toml"), "task = \"push\"\n");
        };
        for name in ["runs", "runs/b", "runs/sweep/a", "runs/sweep/a/deeper"] {
            run(name);
        }
        write(&dir.path().join("runs/checkpoint/metrics.jsonl"), &line(1));
        write(&dir.path().join("runs/policy/run.toml"), "");
        let inputs = ReportInputs::load(&[dir.path().join("runs")]).unwrap();
        let names: Vec<&str> = inputs.runs.iter().map(|run| run.name.as_str()).collect();
        assert_eq!(names, ["runs", "b", "a", "deeper"]);
        assert!(inputs.warnings.is_empty(), "{:?}", inputs.warnings);
    }

    #[test]
    fn links_are_followed_and_a_run_that_they_lead_to_twice_is_counted_once() {
        let dir = tempfile::tempdir().unwrap();
        let path = |name: &str| dir.path().join(name);
        write(&path("disk/a/metrics.jsonl"), &line(1));
        write(&path("runs/b/metrics.jsonl"), &line(1));
        let link = |to: &str, name: &str| std::os::unix::fs::symlink(path(to), path(name)).unwrap();
        link("disk/a", "runs/a");
        link("runs/b", "runs/latest");
        link("runs", "runs/b/up");
        link("missing", "runs/broken");
        let inputs = ReportInputs::load(&[path("runs")]).unwrap();
        let names: Vec<&str> = inputs.runs.iter().map(|run| run.name.as_str()).collect();
        assert_eq!(names, ["a", "b"]);
        assert!(inputs.warnings.is_empty(), "{:?}", inputs.warnings);
    }

    #[test]
    fn a_run_file_that_is_no_toml_adds_a_warning() {
        let dir = tempfile::tempdir().unwrap();
        write(&dir.path().join("a/metrics.jsonl"), &line(1));
        write(&dir.path().join("a/run.toml"), "task = \n");
        let inputs = ReportInputs::load(&[dir.path().to_owned()]).unwrap();
        let [warning] = &inputs.warnings[..] else { panic!("{:?}", inputs.warnings) };
        assert!(warning.contains("a/run.toml is not TOML ("), "{warning}");
        assert_eq!((inputs.runs.len(), &inputs.runs[0].configuration), (1, &None));
    }

    #[test]
    fn the_files_of_runs_and_trials_are_inputs() {
        let dir = tempfile::tempdir().unwrap();
        let path = |name: &str| dir.path().join(name);
        write(&path("a/metrics.jsonl"), &line(1));
        write(&path("a/run.toml"), "");
        write(&path("a/report.html"), "");
        write(&path("a/policy/best.safetensors"), "");
        write(&path("a/checkpoint/round/state"), "");
        write(&path("b/trials.jsonl"), &trial(1));
        let inputs = ReportInputs::load(&[dir.path().to_owned()]).unwrap();
        for name in [
            "a/metrics.jsonl",
            "a/run.toml",
            "a/../a/run.toml",
            "a/summary.json",
            "a/policy/best.safetensors",
            "a/policy/teacher.toml",
            "a/checkpoint/round/state",
            "b/trials.jsonl",
        ] {
            assert!(inputs.contains(&path(name)), "{name}");
        }
        for name in ["a/report.html", "a/runs.csv", "a/policy", "b/policy.csv", "run.toml"] {
            assert!(!inputs.contains(&path(name)), "{name}");
        }
    }

    #[test]
    fn a_directory_whose_only_run_cannot_be_read_is_an_error() {
        let dir = tempfile::tempdir().unwrap();
        write(&dir.path().join("a/metrics.jsonl"), &line(1));
        std::fs::write(dir.path().join("a/run.toml"), b"name = \"\xff\"").unwrap();
        let error = ReportInputs::load(&[dir.path().to_owned()]).unwrap_err();
        assert!(error.to_string().contains("run.toml"), "{error}");
        write(&dir.path().join("b/metrics.jsonl"), &line(1));
        let inputs = ReportInputs::load(&[dir.path().to_owned()]).unwrap();
        assert_eq!((inputs.runs.len(), inputs.warnings.len()), (1, 1));
    }

    #[test]
    fn a_metrics_file_is_read_up_to_the_first_invalid_line() {
        let check = |tail: &str| {
            let dir = tempfile::tempdir().unwrap();
            write(&dir.path().join("metrics.jsonl"), &(line(1) + &line(2) + tail));
            let inputs = ReportInputs::load(&[dir.path().to_owned()]).unwrap();
            let rounds: Vec<u64> = inputs.runs[0].rows.iter().map(|row| row.round).collect();
            assert_eq!(rounds, [1, 2], "{tail:?}");
            assert_eq!(inputs.warnings.len(), 1, "{:?}", inputs.warnings);
            assert!(inputs.warnings[0].contains("line 3"), "{:?}", inputs.warnings);
        };
        check(&line(3)[..40]);
        check(&(line(3)[..40].to_owned() + "\n" + &line(4)));
        check("nonsense\n");
        check("\u{0}\n");
    }

    fn trial(trial: u64) -> String {
        let row = TrialRow {
            policy: "student".to_owned(),
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
            tolerance_m: Some(0.05),
            starts: Vec::new(),
            goals: Vec::new(),
            ends: Vec::new(),
            path: Vec::new(),
            log: None,
        };
        serde_json::to_string(&row).unwrap() + "\n"
    }

    #[test]
    fn trials_are_found_within_runs_in_other_directories_and_as_single_files() {
        let dir = tempfile::tempdir().unwrap();
        write(&dir.path().join("a/metrics.jsonl"), &line(1));
        write(&dir.path().join("a/trials/trials.jsonl"), &trial(1));
        write(&dir.path().join("b/trials.jsonl"), &(trial(2) + &trial(3)));
        write(&dir.path().join("kept.jsonl"), &trial(4));
        let inputs =
            ReportInputs::load(&[dir.path().to_owned(), dir.path().join("kept.jsonl")]).unwrap();
        let numbers: Vec<u64> = inputs.trials.iter().map(|row| row.trial).collect();
        assert_eq!((numbers, inputs.runs.len()), (vec![1, 2, 3, 4], 1));
        assert!(inputs.warnings.is_empty(), "{:?}", inputs.warnings);
    }

    #[test]
    fn a_trials_file_is_read_up_to_the_first_invalid_line() {
        let dir = tempfile::tempdir().unwrap();
        for tail in [&trial(3)[..200], "nonsense\n", &trial(3).replace("\"seed\":1", "\"seed\":-1")]
        {
            write(&dir.path().join("trials.jsonl"), &(trial(1) + &trial(2) + tail));
            let inputs = ReportInputs::load(&[dir.path().to_owned()]).unwrap();
            assert_eq!(inputs.trials.len(), 2, "{tail:?}");
            let [warning] = &inputs.warnings[..] else { panic!("{:?}", inputs.warnings) };
            assert!(warning.contains("trials.jsonl, line 3, is not a trial ("), "{warning}");
            assert!(!warning.contains("line 1"), "{warning}");
        }
    }

    #[test]
    fn a_file_without_trials_is_an_error_unless_the_directory_has_other_results() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("mine/trials.jsonl");
        for (content, reason) in
            [("", "it is empty"), ("{}\n", "line 1 is not a trial (missing field")]
        {
            write(&file, content);
            for path in [dir.path().to_owned(), file.clone()] {
                let error = ReportInputs::load(&[path]).unwrap_err();
                assert!(matches!(error, Error::NoTrials { .. }), "{error:?}");
                assert!(error.to_string().contains(reason), "{error}");
            }
        }
        write(&dir.path().join("a/metrics.jsonl"), &line(1));
        let inputs = ReportInputs::load(&[dir.path().to_owned()]).unwrap();
        assert_eq!((inputs.runs.len(), inputs.trials.len(), inputs.warnings.len()), (1, 0, 1));
    }

    #[test]
    fn a_metrics_file_without_rows_is_an_error_alone_and_an_empty_run_in_its_directory() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("metrics.jsonl");
        for content in ["", "\u{1b}[31mred\n"] {
            write(&file, content);
            assert!(
                matches!(
                    ReportInputs::load(std::slice::from_ref(&file)),
                    Err(Error::NoMetrics { .. })
                ),
                "{content:?}"
            );
            assert!(ReportInputs::load(&[dir.path().to_owned()]).unwrap().runs[0].rows.is_empty());
        }
    }

    #[test]
    fn a_path_without_results_is_an_error() {
        let dir = tempfile::tempdir().unwrap();
        assert!(matches!(
            ReportInputs::load(&[dir.path().to_owned()]),
            Err(Error::NoResults { .. })
        ));
        assert!(matches!(ReportInputs::load(&[dir.path().join("missing")]), Err(Error::Io { .. })));
    }
}
