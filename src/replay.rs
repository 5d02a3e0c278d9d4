//! `tandem replay`: simulates recorded episodes again and compares them with their logs.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use anyhow::anyhow;
use indicatif::ProgressBar;
use rayon::iter::{IntoParallelIterator as _, ParallelIterator as _};
use serde_json::{Value, json};
use tandem_core::TaskSpec;
use tandem_core::text::{counted, error_chain};
use tandem_picture::FilmEpisode;
use tandem_telemetry::{EpisodeLog, read_episode};
use tandem_worker::EnvironmentConfig;
use tandem_worker::record::{RecordError, world_of};
use tandem_worker::replay::{replay_log, replay_log_on};

use crate::cli::ReplayArgs;
use crate::environment_server::{EnvironmentSource, names_server};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::film::PlannedFilm;
use crate::service::worker_failed;
use crate::{access, film, live, output, runtime};

/// Maximum number of logs in a film.
const MAX_FILMED: usize = 100;

mod steps;

/// A log that was simulated again.
struct Replayed {
    file: PathBuf,
    outcome: Result<(), RecordError>,
    /// The log ends before its episode does.
    cut_short: bool,
}

/// The server of environments that the command line names. It simulates the episodes of its own task.
struct Server {
    runtime: runtime::Runtime,
    source: EnvironmentSource,
    config: EnvironmentConfig,
    task: TaskSpec,
}

pub(crate) fn replay(args: &ReplayArgs) -> Result<(), Failed> {
    let planned = PlannedFilm::of(&args.film)?;
    let files = find_logs(&args.files)?;
    if let Some(address) = args.live.live {
        if planned.is_some() || args.json || names_server(&args.environment) {
            return Err(Failed::usage(
                "--live only shows the episodes: leave out --film, --json, --env and --env-command",
            ));
        }
        return live::serve(address, &files);
    }
    if let Some(film) = planned {
        film.write(&filmed(&files)?)?;
        if !args.json {
            output::print(film)?;
        }
    }
    let is_printed = !args.verify && !args.json && args.film.film.is_none();
    let printed = if let ([file], true) = (files.as_slice(), is_printed) {
        steps::print(file)?;
        true
    } else {
        false
    };
    let server = Server::start(args)?.map(Mutex::new);
    let replayed = replay_all(files, server.as_ref());
    if let Some(server) = server {
        server.into_inner().unwrap_or_else(PoisonError::into_inner).end();
    }
    let replayed = replayed?;
    if let ([Replayed { outcome: Err(error @ RecordError::NoSimulator { .. }), .. }], true) =
        (replayed.as_slice(), printed)
    {
        return output::print(format_args!("not compared: {error}"));
    }
    let (trials, episodes): (Vec<Replayed>, Vec<Replayed>) =
        replayed.into_iter().partition(Replayed::is_trial);
    // Logs of trials beside episodes are expected: a directory of runs may contain both.
    match (trials.as_slice(), episodes.as_slice()) {
        ([trial, ..], []) => Err(trial.only_trials(trials.len())),
        _ => {
            print_result(&episodes, &trials, args.json)?;
            result(&episodes)
        }
    }
}

/// Simulates the logged episodes again, for a film.
fn filmed(files: &[PathBuf]) -> Result<Vec<FilmEpisode>, Failed> {
    if files.len() > MAX_FILMED {
        return Err(Failed::usage(format!(
            "--film of {} episodes: name at most {MAX_FILMED} logs",
            files.len()
        )));
    }
    let of_log = |file: &PathBuf| {
        let log = read_episode(file).or_exit(Exit::Data, String::new)?;
        let context = || file.display().to_string();
        let world = world_of(&log.metadata).map_err(|error| {
            let exit = match error {
                RecordError::NoSimulator { .. } => Exit::Usage,
                _ => Exit::Data,
            };
            Failed::new(exit, error).context(context())
        })?;
        let actions = log.transitions.iter().map(|step| step.action.as_slice());
        film::of_actions(world, actions, log.metadata.episode).or_exit(Exit::Data, context)
    };
    files.iter().map(of_log).collect()
}

/// Simulates all logs again.
fn replay_all(
    files: Vec<PathBuf>,
    server: Option<&Mutex<Server>>,
) -> Result<Vec<Replayed>, Failed> {
    let bar = ProgressBar::new(files.len() as u64);
    let replay_one = |file| {
        let replayed = Replayed::of(file, server);
        bar.inc(1);
        replayed
    };
    let replayed: Vec<Replayed> = files.into_par_iter().map(replay_one).collect();
    bar.finish_and_clear();
    replayed.into_iter().map(Replayed::on_working_server).collect()
}

