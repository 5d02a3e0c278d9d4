//! The sweep file: settings of all runs, and lists whose combinations are the runs.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, anyhow, bail, ensure};
use serde::Deserialize;
use tandem_rl::RunConfig;
use toml::{Table, Value};

use crate::cli::EnvironmentArgs;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{input, run_file, served_task};

/// A larger number of runs is treated as a mistake.
const MAX_RUNS: usize = 10_000;

/// The contents of a sweep file. Lists must not be empty.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct SweepFile {
    /// Tasks; without a list, the task of `[run]`.
    tasks: Option<Vec<String>>,
    /// Values of `advice.strategy`; each is a column of the sweep, like each variant.
    strategies: Option<Vec<String>>,
    /// Seeds; without a list, the seed of `[run]`.
    seeds: Option<Vec<u64>>,
    /// Further settings to combine; each table has one setting with its list of values.
    axis: Option<Vec<Table>>,
    /// Named sets of settings that override `[run]`.
    variant: Option<Vec<Variant>>,
    /// Settings of all runs, as in a run file.
    run: Table,
    /// Settings of the runs of a task in `tasks`, which override `[run]`.
    per_task: BTreeMap<String, Table>,
    /// Teacher policy files by task; the default is the shipped teacher.
    teachers: BTreeMap<String, PathBuf>,
    /// The server of the environments of all runs, as the options of `tandem train`.
    env: Option<String>,
    env_command: Option<String>,
    env_timeout_s: Option<f64>,
    env_token_file: Option<PathBuf>,
    env_tls_ca: Option<PathBuf>,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct Variant {
    name: String,
    #[serde(default)]
    set: Table,
}

/// A sweep, as its file describes it.
#[derive(Debug)]
pub(super) struct PlannedSweep {
    /// The runs, in order.
    pub(super) runs: Vec<PlannedRun>,
    /// The server of their environments, if they are not simulated by their workers.
    pub(super) environment: EnvironmentArgs,
}

/// A run of the sweep.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct PlannedRun {
    /// Name of its directory.
    pub(super) name: String,
    /// The resolved settings, which with the teacher determine the result.
    pub(super) config: RunConfig,
    /// The teacher policy file, if the sweep file names one.
    pub(super) teacher: Option<PathBuf>,
}

/// Settings with a name that becomes part of the name of the run directory.
#[derive(Debug, Clone)]
struct Choice {
    name: String,
    settings: Vec<(String, Value)>,
}

/// Reads the sweep file `path`. If it names a server of environments and no task, asks the server for its task.
pub(super) fn read(path: &Path) -> Result<PlannedSweep, Failed> {
    let context = || format!("sweep file {path:?}");
    let text = input::text(path).context("cannot be read").or_exit(Exit::Usage, context)?;
    let file = parse(&text).or_exit(Exit::Usage, context)?;
    let environment = environment(&file).or_exit(Exit::Usage, context)?;
    let served = match names_task(&file) {
        true => None,
        false => {
            served_task::of_server(&environment).map_err(|failed| failed.context(context()))?
        }
    };
    let of_server = served.map(|served| served_task::settings(&served.task));
    let runs = runs(&file, &of_server.transpose()?.unwrap_or_default());
    Ok(PlannedSweep { runs: runs.or_exit(Exit::Usage, context)?, environment })
}

fn parse(text: &str) -> anyhow::Result<SweepFile> {
    let file: SweepFile = toml::from_str(text).map_err(|error| parse_error(text, &error))?;
    reject_empty(&file)?;
    Ok(file)
}

