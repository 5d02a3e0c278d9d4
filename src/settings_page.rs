//! `tandem train --settings`: every setting of a run, with its meaning, its range and its value under each recipe.
//!
//! Meanings are the doc comments of the settings, ranges are those of the messages that reject a value, and values are
//! the recipes', so the page cannot differ from what a run accepts. `docs/settings.md` is this page.

use schemars::generate::SchemaSettings;
use serde_json::{Value as Json, json};
use tandem_core::{Task, TaskSpec};
use tandem_rl::RunConfig;
use tandem_rl::config::{INIT_TEACHER, Recipe};
use tandem_teacher::Strategy;
use toml::{Table, Value};

use crate::columns::wrapped;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{output, run_file};

const INTRODUCTION: &str = "\
A setting is changed with `--set KEY=VALUE`, or in a run file (`--run FILE.toml`), where the part of a key before the \
dot is a section. A recipe gives each setting its value; `--recipe` selects it. Values are those of `shared-push` with two \
arms, followed by those of other tasks and of one arm where they differ. A task that is not built-in has a section \
`[description]`, which docs/environments.md describes.";

/// A setting of the run file.
struct Setting {
    /// Its dotted name.
    key: String,
    meaning: String,
    range: String,
    /// Its value under recipes `tandem` and `paper`.
    values: [String; 2],
}

/// A section of the run file.
struct Section {
    /// Its name; empty for settings that are in none.
    name: String,
    meaning: String,
    settings: Vec<Setting>,
}

/// Prints all settings.
pub(crate) fn print(as_json: bool) -> Result<(), Failed> {
    let sections = sections().or_exit(Exit::Bug, String::new)?;
    match as_json {
        true => output::print(as_json_list(&sections)),
        false => output::print(page(&sections).trim_end()),
    }
}

/// Returns the page as Markdown that also reads well on a terminal.
fn page(sections: &[Section]) -> String {
    let mut page = format!("# Settings of a run\n\n{}\n", wrapped(INTRODUCTION, ""));
    for Section { name, meaning, settings } in sections {
        let title = if name.is_empty() { "The run" } else { &format!("`[{name}]`") };
        page.push_str(&format!("\n## {title}\n\n"));
        if !meaning.is_empty() {
            page.push_str(&format!("{}\n\n", wrapped(meaning, "")));
        }
        for Setting { key, meaning, range, values: [tandem, paper] } in settings {
            let values = match tandem == paper {
                true => format!("Default: {tandem}."),
                false => format!("Default: {tandem} (tandem), {paper} (paper)."),
            };
            let text = format!("- `{key}`: {meaning} Range: {range}. {values}");
            page.push_str(&wrapped(&text, "  "));
            page.push('\n');
        }
    }
    page
}

fn as_json_list(sections: &[Section]) -> Json {
    let settings = sections.iter().flat_map(|section| &section.settings);
    let entry = |Setting { key, meaning, range, values: [tandem, paper] }: &Setting| json!({ "key": key, "meaning": meaning, "range": range, "tandem": tandem, "paper": paper });
    settings.map(entry).collect()
}

fn sections() -> anyhow::Result<Vec<Section>> {
    let schema = SchemaSettings::default()
        .with(|settings| settings.inline_subschemas = true)
        .into_generator()
        .into_root_schema_for::<RunConfig>();
    let schema = schema.to_value();
    let values = Values::of_recipes()?;
    let mut sections =
        vec![Section { name: String::new(), meaning: String::new(), settings: vec![] }];
    for (name, value) in &values.shown {
        let property = &schema["properties"][name];
        let setting = |key: String, property: &Json| Setting {
            meaning: description(property),
            range: range(&key),
            values: values.of(&key),
            key,
        };
        match value {
            Value::Table(section) => {
                let settings = section
                    .keys()
                    .map(|key| setting(format!("{name}.{key}"), &property["properties"][key]));
                sections.push(Section {
                    name: name.clone(),
                    meaning: description(property),
                    settings: settings.collect(),
                });
            }
            _ => sections[0].settings.push(setting(name.clone(), property)),
        }
    }
    Ok(sections)
}