/// Returns the failure that the first problem causes. A log that only other environments can simulate is a problem if
/// there is no other one.
fn result(replayed: &[Replayed]) -> Result<(), Failed> {
    let (not_simulated, bad): (Vec<&Replayed>, Vec<&Replayed>) =
        replayed.iter().filter(|log| log.outcome.is_err()).partition(|log| log.is_not_simulated());
    let problems = |logs: &[&Replayed]| -> Vec<String> {
        logs.iter().filter_map(|log| log.problem()).collect()
    };
    match (problems(&bad).as_slice(), problems(&not_simulated).as_slice()) {
        ([], []) => Ok(()),
        ([problem], _) => Err(Failed::new(Exit::Data, anyhow!("{problem}"))),
        ([first, ..], _) => {
            let n_differing = bad.iter().filter(|log| log.differs()).count();
            let counts = [
                (n_differing, "differ", "differs"),
                (bad.len() - n_differing, "cannot be read", "cannot be read"),
            ];
            let counts = counts.into_iter().filter(|(n, ..)| *n > 0).map(|(n, many, one)| {
                let verb = if n == 1 { one } else { many };
                format!("{} {verb}", counted(n, "log"))
            });
            let counts = counts.collect::<Vec<_>>().join(", ");
            Err(Failed::new(Exit::Data, anyhow!("{counts}, the first: {first}")))
        }
        ([], [problem]) => Err(Failed::usage(problem)),
        ([], [first, ..]) => Err(Failed::usage(format!(
            "{} logs were not simulated again, the first: {first}",
            not_simulated.len()
        ))),
    }
}

impl Server {
    /// Connects to the server that the command line names, if there is one.
    fn start(args: &ReplayArgs) -> Result<Option<Self>, Failed> {
        let client_config = access::client_config(&args.client_config, &args.secret)?;
        let source = EnvironmentSource::of(&args.environment, &client_config)?;
        let Some(config) = source.config() else { return Ok(None) };
        let runtime = runtime::new().or_exit(Exit::TryAgain, String::new)?;
        let served = runtime.block_on(async {
            let served = source.served_task().await;
            if served.is_err() {
                source.end().await;
            }
            served.map_err(worker_failed)
        })?;
        Ok(served.map(|served| Self { runtime, source, config, task: served.task }))
    }

    fn replay(&self, log: &EpisodeLog) -> Result<(), RecordError> {
        self.runtime.block_on(replay_log_on(self.config.clone(), log))
    }

    /// Ends the server if this process has started it.
    fn end(self) {
        self.runtime.block_on(self.source.end());
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
        collect_logs(path, &mut files, &mut BTreeSet::new())
            .or_exit(Exit::Data, || format!("cannot read the directory {}", path.display()))?;
        if files.len() == n_before {
            return Err(Failed::new(Exit::Data, anyhow!("no *.mcap below {}", path.display())));
        }
    }
    Ok(files)
}

/// Adds the logs in and below a directory. Links are followed; a directory among `searched`, to which one may lead again,
/// is left out.
fn collect_logs(
    directory: &Path,
    files: &mut Vec<PathBuf>,
    searched: &mut BTreeSet<PathBuf>,
) -> std::io::Result<()> {
    if !searched.insert(directory.canonicalize()?) {
        return Ok(());
    }
    let mut entries = std::fs::read_dir(directory)?.collect::<Result<Vec<_>, _>>()?;
    entries.sort_by_key(std::fs::DirEntry::path);
    for entry in entries {
        let path = entry.path();
        if path.is_dir() {
            collect_logs(&path, files, searched)?;
        } else if path.extension().is_some_and(|extension| extension == "mcap") {
            files.push(path);
        }
    }
    Ok(())
}

impl Replayed {
    fn of(file: PathBuf, server: Option<&Mutex<Server>>) -> Self {
        let log = match read_episode(&file) {
            Ok(log) => log,
            Err(error) => return Self { file, outcome: Err(error.into()), cut_short: false },
        };
        let on_server = server.and_then(|server| {
            let server = server.lock().unwrap_or_else(PoisonError::into_inner);
            (server.task == log.metadata.task).then(|| server.replay(&log))
        });
        let outcome = on_server.unwrap_or_else(|| replay_log(&log));
        Self { file, outcome, cut_short: log.last_observation.is_none() }
    }