/// Returns the options of the environments' server.
fn environment(file: &SweepFile) -> anyhow::Result<EnvironmentArgs> {
    ensure!(
        file.env.is_none() || file.env_command.is_none(),
        "env and env_command are both set: expected one of them"
    );
    for (key, path) in [("env_token_file", &file.env_token_file), ("env_tls_ca", &file.env_tls_ca)]
    {
        ensure!(path.is_none() || file.env.is_some(), "{key} is set without env");
    }
    ensure!(
        file.env_timeout_s.is_none() || file.env.is_some() || file.env_command.is_some(),
        "env_timeout_s is set without env and env_command"
    );
    let timeout = file.env_timeout_s.map(Duration::try_from_secs_f64).transpose().ok();
    let timeout = timeout.filter(|timeout| timeout.is_none_or(|timeout| !timeout.is_zero()));
    let expected = "env_timeout_s: expected a number of seconds, more than 0";
    Ok(EnvironmentArgs {
        env: file.env.clone(),
        env_command: file.env_command.clone(),
        env_timeout_s: timeout.context(expected)?,
        env_token_file: file.env_token_file.clone(),
        env_tls_ca: file.env_tls_ca.clone(),
    })
}

fn names_task(file: &SweepFile) -> bool {
    file.tasks.is_some() || ["task", "description"].iter().any(|key| file.run.contains_key(*key))
}

/// Returns all combinations that `file` lists, with seeds as the outermost loop: a sweep that is stopped early has one
/// seed of every combination. `of_server` describes the task if the file does not name one.
fn runs(file: &SweepFile, of_server: &[(String, Value)]) -> anyhow::Result<Vec<PlannedRun>> {
    let base = [of_server, &flattened(&file.run)].concat();
    let (tasks, seeds) =
        (tasks(file)?, choices("seed", listed(&file.seeds).iter().map(seed_value)));
    let (columns, axes) = (columns(file, &base)?, axes(file)?);
    let n_runs = [tasks.len(), seeds.len(), columns.len(), axes.len()].iter().product::<usize>();
    ensure!(n_runs <= MAX_RUNS, "lists {n_runs} runs: expected at most {MAX_RUNS}");
    let mut runs = Vec::with_capacity(n_runs);
    for (seed, task) in pairs(&seeds, &tasks) {
        for (column, axis) in pairs(&columns, &axes) {
            // Settings of [per_task.TASK], after the task itself, may be overridden.
            let of_task = task.settings.get(..1).unwrap_or_default();
            reject_set_twice([
                ("tasks", of_task),
                ("strategies and variants", &column.settings),
                ("axes", &axis.settings),
                ("seeds", &seed.settings),
            ])?;
            let mut settings = base.clone();
            for choice in [task, column, axis, seed] {
                settings.extend(choice.settings.iter().cloned());
            }
            runs.push(planned(&settings, &column.name, &axis.name, &file.teachers)?);
        }
    }
    reject_equal_names(&runs)?;
    reject_other_teachers(&file.teachers, &runs)?;
    Ok(runs)
}

/// Rejects an empty file and empty lists, which would otherwise mean a single run.
fn reject_empty(file: &SweepFile) -> anyhow::Result<()> {
    ensure!(
        *file != SweepFile::default(),
        "is empty: expected lists to combine, such as seeds = [1, 2]"
    );
    let lengths = [
        ("tasks", file.tasks.as_ref().map(Vec::len)),
        ("strategies", file.strategies.as_ref().map(Vec::len)),
        ("seeds", file.seeds.as_ref().map(Vec::len)),
        ("axis", file.axis.as_ref().map(Vec::len)),
        ("variant", file.variant.as_ref().map(Vec::len)),
    ];
    match lengths.iter().find(|(_, length)| *length == Some(0)) {
        Some((key, _)) => {
            bail!("{key} is an empty list: expected at least one entry, or no {key} at all")
        }
        None => Ok(()),
    }
}