/// Returns the doc comment of a setting as one paragraph.
fn description(property: &Json) -> String {
    let text = property["description"].as_str().unwrap_or_default();
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// The values of all settings under each recipe, for each kind of run.
struct Values {
    /// The settings of one kind of run, in the order of the run file.
    shown: Table,
    /// For each recipe a description of each kind of run and its settings, the one with two arms and push first.
    recipes: [Vec<(&'static str, Table)>; 2],
}

/// For each kind of run, the kinds whose values it need not repeat.
const GENERALIZED_BY: [&[usize]; 9] =
    [&[], &[], &[], &[1, 2], &[], &[1, 4], &[2, 4], &[3, 5, 6], &[]];

impl Values {
    fn of_recipes() -> anyhow::Result<Self> {
        let kinds = [
            ("", Task::SharedPush, 2),
            ("with one arm", Task::SharedPush, 1),
            ("in pick-and-place", Task::SharedPickAndPlace, 2),
            ("in pick-and-place with one arm", Task::SharedPickAndPlace, 1),
            ("in the classic world", Task::Push, 2),
            ("in the classic world with one arm", Task::Push, 1),
            ("in classic pick-and-place", Task::PickAndPlace, 2),
            ("in classic pick-and-place with one arm", Task::PickAndPlace, 1),
            ("in carry-bar", Task::CarryBar, 2),
        ];
        let of_recipe = |recipe| -> anyhow::Result<Vec<(&'static str, Table)>> {
            let values = |(kind, task, n_arms): (&'static str, Task, usize)| {
                let config = RunConfig::defaults_of(recipe, &TaskSpec::built_in(task, n_arms));
                Ok((kind, Table::try_from(config)?))
            };
            kinds.into_iter().map(values).collect()
        };
        let recipes = [of_recipe(Recipe::Tandem)?, of_recipe(Recipe::Paper)?];
        Ok(Self { shown: recipes[0][0].1.clone(), recipes })
    }

    /// Returns the value of the setting `key` under each recipe.
    fn of(&self, key: &str) -> [String; 2] {
        self.recipes.each_ref().map(|kinds| {
            let values: Vec<(&str, String)> =
                kinds.iter().map(|(kind, table)| (*kind, text_at(table, key))).collect();
            let (_, usual) = &values[0];
            // A kind is omitted if all printed kinds that generalize it have its value or, if none is printed, if it has
            // the usual value.
            let differs = |(idx, (_, value)): &(usize, &(&str, String))| {
                let general = GENERALIZED_BY[*idx].iter().map(|of| &values[*of].1);
                let mut printed = general.filter(|of| *of != usual).peekable();
                match printed.peek() {
                    Some(_) => printed.any(|of| of != value),
                    None => value != usual,
                }
            };
            let others = values.iter().enumerate().filter(differs);
            let others = others.map(|(_, (kind, value))| format!(", {value} {kind}"));
            format!("{usual}{}", others.collect::<String>())
        })
    }
}

/// Returns the value of a dotted key as text.
fn text_at(settings: &Table, key: &str) -> String {
    let value = match key.split_once('.') {
        Some((section, name)) => settings.get(section).and_then(|section| section.get(name)),
        None => settings.get(key),
    };
    match value {
        Some(Value::String(text)) => format!("`{text}`"),
        // The shortest text of a number with the precision that networks have.
        Some(Value::Float(number)) => shortest(*number),
        Some(value) => value.to_string(),
        None => String::new(),
    }
}

/// Returns the values that the setting `key` can have, from the message that rejects another one.
fn range(key: &str) -> String {
    if key == "advice.strategy" {
        return format!("{}, {INIT_TEACHER}", Strategy::NAMES.join(", "));
    }
    let probes = [
        Value::Float(f64::NAN),
        Value::Integer(0),
        Value::Integer(i64::from(i32::MAX)),
        Value::Integer(i64::MAX),
        Value::String("?".to_owned()),
    ];
    let expected = |probe: Value| {
        let rejected = run_file::resolve(None, &[(key.to_owned(), probe)]).err()?.line();
        let rejected = rejected.strip_prefix(key)?;
        Some(rejected.split_once("expected ")?.1.replace('`', ""))
    };
    // A value of another type is rejected for its type.
    let is_type = |text: &String| {
        ["a string", "an integer", "a number", "true or false", "a value"].contains(&text.as_str())
    };
    let answers: Vec<String> = probes.into_iter().filter_map(expected).collect();
    let of_range = answers.iter().find(|text| !is_type(text));
    match (of_range, answers.first().map(String::as_str)) {
        (Some(range), _) => range.clone(),
        (None, Some("an integer")) => "0 or more".to_owned(),
        (None, Some(kind)) => kind.to_owned(),
        (None, None) => "any".to_owned(),
    }
}

/// Returns the fewest digits of a number that the settings hold in single precision.
#[expect(clippy::cast_possible_truncation, reason = "settings are in single precision")]
fn shortest(number: f64) -> String {
    (number as f32).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_setting_has_a_meaning_and_the_page_in_the_documentation_is_current() {
        let sections = sections().expect("the recipes are valid");
        let settings: Vec<&Setting> =
            sections.iter().flat_map(|section| &section.settings).collect();
        assert!(settings.len() > 50, "{} settings", settings.len());
        for setting in settings {
            let Setting { key, meaning, .. } = setting;
            assert!(meaning.ends_with('.'), "{key}: {meaning:?} is no sentence");
            assert!(!meaning.contains("](") && !meaning.contains("[`"), "{key}: a link: {meaning}");
        }
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/settings.md");
        let documented = std::fs::read_to_string(path).expect("docs/settings.md");
        assert_eq!(
            documented,
            page(&sections),
            "update it: tandem train --settings > docs/settings.md"
        );
    }

    #[test]
    fn ranges_are_those_of_the_checks() {
        for (key, expected) in [
            ("ddpg.discount", "a number in [0, 1)"),
            ("rounds.lag", "0 or 1"),
            ("behaviour", "target or online"),
            ("checkpoint.keep", "at least 1"),
            ("stop.max_env_steps", "0 or more"),
            ("replay.joint_goal_statistics", "true or false"),
            ("world.substeps", "10 or 20"),
        ] {
            assert_eq!(range(key), expected, "{key}");
        }
    }
}
