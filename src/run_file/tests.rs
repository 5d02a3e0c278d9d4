//! Valid and invalid run files and settings, and the messages about invalid ones.

use proptest::collection::vec;
use proptest::prelude::{
    BoxedStrategy, Just, ProptestConfig, Strategy as _, any, prop_assert, prop_assert_eq,
    prop_oneof, proptest,
};
use proptest::sample::select;

use super::*;

fn resolved(settings: &[&str]) -> Result<RunConfig, String> {
    let settings: Vec<_> =
        settings.iter().map(|setting| parse_setting(setting).expect("KEY=VALUE")).collect();
    overlay(Table::new(), &settings).map_err(|error| error.to_string())
}

/// Resolves a run file with one or more lines.
fn from_text(text: &str) -> Result<RunConfig, String> {
    overlay(parse(text)?, &[]).map_err(|error| error.to_string())
}

#[test]
fn settings_change_only_what_they_name() {
    let config = resolved(&["arms=1", "ddpg.discount=0.9", "advice.budget=7"]).expect("valid");
    let mut expected = RunConfig::defaults(Recipe::Tandem, Task::DEFAULT, 1);
    expected.ddpg.discount = 0.9;
    expected.advice.budget = 7;
    assert_eq!(config, expected);
}

/// A run file for a task of two arms that is not built-in.
fn described() -> String {
    let description = TaskDescription {
        name: "lab/shove".to_owned(),
        episode_steps: 20,
        tolerance: 0.1,
        reports_contacts: false,
        ..tandem_core::Layout::new(Task::Push, 2).description()
    };
    let description = toml::to_string(&description).expect("a description");
    let sections = description.replace("[[arms]]", "[[description.arms]]");
    format!("task = \"lab/shove\"\narms = 2\n[description]\n{sections}")
}

#[test]
fn a_described_task_has_its_own_defaults_and_survives_the_file() {
    let config = from_text(&described()).expect("valid");
    let task = config.task_spec().expect("valid");
    assert_eq!((task.name(), task.n_arms(), task.episode_steps()), ("lab/shove", 2, 20));
    assert_eq!(task.as_built_in(), None);
    assert_eq!((config.replay.contact_cost, config.replay.arm_swap_prob), (0.0, 0.5));
    assert_eq!(config.env_steps_per_round(), 16 * 20);
    assert_eq!(from_text(&to_toml(&config).expect("written")), Ok(config));
    let built_in = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    assert!(!to_toml(&built_in).expect("written").contains("description"));
}

#[test]
fn an_interval_that_follows_from_a_described_tasks_length_is_the_default() {
    let resolved = |more: &str| from_text(&format!("{more}{}", described())).expect("valid");
    for recipe in ["paper", "tandem"] {
        let recipe = format!("recipe = \"{recipe}\"\n");
        assert!(has_default_interval(&resolved(&recipe)), "{recipe}");
        let longer = resolved(&format!("{recipe}stop.max_env_steps = 100_000_000\n"));
        assert!(has_default_interval(&longer), "{recipe}");
        let other = resolved(&format!("{recipe}evaluation.every_env_steps = 777\n"));
        assert!(!has_default_interval(&other), "{recipe}");
    }
}

#[test]
fn an_invalid_description_is_refused_by_field() {
    let check = |from: &str, to: &str, words: &str| {
        let changed = described().replacen(from, to, 1);
        let message = from_text(&changed).expect_err("must be refused");
        assert!(message.contains(words) && !message.contains('\n'), "{message:?}");
    };
    check("episode_steps = 20", "episode_steps = 0", "description.episode_steps: expected 1 to");
    check("tolerance = ", "tolerence = ", "description: unknown field `tolerence`");
    check("arms = 2", "arms = 1", "arms is 1: expected 2, as in the description");
    check("task = \"lab/shove\"", "task = \"push\"", "task is push: expected \"lab/shove\"");
}