fn planned(
    settings: &[(String, Value)],
    column: &str,
    axis: &str,
    teachers: &BTreeMap<String, PathBuf>,
) -> anyhow::Result<PlannedRun> {
    let mut settings = settings.to_vec();
    let limits_time = settings.iter().any(|(key, _)| key == "stop.max_minutes");
    if !limits_time {
        // Runs that are compared have no time limit unless the sweep file sets one.
        settings.push(("stop.max_minutes".to_owned(), Value::Float(0.0)));
    }
    let resolved = run_file::resolve(None, &settings).map_err(Failed::into_error)?;
    let column =
        if column.is_empty() { sanitized(&resolved.advice.strategy) } else { column.to_owned() };
    let task = sanitized(&resolved.task);
    let name = format!("{task}-{column}{axis}-seed{}", resolved.seed);
    ensure!(
        tandem_rl::config::is_name(&name),
        "{name:?} is no name of a run: expected 1 to 100 letters, digits, '-', '_' or '.'"
    );
    let stop = &resolved.stop;
    ensure!(
        stop.max_env_steps > 0 || stop.max_minutes > 0.0,
        "{name} may never end: set stop.max_env_steps or stop.max_minutes in [run]"
    );
    let teacher = teachers.get(&resolved.task).filter(|_| resolved.advice.needs_teacher()).cloned();
    Ok(PlannedRun { config: RunConfig { name: name.clone(), ..resolved }, name, teacher })
}

fn reject_equal_names(runs: &[PlannedRun]) -> anyhow::Result<()> {
    let mut seen = BTreeSet::new();
    match runs.iter().find(|run| !seen.insert(&run.name)) {
        Some(run) => bail!("two runs would be called {}: something is listed twice", run.name),
        None => Ok(()),
    }
}

/// Rejects settings that two lists of the file set, or one of them twice: runs would differ in their names only.
fn reject_set_twice(lists: [(&str, &[(String, Value)]); 4]) -> anyhow::Result<()> {
    let mut set_by = BTreeMap::new();
    for (list, (key, _)) in
        lists.iter().flat_map(|(list, all)| all.iter().map(move |one| (list, one)))
    {
        match set_by.insert(key, list) {
            Some(other) if other == list => bail!("{key} is set twice by {list}"),
            Some(other) => bail!("{key} is set by {other} and by {list}: expected one of them"),
            None => {}
        }
    }
    Ok(())
}

/// Rejects a teacher of a task that no run has. The tasks of runs have their full names.
fn reject_other_teachers(
    teachers: &BTreeMap<String, PathBuf>,
    runs: &[PlannedRun],
) -> anyhow::Result<()> {
    let tasks: BTreeSet<&str> = runs.iter().map(|run| run.config.task.as_str()).collect();
    let other = teachers.keys().find(|task| !tasks.contains(task.as_str()));
    other.map_or(Ok(()), |task| {
        let tasks = Vec::from_iter(tasks).join(", ");
        bail!("[teachers] {task}: expected the name of a task of the runs: {tasks}")
    })
}

/// Returns the entries of an optional list.
fn listed<T>(list: &Option<Vec<T>>) -> &[T] {
    list.as_deref().unwrap_or_default()
}

/// Returns the tasks, each with its own settings.
fn tasks(file: &SweepFile) -> anyhow::Result<Vec<Choice>> {
    let tasks = listed(&file.tasks);
    if let Some(task) = file.per_task.keys().find(|task| !tasks.contains(task)) {
        bail!("[per_task.{task}]: expected a task that `tasks` lists");
    }
    let mut choices = choices("task", tasks.iter().cloned().map(Value::String));
    for (choice, task) in choices.iter_mut().zip(tasks) {
        choice.settings.extend(file.per_task.get(task).map(flattened).unwrap_or_default());
    }
    Ok(choices)
}

/// Returns a choice for each value of `key`, or one without settings if there are no values.
fn choices(key: &str, values: impl Iterator<Item = Value>) -> Vec<Choice> {
    let choice =
        |value: Value| Choice { name: String::new(), settings: vec![(key.to_owned(), value)] };
    or_default_choice(values.map(choice).collect())
}

fn or_default_choice(choices: Vec<Choice>) -> Vec<Choice> {
    match choices.is_empty() {
        true => vec![Choice { name: String::new(), settings: Vec::new() }],
        false => choices,
    }
}

