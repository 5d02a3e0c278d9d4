//! Combines recipe, run file and command line into one checked configuration.

use std::path::Path;

use anyhow::{Context as _, anyhow, bail};
use tandem_core::settings::OutOfRange;
use tandem_core::{Task, TaskDescription, TaskSpec};
use tandem_rl::RunConfig;
use tandem_rl::config::{ConfigError, INIT_TEACHER, Recipe, UnknownRecipe, former_keys};
use tandem_system::atomic_file;
use tandem_teacher::{Strategy, UnknownStrategy};
use toml::{Table, Value};

use crate::exit::{Exit, Failed, OrExit as _};
use crate::input;
use former::{current_keys, is_removed, with_added};

mod former;
mod other_names;

/// The section that describes a task which is not built-in. It is one value: its keys are no settings of their own.
const DESCRIPTION: &str = "description";

/// Evaluations after the initial one that a run with a limit of environment steps has at least.
const MIN_REGULAR_EVALUATIONS: u64 = 5;

/// The length to which texts in messages are shortened, in characters.
const MAX_SHOWN_CHARS: usize = 80;

/// Reads a run file and overrides it with `settings` (`key=value`). All other settings have the recipe's values.
pub(crate) fn resolve(
    file: Option<&Path>,
    settings: &[(String, Value)],
) -> Result<RunConfig, Failed> {
    let from_file = match file {
        Some(path) => read(path).or_exit(Exit::Usage, String::new)?,
        None => Table::new(),
    };
    let context = || file.map_or_else(String::new, |path| format!("run file {}", path.display()));
    overlay(from_file, settings).or_exit(Exit::Usage, context)
}

/// Splits `key=value`. A value that is not valid TOML is a string.
pub(crate) fn parse_setting(setting: &str) -> Result<(String, Value), Failed> {
    let Some((key, text)) = setting.split_once('=') else {
        return Err(Failed::usage(format!(
            "--set {:?} is not of the form KEY=VALUE",
            shortened(setting)
        )));
    };
    Ok((key.trim().to_owned(), parse_value(text.trim())))
}

/// Returns the text of a run file with every setting.
pub(crate) fn to_text(config: &RunConfig) -> Result<String, Failed> {
    let text = to_toml(config).or_exit(Exit::Bug, String::new)?;
    Ok(format!("# tandem {}\n{text}", crate::version::VERSION))
}

/// Returns the run file `text` of any version with every setting of this one, or `None` if it is not a valid run file.
pub(crate) fn completed(text: &str) -> Option<String> {
    let config = overlay(parse(text).ok()?, &[]).ok()?;
    to_toml(&config).ok()
}

/// Writes the configuration with every setting atomically.
pub(crate) fn save(config: &RunConfig, path: &Path) -> Result<(), Failed> {
    let written = atomic_file::replace(path, to_text(config)?.as_bytes());
    written.or_cannot_write(|| format!("cannot write {}", path.display()))
}

/// Returns the configuration as a TOML document with every setting.
pub(crate) fn to_toml(config: &RunConfig) -> anyhow::Result<String> {
    Ok(toml::to_string_pretty(config)?)
}

/// Parses the whole of `text` as a TOML value. Anything else, such as a value followed by a comment, is a string.
fn parse_value(text: &str) -> Value {
    let as_text = || Value::String(text.to_owned());
    if text.contains(['#', '\n']) && !text.starts_with(['"', '\'']) {
        return as_text();
    }
    text.parse().unwrap_or_else(|_: toml::de::Error| as_text())
}

fn read(path: &Path) -> anyhow::Result<Table> {
    let text = input::text(path).with_context(|| format!("cannot read run file {path:?}"))?;
    let mut run = parse(&text).map_err(|problem| anyhow!("run file {path:?}: {problem}"))?;
    if let Some(Value::String(description)) = run.get(DESCRIPTION) {
        let file = path.parent().unwrap_or(Path::new("")).join(description);
        run.insert(DESCRIPTION.to_owned(), Value::Table(read_description(&file)?));
    }
    Ok(run)
}