#[test]
fn errors_name_the_setting() {
    let check = |setting: &str, words: &[&str]| {
        let message = resolved(&[setting]).expect_err("must be refused");
        words.iter().for_each(|word| assert!(message.contains(word), "{message:?} lacks {word:?}"));
        assert!(message.len() < 700 && !message.contains('\n'), "{message:?}");
    };
    check("ddpg.discont=0.9", &["ddpg.discont", "discount"]);
    check("nonsense=1", &["nonsense", "advice"]);
    check("ddpg=1", &["ddpg", "section"]);
    check("advice.budget=many", &["advice.budget", "integer"]);
    check("recipe=mine", &["mine", "paper"]);
    check("arms=3", &["arms", "1 or 2"]);
    check("ddpg.discount=nan", &["ddpg.discount"]);
    check("ddpg.discount=1e999", &["ddpg.discount", "1e999", "number"]);
    check("ddpg.discount=inf", &["ddpg.discount", "inf", "[0, 1)"]);
    check("ddpg.discount=", &["ddpg.discount", "\"\"", "number"]);
    check("discount=0.9", &["discount", "did you mean \"ddpg.discount\"?"]);
    check("ddpg.gamma=0.9", &["\"ddpg.gamma\": here it is ddpg.discount"]);
    check("learning_starts=9", &["here it is rounds.warmup_env_steps"]);
    check("ddpg.epochs=3", &["ddpg.epochs", "batch_size"]);
    check("ddpg.discount.x=1", &["ddpg.discount", "number"]);
    check("ddpg={ discount = 0.5 }", &["ddpg", "section"]);
    check("=5", &["unknown setting \"\""]);
    check("advice.budget=-1", &["advice.budget", "-1", "0 or more"]);
    check("rounds.lag=4294967296", &["rounds.lag", "4294967296", "u32"]);
    check("seed=18446744073709551616", &["seed", "18446744073709551616", "integer"]);
    check("behaviour=both", &["behaviour", "both", "online"]);
    check("replay.reward=3", &["replay.reward", "3", "string"]);
    check("task=shove", &["task", "shove", "pick-and-place"]);
    check("task=7", &["task", "7", "string"]);
    check("recipe=true", &["recipe", "true", "string"]);
    check("arms=[1]", &["arms", "[1]", "integer"]);
    check("arms=2.0", &["arms", "2.0", "integer"]);
    check("name=2024-01-01", &["name", "2024-01-01", "string"]);
    check("advice.strategy=bogus", &["advice.strategy", "bogus", "mc-q:T"]);
    check("advice.strategy=mc-q:-1", &["advice.strategy", "mc-q:-1", "0 or more"]);
    check("stop.max_minutes=nan", &["stop.max_minutes", "NaN"]);
    check("seed=1 # one", &["seed", "1 # one", "integer"]);
    check("seed=1\nname=\"other\"", &["seed", "integer"]);
    check("name=\"two\\nlines\"", &["name", "two\\nlines", "letters"]);
    check(&format!("name={}", "x".repeat(100_000)), &["name", "100000 bytes", "letters"]);
    check(&format!("{}=1", "x".repeat(100_000)), &["unknown setting", "100000 bytes"]);
}

#[test]
fn former_keys_still_set_what_they_named() {
    let file = "[replay]\nmoved_share = 0.25\nadvised_share = 0.0\n[ddpg]\ncloning_weight = 3\n";
    let config = from_text(file).expect("valid");
    assert_eq!((config.replay.displaced_fraction, config.ddpg.bc_weight), (0.25, 3.0));
    let layered = |setting: &str| {
        let setting = parse_setting(setting).expect("KEY=VALUE");
        overlay(parse(file).expect("TOML"), &[setting]).expect("valid").replay.displaced_fraction
    };
    assert_eq!(layered("replay.displaced_fraction=0.75"), 0.75, "the new key over the former one");
    assert_eq!(layered("replay.moved_share=1"), 1.0, "the former key over itself");
    for (former, current) in former_keys::RENAMED {
        let message = resolved(&[&format!("{former}=-1")]).expect_err("out of range");
        assert!(message.contains(current) && !message.contains(former), "{message:?}");
        let written = to_toml(&resolved(&[]).expect("valid")).expect("writes");
        let (_, name) = former.split_once('.').expect("a section");
        assert!(!written.contains(name), "{name} is written");
    }
    let both = "[replay]\nmoved_share = 0.25\ndisplaced_fraction = 0.25\n";
    assert_eq!(
        from_text(both),
        Err("replay.moved_share is the former name of replay.displaced_fraction: give one of them"
            .to_owned())
    );
}