/// Returns the strategies, then the variants.
fn columns(file: &SweepFile, base: &[(String, Value)]) -> anyhow::Result<Vec<Choice>> {
    const STRATEGY: &str = "advice.strategy";
    if file.strategies.is_some()
        && base.iter().any(|(key, _)| key == STRATEGY)
        && file.variant.is_none()
    {
        bail!("{STRATEGY} is set in [run] and in `strategies`: expected one of them");
    }
    let mut columns: Vec<Choice> = listed(&file.strategies)
        .iter()
        .map(|strategy| Choice {
            name: sanitized(strategy),
            settings: vec![(STRATEGY.to_owned(), Value::String(strategy.clone()))],
        })
        .collect();
    for Variant { name, set } in listed(&file.variant) {
        ensure!(!name.is_empty(), "a variant has no name");
        columns.push(Choice { name: name.clone(), settings: flattened(set) });
    }
    Ok(or_default_choice(columns))
}

/// Returns all combinations of the values of the axes. Each value adds `-KEY-VALUE` to the name, without the section of
/// the key.
fn axes(file: &SweepFile) -> anyhow::Result<Vec<Choice>> {
    let mut combinations = or_default_choice(Vec::new());
    for axis in listed(&file.axis) {
        let [(key, Value::Array(values))] = &flattened(axis)[..] else {
            let held = axis.to_string().trim().replace('\n', ", ");
            bail!("[[axis]] holds {held}: expected one setting with a list of values");
        };
        ensure!(!values.is_empty(), "the list of axis {key} is empty");
        let n_runs = combinations.len() * values.len();
        ensure!(n_runs <= MAX_RUNS, "lists {n_runs} runs and more: expected at most {MAX_RUNS}");
        let short = key.rsplit('.').next().unwrap_or(key);
        let with = |(before, value): (&Choice, &Value)| Choice {
            name: format!("{}-{short}-{}", before.name, sanitized(&unquoted(value))),
            settings: [before.settings.clone(), vec![(key.clone(), value.clone())]].concat(),
        };
        combinations = pairs(&combinations, values).map(with).collect();
    }
    Ok(combinations)
}

/// Formats a value for a name: text has no quotes.
fn unquoted(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

/// Replaces characters that do not belong in the name of a directory by dashes.
fn sanitized(text: &str) -> String {
    let letter = |c: char| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '-' };
    text.chars().map(letter).collect()
}

/// Returns the dotted names and the values of all settings in `table`.
pub(super) fn flattened(table: &Table) -> Vec<(String, Value)> {
    let below = |(key, value): (&String, &Value)| match value {
        Value::Table(inner) => flattened(inner)
            .into_iter()
            .map(|(rest, value)| (format!("{key}.{rest}"), value))
            .collect(),
        value => vec![(key.clone(), value.clone())],
    };
    table.iter().flat_map(below).collect()
}

/// Returns all pairs of an element of `outer` and one of `inner`, in order.
fn pairs<'a, A, B>(outer: &'a [A], inner: &'a [B]) -> impl Iterator<Item = (&'a A, &'a B)> {
    outer.iter().flat_map(move |a| inner.iter().map(move |b| (a, b)))
}

/// Converts a seed to TOML. A seed too large for TOML becomes text, which the check of the settings rejects.
fn seed_value(n: &u64) -> Value {
    i64::try_from(*n).map_or_else(|_| Value::String(n.to_string()), Value::Integer)
}

/// Converts an error of the TOML parser to one line with the line number.
fn parse_error(text: &str, error: &toml::de::Error) -> anyhow::Error {
    let start = error.span().map_or(0, |span| span.start);
    let line_idx = text.get(..start).unwrap_or(text).matches('\n').count();
    anyhow!("line {}: {}", line_idx + 1, error.message().replace('\n', " "))
}

#[cfg(test)]
mod tests;
