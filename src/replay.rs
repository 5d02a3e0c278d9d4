//! `tandem replay`: simulates recorded episodes again and compares them with their logs.

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use indicatif::ProgressBar;
use rayon::iter::{IntoParallelIterator as _, ParallelIterator as _};
use serde_json::{Value, json};
use tandem_core::text::error_chain;
use tandem_telemetry::{LoggedTransition, read_episode};
use tandem_worker::record::{RecordError, replay_log};

use crate::cli::ReplayArgs;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::output;

/// A log that was simulated again.
struct Replayed {
    file: PathBuf,
    outcome: Result<(), RecordError>,
    /// The log ends before its episode does.
    cut_short: bool,
}

pub(crate) fn replay(args: &ReplayArgs) -> Result<(), Failed> {
    let files = find_logs(&args.files)?;
    if let ([file], false, false) = (files.as_slice(), args.verify, args.json) {
        print_steps(file)?;
    }
    let bar = ProgressBar::new(files.len() as u64);
    let replay_one = |file| {
        let replayed = Replayed::of(file);
        bar.inc(1);
        replayed
    };
    let replayed: Vec<Replayed> = files.into_par_iter().map(replay_one).collect();
    bar.finish_and_clear();
    print_result(&replayed, args.json)?;
    let bad: Vec<String> = replayed.iter().filter_map(Replayed::problem).collect();
    match bad.as_slice() {
        [] => Ok(()),
        [problem] => Err(Failed::new(Exit::Data, anyhow!("{problem}"))),
        [first, ..] => Err(Failed::new(
            Exit::Data,
            anyhow!("{} logs differ or cannot be read, the first: {first}", bad.len()),
        )),
    }
}

/// Returns the named files, and the logs in and below the named directories in the order of their names.
fn find_logs(named: &[PathBuf]) -> Result<Vec<PathBuf>, Failed> {
    let mut files = Vec::new();
    for path in named {
        if !path.is_dir() {
            files.push(path.clone());
            continue;
        }
        let n_before = files.len();
        collect_logs(path, &mut files)
            .or_exit(Exit::Data, || format!("cannot read the directory {}", path.display()))?;
        if files.len() == n_before {
            return Err(Failed::new(Exit::Data, anyhow!("no *.mcap below {}", path.display())));
        }
    }
    Ok(files)
}

fn collect_logs(directory: &Path, files: &mut Vec<PathBuf>) -> std::io::Result<()> {
    let mut entries = std::fs::read_dir(directory)?.collect::<Result<Vec<_>, _>>()?;
    entries.sort_by_key(std::fs::DirEntry::path);
    for entry in entries {
        let path = entry.path();
        if entry.file_type()?.is_dir() {
            collect_logs(&path, files)?;
        } else if path.extension().is_some_and(|extension| extension == "mcap") {
            files.push(path);
        }
    }
    Ok(())
}

impl Replayed {
    fn of(file: PathBuf) -> Self {
        match read_episode(&file) {
            Ok(log) => {
                Self { file, outcome: replay_log(&log), cut_short: log.last_observation.is_none() }
            }
            Err(error) => Self { file, outcome: Err(error.into()), cut_short: false },
        }
    }

    /// Describes the problem on one line; `None` if the episode is equal.
    fn problem(&self) -> Option<String> {
        let error = self.outcome.as_ref().err()?;
        let file = self.file.display();
        Some(match error {
            RecordError::Log(_) => error_chain(error),
            _ => format!("{file}: {}", error_chain(error)),
        })
    }
}

fn print_steps(file: &Path) -> Result<(), Failed> {
    let log = read_episode(file).or_exit(Exit::Data, String::new)?;
    output::print(format_args!("episode {} of {}", log.metadata.episode, file.display()))?;
    for (step_idx, LoggedTransition { reward, action, .. }) in log.transitions.iter().enumerate() {
        output::print(format_args!("step {step_idx:>2}  reward {reward:>4.1}  action {action:?}"))?;
    }
    Ok(())
}

fn print_result(replayed: &[Replayed], json: bool) -> Result<(), Failed> {
    let (n_episodes, n_equal) =
        (replayed.len(), replayed.iter().filter(|log| log.outcome.is_ok()).count());
    let cut_short: Vec<&Path> =
        replayed.iter().filter(|log| log.cut_short).map(|log| log.file.as_path()).collect();
    let bad = || replayed.iter().filter(|log| log.outcome.is_err());
    if json {
        let (differing, unreadable): (Vec<&Replayed>, _) =
            bad().partition(|log| matches!(log.outcome, Err(RecordError::Differs { .. })));
        let [differing, unreadable] =
            [differing, unreadable].map(|logs| logs.into_iter().map(problem_json).collect());
        let (differing, unreadable): (Value, Value) = (differing, unreadable);
        output::print(json!({
            "episodes": n_episodes, "equal": n_equal, "differing": differing, "unreadable": unreadable,
            "cut_short": cut_short,
        }))?;
        return Ok(());
    }
    bad().filter_map(Replayed::problem).try_for_each(output::print)?;
    output::print(format_args!("{n_equal} of {n_episodes} episodes equal bit for bit"))?;
    if !cut_short.is_empty() {
        output::print(format_args!(
            "{} of them compared only as far as their logs go",
            cut_short.len()
        ))?;
    }
    Ok(())
}

fn problem_json(log: &Replayed) -> Value {
    match &log.outcome {
        Err(RecordError::Differs { step, field, component, logged, played }) => json!({
            "file": log.file, "step": step, "field": field, "component": component, "logged": logged,
            "played": played,
        }),
        _ => json!({ "file": log.file, "problem": log.problem() }),
    }
}