#[test]
fn removed_settings_may_be_zero_only() {
    let expected =
        "world.wide_start_share is 0.5: the setting no longer exists, only 0 is accepted";
    assert_eq!(from_text("[world]\nwide_start_share = 0.5\n"), Err(expected.to_owned()));
    assert_eq!(resolved(&["world.wide_start_share=0.5"]), Err(expected.to_owned()));
    let config = resolved(&["world.wide_start_share=0", "replay.advised_share=0.0"]);
    assert_eq!(config, resolved(&[]));
}

#[test]
fn a_time_limit_replaces_the_recipes_number_of_steps() {
    let limits = |settings: &[&str]| {
        let stop = resolved(settings).expect("valid").stop;
        (stop.max_env_steps, stop.max_minutes)
    };
    assert_eq!(limits(&[]), (200_000, 0.0));
    assert_eq!(limits(&["stop.max_minutes=5"]), (0, 5.0));
    assert_eq!(limits(&["stop.max_minutes=0"]), (200_000, 0.0));
    assert_eq!(limits(&["stop.max_minutes=5", "stop.max_env_steps=100"]), (100, 5.0));
}

#[test]
fn a_complete_file_of_an_earlier_version_keeps_its_meaning() {
    let config = RunConfig::defaults(Recipe::Paper, Task::Push, 2);
    let mut file: Table = to_toml(&config).expect("writes").parse().expect("TOML");
    for (key, _) in former_keys::ADDED {
        let (section, name) = key.split_once('.').expect("in a section");
        let removed = file[section].as_table_mut().expect("a section").remove(name);
        assert!(removed.is_some(), "{key}");
    }
    let former = overlay(file, &[]).expect("valid");
    let tandem = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    assert_eq!(former.advice.terms(), tandem.advice.terms());
    assert_eq!(former.advice_budget(), 500_000);
    assert!(!former.exploration.joint_random_actions && !former.replay.joint_goal_statistics);
    let users = overlay(parse("recipe = \"paper\"").expect("TOML"), &[]).expect("valid");
    assert_eq!(users.advice, config.advice, "the recipe fills in a user's file");
}

#[test]
fn the_file_of_an_earlier_version_is_completed_for_comparisons() {
    let config = RunConfig::defaults(Recipe::Tandem, Task::CarryBar, 2);
    let written = to_toml(&config).expect("writes");
    let mut former: Table = written.parse().expect("TOML");
    for (key, _) in former_keys::ADDED {
        let (section, name) = key.split_once('.').expect("in a section");
        former[section].as_table_mut().expect("a section").remove(name);
    }
    let mut expected = config.clone();
    expected.world.grasped_start_env_steps = 0;
    expected.replay.reflection_prob = 0.0;
    expected.replay.displaced_hindsight = false;
    expected.ddpg.cooldown_share = 0.0;
    expected.evaluation.early_points = 0;
    expected.evaluation.symmetrized = false;
    let completed = completed(&former.to_string()).expect("valid");
    assert_eq!(completed, to_toml(&expected).expect("writes"));
    assert_eq!(self::completed("arms = 0"), None);
    assert_eq!(self::completed("not TOML ="), None);
}

