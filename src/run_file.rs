//! From recipe, run file and command line to one checked configuration.

use std::path::Path;

use anyhow::{Context as _, anyhow, bail};
use tandem_core::Task;
use tandem_learner::RunConfig;
use tandem_learner::config::Recipe;
use toml::{Table, Value};

use crate::exit::{Exit, Failed, OrExit as _};

/// Reads a run file and lays `settings` (`key=value`) over it; what both leave out takes the recipe's values.
pub(crate) fn resolve(
    file: Option<&Path>,
    settings: &[(String, Value)],
) -> Result<RunConfig, Failed> {
    let from_file = match file {
        Some(path) => read(path).or_exit(Exit::Usage, String::new)?,
        None => Table::new(),
    };
    let told = || file.map_or_else(String::new, |path| format!("run file {}", path.display()));
    overlay(from_file, settings).or_exit(Exit::Usage, told)
}

/// Splits `key=value`; the value is TOML where it can be read as such, else text.
pub(crate) fn parse_setting(setting: &str) -> Result<(String, Value), Failed> {
    let Some((key, text)) = setting.split_once('=') else {
        return Err(Failed::usage(format!("--set {setting:?} is not of the form KEY=VALUE")));
    };
    Ok((key.trim().to_owned(), parse_value(text.trim())))
}

/// The configuration as a TOML document with every setting.
pub(crate) fn to_toml(config: &RunConfig) -> anyhow::Result<String> {
    Ok(toml::to_string_pretty(config)?)
}

fn parse_value(text: &str) -> Value {
    let document = format!("value = {text}");
    let parsed = document.parse::<Table>().ok().and_then(|mut table| table.remove("value"));
    parsed.unwrap_or_else(|| Value::String(text.to_owned()))
}

fn read(path: &Path) -> anyhow::Result<Table> {
    let text =
        std::fs::read_to_string(path).with_context(|| format!("cannot read run file {path:?}"))?;
    let table = text.parse::<Table>();
    table.map_err(|error| anyhow!("run file {path:?}: {}", error.to_string().replace('\n', " ")))
}

fn overlay(from_file: Table, settings: &[(String, Value)]) -> anyhow::Result<RunConfig> {
    let mut changes = from_file;
    for (key, value) in settings {
        set(&mut changes, key, value.clone())?;
    }
    let mut resolved = Table::try_from(defaults_for(&changes)?)?;
    merge(&mut resolved, changes, "")?;
    let config: RunConfig = Value::Table(resolved)
        .try_into()
        .map_err(|error: toml::de::Error| anyhow!("{}", error.message()))?;
    Ok(config.checked()?)
}

/// The recipe's values for the task and arms that the changes choose.
fn defaults_for(changes: &Table) -> anyhow::Result<RunConfig> {
    let recipe = match changes.get("recipe").and_then(Value::as_str) {
        None | Some("tandem") => Recipe::Tandem,
        Some("paper") => Recipe::Paper,
        Some(other) => bail!("recipe is {other:?}: expected \"tandem\" or \"paper\""),
    };
    let task: Task = changes.get("task").and_then(Value::as_str).unwrap_or("push").parse()?;
    let arms = changes.get("arms").and_then(Value::as_integer).unwrap_or(2);
    let n_arms = usize::try_from(arms).ok().filter(|n_arms| (1..=2).contains(n_arms));
    Ok(RunConfig::defaults(
        recipe,
        task,
        n_arms.ok_or_else(|| anyhow!("arms is {arms}: expected 1 or 2"))?,
    ))
}

/// Sets the value of a dotted key.
fn set(table: &mut Table, key: &str, value: Value) -> anyhow::Result<()> {
    match key.split_once('.') {
        None => {
            table.insert(key.to_owned(), value);
            Ok(())
        }
        Some((section, rest)) => {
            let section = table.entry(section).or_insert_with(|| Value::Table(Table::new()));
            let inner =
                section.as_table_mut().ok_or_else(|| anyhow!("{key:?} is not a setting"))?;
            set(inner, rest, value)
        }
    }
}

/// Lays `changes` over `base`; a key that `base` lacks is unknown. Whole numbers are taken where fractions are meant.
fn merge(base: &mut Table, changes: Table, path: &str) -> anyhow::Result<()> {
    for (key, change) in changes {
        let name = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
        let known: Vec<String> = base.keys().cloned().collect();
        match (base.get_mut(&key), change) {
            (None, _) => bail!("unknown setting {name:?}: expected one of {}", known.join(", ")),
            (Some(Value::Table(inner)), Value::Table(changes)) => merge(inner, changes, &name)?,
            (Some(Value::Table(_)), _) => bail!("{name:?} is a section, not a setting"),
            (Some(slot @ Value::Float(_)), Value::Integer(whole)) => {
                *slot = Value::Float(whole as f64);
            }
            (Some(slot), change) => {
                if !slot.same_type(&change) {
                    bail!("{name} is {change}: expected a {}", slot.type_str());
                }
                *slot = change;
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn resolved(settings: &[&str]) -> Result<RunConfig, String> {
        let settings: Vec<_> =
            settings.iter().map(|setting| parse_setting(setting).expect("KEY=VALUE")).collect();
        overlay(Table::new(), &settings).map_err(|error| error.to_string())
    }

    #[test]
    fn settings_change_what_they_name_and_nothing_else() {
        let config = resolved(&["arms=1", "ddpg.discount=0.9", "advice.budget=7"]).expect("valid");
        let mut expected = RunConfig::defaults(Recipe::Tandem, Task::Push, 1);
        expected.ddpg.discount = 0.9;
        expected.advice.budget = 7;
        assert_eq!(config, expected);
    }

    #[test]
    fn what_is_wrong_is_named() {
        let check = |setting: &str, words: &[&str]| {
            let message = resolved(&[setting]).expect_err("must be refused");
            words
                .iter()
                .for_each(|word| assert!(message.contains(word), "{message:?} lacks {word:?}"));
        };
        check("ddpg.discont=0.9", &["ddpg.discont", "discount"]);
        check("nonsense=1", &["nonsense", "advice"]);
        check("ddpg=1", &["ddpg", "section"]);
        check("advice.budget=many", &["advice.budget", "integer"]);
        check("recipe=mine", &["mine", "paper"]);
        check("arms=3", &["arms", "1 or 2"]);
        check("ddpg.discount=nan", &["ddpg.discount"]);
    }

    #[test]
    fn every_run_file_that_ships_is_valid() {
        let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy");
        let files =
            std::fs::read_dir(directory).expect("ships").flatten().map(|entry| entry.path());
        let run_files: Vec<_> =
            files.filter(|path| path.extension().is_some_and(|e| e == "toml")).collect();
        assert!(run_files.len() >= 4);
        for path in run_files {
            assert!(resolve(Some(&path), &[]).is_ok(), "{}", path.display());
        }
    }

    #[test]
    fn a_written_configuration_is_read_back() {
        let config = RunConfig::defaults(Recipe::Paper, Task::PickAndPlace, 2);
        let text = to_toml(&config).expect("writes");
        assert_eq!(overlay(text.parse().expect("TOML"), &[]).expect("valid"), config);
    }
}
