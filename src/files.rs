//! Commands about files: policies and logs.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::anyhow;
use indicatif::ProgressBar;
use rayon::iter::{IntoParallelIterator as _, ParallelIterator as _};
use serde_json::{Value, json};
use tandem_core::text::error_chain;
use tandem_policy::Policy;
use tandem_telemetry::{LoggedTransition, read_episode};
use tandem_worker::record::{RecordError, replay_log};

use crate::cli::{McapArgs, McapCommand, PolicyArgs, PolicyCommand, ReplayArgs};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::output;

/// Loads a policy file, or says in one line why it cannot be used.
pub(crate) fn load_policy(path: &Path) -> Result<Policy, Failed> {
    Policy::load(path).or_exit(Exit::Data, String::new)
}

pub(crate) fn policy(args: &PolicyArgs) -> Result<(), Failed> {
    let PolicyCommand::Show { file, json } = &args.command;
    let policy = load_policy(file)?;
    let metadata: BTreeMap<_, _> = policy.metadata.iter().collect();
    if *json {
        let shown = json!({
            "task": policy.layout.task.name(), "arms": policy.layout.n_arms, "n_hidden": policy.n_hidden,
            "n_hidden_layers": policy.n_hidden_layers, "critic_heads": policy.n_heads, "digest": policy.digest(),
            "metadata": metadata,
        });
        output::print(shown)?;
        return Ok(());
    }
    output::print(format_args!("task          {}", policy.layout.task))?;
    output::print(format_args!("arms          {}", policy.layout.n_arms))?;
    output::print(format_args!(
        "networks      {} hidden layers of {}, critic heads {}",
        policy.n_hidden_layers, policy.n_hidden, policy.n_heads
    ))?;
    output::print(format_args!(
        "parameters    actor {}, critic {}",
        policy.actor.len(),
        policy.critic.len()
    ))?;
    output::print(format_args!("digest        {}", policy.digest()))?;
    for (key, value) in metadata {
        let [key, value] = [key, value].map(|text| output::escaped(text).replace('\n', "\\n"));
        output::print(format_args!("{key:<22} {value}"))?;
    }
    Ok(())
}

pub(crate) fn mcap(args: &McapArgs) -> Result<(), Failed> {
    use tandem_telemetry::Error as E;
    let McapCommand::Recover { file, to } = &args.command;
    let to =
        to.clone().unwrap_or_else(|| PathBuf::from(format!("{}.recovered.mcap", file.display())));
    if to.exists() {
        return Err(Failed::usage(format!(
            "{} exists: choose another file with --to",
            to.display()
        )));
    }
    let recovered = tandem_telemetry::recover(file, &to);
    let counts = match recovered {
        Err(E::WriteLog { .. }) => recovered.or_cannot_write(String::new),
        _ => recovered.or_exit(Exit::Data, String::new),
    }?;
    output::print(format_args!(
        "recovered {} messages of {} into {}",
        counts.messages,
        file.display(),
        to.display()
    ))?;
    Ok(())
}

/// A log that was played again.
struct Replayed {
    file: PathBuf,
    outcome: Result<(), RecordError>,
    /// Whether the log ends before its episode does.
    cut_short: bool,
}

pub(crate) fn replay(args: &ReplayArgs) -> Result<(), Failed> {
    let files = logs_among(&args.files)?;
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
    print_replayed(&replayed, args.json)?;
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

/// The logs that are named, and those in and below the directories that are named, in the order of their names.
fn logs_among(named: &[PathBuf]) -> Result<Vec<PathBuf>, Failed> {
    let mut files = Vec::new();
    for path in named {
        if !path.is_dir() {
            files.push(path.clone());
            continue;
        }
        let n_before = files.len();
        collect_logs(path, &mut files)
            .or_exit(Exit::Data, || format!("cannot look into {}", path.display()))?;
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

    /// What is wrong with which file, in one line.
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

fn print_replayed(replayed: &[Replayed], json: bool) -> Result<(), Failed> {
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