#[test]
fn every_run_file_that_ships_is_valid() {
    let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy");
    let files = std::fs::read_dir(directory).expect("ships").flatten().map(|entry| entry.path());
    let is_sweep = |path: &std::path::PathBuf| path.to_string_lossy().contains("/sweep-");
    let run_files: Vec<_> = files
        .filter(|path| path.extension().is_some_and(|e| e == "toml") && !is_sweep(path))
        .collect();
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

#[test]
fn errors_in_a_document_are_reported_with_their_line() {
    let check = |text: &str, words: &[&str]| {
        let message = from_text(text).expect_err("must be refused");
        words.iter().for_each(|word| assert!(message.contains(word), "{message:?} lacks {word:?}"));
        assert!(message.len() < 700 && !message.contains('\n'), "{message:?}");
    };
    check("seed = 1\narms = 2\nseed = 3\n", &["line 3", "duplicate", "seed = 3"]);
    check("[ddpg]\nn_hidden = 8\n[ddpg]\nn_hidden = 9\n", &["line 3", "duplicate", "[ddpg]"]);
    check("seed 1", &["line 1", "seed 1"]);
    check("name = \"open", &["line 1", "name"]);
    check("[ddpg\nn_hidden = 8", &["line 1", "[ddpg"]);
    check("[ddpg.discount]\nvalue = 1", &["ddpg.discount", "number"]);
    check("[[ddpg]]\nn_hidden = 8", &["ddpg", "section"]);
    check("[dpg]", &["dpg", "expected one of", "ddpg"]);
    check(&format!("name = {:?} x", "y".repeat(100_000)), &["line 1", "bytes"]);
}

#[test]
fn a_byte_order_mark_is_ignored() {
    assert_eq!(from_text("\u{feff}seed = 9").map(|config| config.seed), Ok(9));
}

#[test]
fn a_file_that_is_not_text_is_refused_by_name() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("run.toml");
    let refusal = || format!("{:?}", resolve(Some(&path), &[]).expect_err("must be refused"));
    assert!(refusal().contains("run.toml"), "no such file: {}", refusal());
    std::fs::write(&path, b"name = \"\xff\xfe\"").expect("writes");
    assert!(refusal().contains("run.toml") && refusal().contains("UTF-8"), "{}", refusal());
    let in_utf16: Vec<u8> = "seed = 1".encode_utf16().flat_map(u16::to_le_bytes).collect();
    std::fs::write(&path, [b"\xff\xfe", in_utf16.as_slice()].concat()).expect("writes");
    assert!(refusal().contains("run.toml"), "{}", refusal());
}

#[test]
fn a_setting_leaves_the_rest_of_its_section_alone() {
    let file = "[ddpg]\nn_hidden = 32\n";
    let setting = parse_setting("ddpg={discount=0.5}").expect("KEY=VALUE");
    let refused = overlay(parse(file).expect("TOML"), &[setting]).expect_err("a section");
    assert!(refused.to_string().contains("not a section"), "{refused}");
    let setting = parse_setting("ddpg.discount=0.5").expect("KEY=VALUE");
    let config = overlay(parse(file).expect("TOML"), &[setting]).expect("valid");
    assert_eq!((config.ddpg.n_hidden, config.ddpg.discount), (32, 0.5));
}

/// Returns the names of all settings.
fn known() -> Vec<String> {
    let defaults = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    names_below(&Table::try_from(defaults).expect("a table"), "")
}

fn any_name() -> BoxedStrategy<String> {
    let mistyped = (select(known()), any::<usize>(), "[a-z.]?").prop_map(|(name, at, letter)| {
        let at = at % name.len();
        format!("{}{letter}{}", &name[..at], &name[at + 1..])
    });
    prop_oneof![12 => select(known()), 2 => mistyped, 1 => "[a-z]{0,4}(\\.[a-z]{1,4}){0,3}"].boxed()
}

fn any_value() -> BoxedStrategy<Value> {
    let words = ["none", "ea", "mc-q:0.5", "tandem", "paper", "push", "target", "round", "joint"];
    let edges = [f64::NAN, f64::INFINITY, -0.0, 1.0, 1e300, 1e-300, 0.999_999_999_9];
    let scalar = prop_oneof![
        4 => (0_i64..100).prop_map(Value::Integer),
        1 => any::<i64>().prop_map(Value::Integer),
        4 => (0.0..1.0).prop_map(Value::Float),
        1 => any::<f64>().prop_map(Value::Float),
        2 => select(edges.to_vec()).prop_map(Value::Float),
        3 => select(words.to_vec()).prop_map(|word| Value::String(word.to_owned())),
        1 => any::<String>().prop_map(Value::String),
        1 => (1_000_usize..20_000).prop_map(|n| Value::String("long ".repeat(n))),
        1 => any::<bool>().prop_map(Value::Boolean),
        1 => Just("v = 2024-02-30T00:00:00Z".parse::<Table>().map_or(Value::Boolean(false), |table| table["v"].clone())),
    ];
    let inner = scalar.clone();
    let array = vec(inner.clone(), 0..3).prop_map(Value::Array);
    let table = vec(("[a-z_]{1,9}", inner), 0..3)
        .prop_map(|entries| Value::Table(entries.into_iter().collect()));
    prop_oneof![12 => scalar, 1 => array, 1 => table].boxed()
}