/// Reads the description of a task from a file of its own, which a run file names relative to its directory.
fn read_description(path: &Path) -> anyhow::Result<Table> {
    let text = input::text(path).with_context(|| format!("cannot read description {path:?}"))?;
    parse(&text).map_err(|problem| anyhow!("description {path:?}: {problem}"))
}

/// Parses a run file. The error is one line with the position and the cause.
fn parse(text: &str) -> Result<Table, String> {
    text.parse().map_err(|error: toml::de::Error| {
        let start = error.span().map_or(0, |span| span.start);
        let before = text.get(..start).unwrap_or(text);
        let line_idx = before.matches('\n').count();
        let line = text.lines().nth(line_idx).unwrap_or_default();
        let message = error.message().replace('\n', " ");
        format!("line {}: {message} in {:?}", line_idx + 1, shortened(line.trim()))
    })
}

fn overlay(from_file: Table, settings: &[(String, Value)]) -> anyhow::Result<RunConfig> {
    let mut changes = with_added(current_keys(from_file)?)?;
    for (key, value) in settings {
        if !is_removed(key, value)? {
            set(&mut changes, former_keys::current(key), value.clone())?;
        }
    }
    let defaults = Table::try_from(defaults_for(&changes)?)?;
    let mut resolved = defaults.clone();
    merge(&mut resolved, &changes, "", &names_below(&defaults, ""))?;
    let mut config = typed(resolved).map_err(|error| blame(&defaults, &changes, &error))?;
    let is_set = |key| changes.get("stop").is_some_and(|stop| stop.get(key).is_some());
    if config.stop.max_minutes > 0.0 && is_set("max_minutes") && !is_set("max_env_steps") {
        // A time limit that is set replaces the recipe's number of steps.
        config.stop.max_env_steps = 0;
    }
    set_evaluation_schedule(&mut config, &changes);
    let config = config.checked().map_err(in_one_line)?;
    if !config.advice.starts_from_teacher() {
        let strategy = config.advice.strategy.parse::<Strategy>();
        strategy.map_err(|UnknownStrategy(text)| {
            anyhow!("advice.strategy: {} (or {INIT_TEACHER})", UnknownStrategy(shortened(&text)))
        })?;
    }
    Ok(config)
}

/// Shortens the interval between evaluations for a run of few environment steps, unless the interval is set. A run that
/// sets it, or whose interval is shortened, has fewer early evaluations.
fn set_evaluation_schedule(config: &mut RunConfig, changes: &Table) {
    let is_set = |key| changes.get("evaluation").is_some_and(|section| section.get(key).is_some());
    let evaluation = &mut config.evaluation;
    let every_env_steps = shortened_interval(evaluation.every_env_steps, config.stop.max_env_steps);
    let n_early = match is_set("every_env_steps") {
        true => 0,
        false if every_env_steps < evaluation.every_env_steps => {
            evaluation.every_env_steps = every_env_steps;
            1
        }
        false => evaluation.early_points,
    };
    if !is_set("early_points") {
        evaluation.early_points = n_early;
    }
}

/// Returns the interval between evaluations, shortened for a run of few environment steps.
fn shortened_interval(every_env_steps: u64, max_env_steps: u64) -> u64 {
    match max_env_steps / MIN_REGULAR_EVALUATIONS {
        0 => every_env_steps,
        shortest => shortest.min(every_env_steps),
    }
}

/// Returns whether the interval between evaluations is the one that follows from recipe and length.
pub(crate) fn has_default_interval(config: &RunConfig) -> bool {
    let Ok(task) = config.task_spec() else { return false };
    let of_recipe = RunConfig::defaults_of(config.recipe, &task).evaluation;
    let default = shortened_interval(of_recipe.every_env_steps, config.stop.max_env_steps);
    config.evaluation.every_env_steps == default
}