    /// Returns the failure of the server if it failed on this log.
    fn on_working_server(self) -> Result<Self, Failed> {
        match self.outcome {
            Err(RecordError::Environment(error)) => {
                Err(worker_failed(*error).context(self.file.display().to_string()))
            }
            _ => Ok(self),
        }
    }

    /// Returns true if only environments that were not given can simulate the log.
    const fn is_not_simulated(&self) -> bool {
        matches!(self.outcome, Err(RecordError::NoSimulator { .. }))
    }

    /// Returns true if the file is the log of a trial or of a bridge's motion instead of an episode.
    const fn is_trial(&self) -> bool {
        use tandem_telemetry::Error as E;
        matches!(self.outcome, Err(RecordError::Log(E::TrialLog { .. } | E::MotionLog { .. })))
    }

    /// Returns true if the simulation differs from the log.
    const fn differs(&self) -> bool {
        matches!(self.outcome, Err(RecordError::Differs { .. }))
    }

    /// Returns the error of a command that found `n_trials` logs of trials, this one first, and no episode.
    fn only_trials(&self, n_trials: usize) -> Failed {
        let first = self.problem().unwrap_or_default();
        let message = match n_trials {
            1 => first,
            _ => {
                format!("no log of an episode among {n_trials} logs of trials, the first: {first}")
            }
        };
        Failed::new(Exit::Data, anyhow!("{message}"))
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

fn print_result(replayed: &[Replayed], trials: &[Replayed], json: bool) -> Result<(), Failed> {
    let (n_episodes, n_equal) =
        (replayed.len(), replayed.iter().filter(|log| log.outcome.is_ok()).count());
    let cut_short = replayed.iter().filter(|log| log.cut_short && !log.is_not_simulated());
    let cut_short: Vec<_> = cut_short.map(shown).collect();
    let not_simulated: Vec<_> =
        replayed.iter().filter(|log| log.is_not_simulated()).map(shown).collect();
    let bad = || replayed.iter().filter(|log| log.outcome.is_err() && !log.is_not_simulated());
    let trials: Vec<_> = trials.iter().map(shown).collect();
    if json {
        let (differing, unreadable): (Vec<&Replayed>, _) = bad().partition(|log| log.differs());
        let [differing, unreadable] =
            [differing, unreadable].map(|logs| logs.into_iter().map(problem_json).collect());
        let (differing, unreadable): (Value, Value) = (differing, unreadable);
        output::print(json!({
            "episodes": n_episodes, "equal": n_equal, "differing": differing, "unreadable": unreadable,
            "not_simulated": not_simulated, "cut_short": cut_short, "trials": trials,
        }))?;
        return Ok(());
    }
    bad().filter_map(Replayed::problem).try_for_each(output::print)?;
    output::print(format_args!("{n_equal} of {n_episodes} episodes equal bit for bit"))?;
    if !not_simulated.is_empty() {
        output::print(format_args!("{} of them not simulated again", not_simulated.len()))?;
    }
    if !trials.is_empty() {
        output::print(format_args!("{} left out", counted(trials.len(), "trial log")))?;
    }
    if !cut_short.is_empty() {
        output::print(format_args!(
            "{} of them compared only as far as their logs go",
            cut_short.len()
        ))?;
    }
    Ok(())
}

/// Returns the name of a log's file, which need not be UTF-8.
fn shown(log: &Replayed) -> Cow<'_, str> {
    log.file.to_string_lossy()
}

fn problem_json(log: &Replayed) -> Value {
    match &log.outcome {
        Err(RecordError::Differs { step, field, component, logged, played }) => json!({
            "file": shown(log), "step": step, "field": field, "component": component, "logged": logged,
            "played": played,
        }),
        _ => json!({ "file": shown(log), "problem": log.problem() }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logs_behind_links_are_found_once() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = |name: &str| directory.path().join(name);
        for name in ["disk/run", "runs/other"] {
            std::fs::create_dir_all(path(name)).expect("creates");
            std::fs::write(path(name).join("eval-000001-000.mcap"), "").expect("writes");
        }
        let link = |to: &str, name: &str| std::os::unix::fs::symlink(path(to), path(name));
        link("disk/run", "runs/linked").expect("links");
        link("runs", "runs/other/up").expect("links");
        link("runs/other", "runs/same").expect("links");
        let logs = find_logs(&[path("runs")]).expect("logs");
        let expected =
            ["runs/linked", "runs/other"].map(|run| path(run).join("eval-000001-000.mcap"));
        assert_eq!(logs, expected);
    }
}