/// Sets the value of a dotted name and replaces anything that is in the way.
fn put(table: &mut Table, name: &str, value: Value) {
    match name.split_once('.') {
        None => drop(table.insert(name.to_owned(), value)),
        Some((section, rest)) => {
            let section = table.entry(section).or_insert_with(|| Value::Table(Table::new()));
            if !section.is_table() {
                *section = Value::Table(Table::new());
            }
            put(section.as_table_mut().expect("made one"), rest, value);
        }
    }
}

/// Returns true if a configuration has the value that a document sets.
#[expect(clippy::cast_possible_truncation, reason = "the configuration keeps some as f32")]
fn is_kept(given: &Value, kept: &Value) -> bool {
    let number = |value: &Value| value.as_float().or(value.as_integer().map(|whole| whole as f64));
    match (number(given), number(kept), kept) {
        (Some(given), Some(kept), Value::Float(_)) => {
            given.to_bits() == kept.to_bits() || (given as f32).to_bits() == (kept as f32).to_bits()
        }
        _ => given == kept,
    }
}

fn lookup<'a>(table: &'a Table, name: &str) -> Option<&'a Value> {
    match name.split_once('.') {
        None => table.get(name),
        Some((section, rest)) => lookup(table.get(section)?.as_table()?, rest),
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_document_is_applied_exactly_or_refused_by_name(
        changes in vec((any_name(), any_value()), 0..6),
    ) {
        let mut document = Table::new();
        for (name, value) in &changes {
            put(&mut document, name, value.clone());
        }
        let text = toml::to_string(&document).expect("a table can be written");
        match from_text(&text) {
            Ok(config) => {
                let kept = Table::try_from(&config).expect("a table");
                for (name, given) in settings_below(&document, "") {
                    let kept = lookup(&kept, &name);
                    prop_assert!(kept.is_some_and(|kept| is_kept(&given, kept)), "{name} = {given} became {kept:?}");
                }
                prop_assert_eq!(from_text(&to_toml(&config).expect("written")), Ok(config));
            }
            Err(message) => {
                prop_assert!(message.len() < 1000 && !message.contains('\n'), "{message:?}");
                let names = settings_below(&document, "").into_iter().map(|(name, _)| name);
                let sections = document.keys().cloned();
                let is_named = names.chain(sections).any(|name| message.contains(&name));
                prop_assert!(is_named, "{message:?} names nothing of\n{text}");
            }
        }
    }

    #[test]
    fn a_mistyped_document_never_ends_the_program(
        edits in vec((any::<usize>(), any::<char>()), 1..4),
    ) {
        let config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
        let mut text: Vec<char> = to_toml(&config).expect("written").chars().collect();
        for (at, letter) in edits {
            let at = at % text.len();
            text[at] = letter;
        }
        let text: String = text.into_iter().collect();
        match from_text(&text) {
            Ok(config) => prop_assert_eq!(from_text(&to_toml(&config).expect("written")), Ok(config)),
            Err(message) => prop_assert!(message.len() < 1000 && !message.contains('\n'), "{message:?}"),
        }
    }

    #[test]
    fn a_setting_is_a_whole_value_or_text(text in "[ -~\n]{0,12}") {
        let text = text.trim();
        match parse_value(text) {
            Value::String(kept) if kept == text => {}
            value => {
                let again: Table = format!("value = {text}\nmore = 1").parse().expect("one value");
                prop_assert!(again.len() == 2 && again["value"].to_string() == value.to_string());
                prop_assert!(matches!(value, Value::String(_)) || !text.contains('#'), "{text:?}");
            }
        }
    }
}