/// Gives `config` the interval between evaluations of the `existing` run that it resumes, unless `config` sets its own: a
/// run that is made longer keeps the interval that it started with.
pub(crate) fn keep_interval(config: &mut RunConfig, existing: &RunConfig) {
    if has_default_interval(config) {
        config.evaluation.every_env_steps = existing.evaluation.every_env_steps;
    }
}

/// Formats an error on one line, with long texts shortened.
fn in_one_line(error: ConfigError) -> anyhow::Error {
    match error {
        ConfigError::OutOfRange(OutOfRange { key, value, expected }) => {
            let value = shortened(&value.escape_debug().to_string());
            anyhow!("{key} is {value}: expected {expected}")
        }
        ConfigError::Task(unknown) => anyhow!("task: {unknown}"),
        ConfigError::Description(_) => anyhow!("{error}"),
    }
}

fn typed(table: Table) -> Result<RunConfig, toml::de::Error> {
    Value::Table(table).try_into()
}

/// Describes the first change that is invalid by itself.
fn blame(defaults: &Table, changes: &Table, error: &toml::de::Error) -> anyhow::Error {
    for (name, value) in settings_below(changes, "") {
        let mut alone = defaults.clone();
        if set(&mut alone, &name, value.clone()).is_ok()
            && let Err(error) = typed(alone)
        {
            let expected = match (&value, error.message().rsplit_once("expected ")) {
                (Value::Integer(whole), _) if *whole < 0 => "0 or more",
                (_, Some((_, expected))) => expected,
                (_, None) => "another value",
            };
            return anyhow!("{name} is {}: expected {expected}", shown(&value));
        }
    }
    anyhow!("{}", shortened(error.message()))
}

/// Returns the recipe's values for the task and the number of arms that `changes` select.
fn defaults_for(changes: &Table) -> anyhow::Result<RunConfig> {
    let recipe = match changes.get("recipe").and_then(Value::as_str) {
        None => Recipe::Tandem,
        Some(name) => {
            name.parse::<Recipe>().map_err(|UnknownRecipe(name)| UnknownRecipe(shortened(&name)))?
        }
    };
    let defaults = RunConfig::defaults_of(recipe, &task_for(changes)?);
    let strategy = changes.get("advice").and_then(|advice| advice.get("strategy"));
    match strategy.and_then(Value::as_str) {
        Some(INIT_TEACHER) => Ok(defaults.sized_for_copies()),
        _ => Ok(defaults),
    }
}

/// The task that the changes choose: the described one, or a built-in one.
fn task_for(changes: &Table) -> anyhow::Result<TaskSpec> {
    if let Some(description) = changes.get(DESCRIPTION) {
        let description: TaskDescription =
            description.clone().try_into().map_err(|error: toml::de::Error| {
                anyhow!("description: {}", in_line(error.message()))
            })?;
        return TaskSpec::new(description).map_err(|error| anyhow!("description.{error}"));
    }
    let task = changes.get("task").and_then(Value::as_str).unwrap_or(Task::DEFAULT.name());
    let known_task = task.parse::<Task>().map_err(|_unknown| {
        let names = Task::ALL.map(Task::name).join(", ");
        anyhow!("task is {:?}: expected {names}, or a [description] of the task", shortened(task))
    });
    let arms = changes.get("arms").and_then(Value::as_integer).unwrap_or(2);
    let n_arms = usize::try_from(arms).ok().filter(|n_arms| (1..=2).contains(n_arms));
    let n_arms = n_arms.ok_or_else(|| anyhow!("arms is {arms}: expected 1 or 2"))?;
    let known_task = known_task?;
    if n_arms < known_task.min_arms() {
        bail!("arms is {arms}: expected {}, which {task} takes", known_task.min_arms());
    }
    Ok(TaskSpec::built_in(known_task, n_arms))
}

/// A message on one line.
fn in_line(message: &str) -> String {
    shortened(message.replace('\n', " ").trim())
}

/// Sets the value of a dotted key.
fn set(table: &mut Table, key: &str, value: Value) -> anyhow::Result<()> {
    match key.split_once('.') {
        None if value.is_table() && key != DESCRIPTION => {
            bail!("{:?} is {}: expected one value, not a section", shortened(key), shown(&value))
        }
        None => {
            table.insert(key.to_owned(), value);
            Ok(())
        }
        Some((section, rest)) => {
            let section = table.entry(section).or_insert_with(|| Value::Table(Table::new()));
            let inner = section
                .as_table_mut()
                .ok_or_else(|| anyhow!("{:?} is not a setting", shortened(key)))?;
            set(inner, rest, value)
        }
    }
}

/// Overrides values of `base` with `changes`. A key that `base` lacks is unknown. An integer is accepted for a float.
/// `known` lists all settings.
fn merge(base: &mut Table, changes: &Table, path: &str, known: &[String]) -> anyhow::Result<()> {
    for (key, change) in changes {
        let name = dotted(path, key);
        let siblings = || base.keys().cloned().collect::<Vec<_>>().join(", ");
        if !base.contains_key(key) {
            let hint = match (other_names::meaning(&name), nearest(&name, known)) {
                (Some(settings), _) => format!("here it is {settings}"),
                (None, Some(near)) => format!("did you mean {near:?}?"),
                (None, None) => format!("expected one of {}", siblings()),
            };
            bail!("unknown setting {:?}: {hint}", shortened(&name));
        }
        match (&mut base[key], change) {
            // The recipe's defaults already have the description.
            _ if name == DESCRIPTION => {}
            (Value::Table(inner), Value::Table(changes)) => merge(inner, changes, &name, known)?,
            (Value::Table(_), _) => bail!("{name:?} is a section, not a setting"),
            (slot @ Value::Float(_), Value::Integer(whole)) => *slot = Value::Float(*whole as f64),
            (slot, change) => {
                if !slot.same_type(change) {
                    bail!("{name} is {}: expected {}", shown(change), with_article(slot));
                }
                *slot = change.clone();
            }
        }
    }
    Ok(())
}

fn with_article(value: &Value) -> &'static str {
    match value {
        Value::String(_) => "a string",
        Value::Integer(_) => "an integer",
        Value::Float(_) => "a number",
        Value::Boolean(_) => "true or false",
        Value::Datetime(_) | Value::Array(_) | Value::Table(_) => "a value",
    }
}

fn dotted(path: &str, key: &str) -> String {
    if path.is_empty() { key.to_owned() } else { format!("{path}.{key}") }
}

/// Returns dotted names and values of all settings in and below `table`.
fn settings_below(table: &Table, path: &str) -> Vec<(String, Value)> {
    let below = |(key, value): (&String, &Value)| match value {
        Value::Table(inner) => settings_below(inner, &dotted(path, key)),
        value => vec![(dotted(path, key), value.clone())],
    };
    table.iter().flat_map(below).collect()
}

fn names_below(table: &Table, path: &str) -> Vec<String> {
    settings_below(table, path).into_iter().map(|(name, _)| name).collect()
}

/// Returns the known setting most similar to `name`: one with the same last part, or one that differs in few letters.
fn nearest<'a>(name: &str, known: &'a [String]) -> Option<&'a String> {
    if name.len() > MAX_SHOWN_CHARS {
        return None;
    }
    let last = |name: &str| name.rsplit('.').next().map(str::to_owned);
    let elsewhere = known.iter().find(|known| last(known) == last(name));
    let distances = known.iter().map(|known| (strsim::levenshtein(name, known), known));
    let close = distances.min().filter(|(n_edits, _)| *n_edits <= 2.max(name.len() / 5));
    elsewhere.or(close.map(|(_, known)| known))
}

/// Formats a value for a message.
fn shown(value: &Value) -> String {
    shortened(&value.to_string().replace('\n', " "))
}

/// Shortens a text that is too long for a line.
fn shortened(text: &str) -> String {
    tandem_core::text::shortened(text, MAX_SHOWN_CHARS)
}

#[cfg(test)]
mod tests;
