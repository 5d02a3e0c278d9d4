use super::*;

const LIMIT: &str = "[run.stop]\nmax_env_steps = 1000\n";

/// Returns the runs of a file that names its task itself.
fn runs_of(text: &str) -> anyhow::Result<Vec<PlannedRun>> {
    runs(&parse(text)?, &[])
}

fn names(text: &str) -> Vec<String> {
    runs_of(text).expect("valid").into_iter().map(|run| run.name).collect()
}

#[test]
fn every_combination_is_a_run_and_seeds_are_the_outermost_loop() {
    let text = "tasks = [\"push\", \"pick-and-place\"]\nstrategies = [\"none\", \"mc-q:0.1\"]\nseeds = [3, 4]\n";
    let seen = names(&format!("{text}{LIMIT}"));
    let expected = [
        "push-none-seed3",
        "push-mc-q-0.1-seed3",
        "pick-and-place-none-seed3",
        "pick-and-place-mc-q-0.1-seed3",
        "push-none-seed4",
        "push-mc-q-0.1-seed4",
        "pick-and-place-none-seed4",
        "pick-and-place-mc-q-0.1-seed4",
    ];
    assert_eq!(seen, expected);
}

#[test]
fn variants_are_added_to_strategies_and_axes_multiply_both() {
    let text = "strategies = [\"ea\"]\n[[variant]]\nname = \"no-cloning\"\nset = { advice.strategy = \"mc-q:0.05\", advice.share = 1 }\n\
                [[axis]]\n\"ddpg.polyak_keep\" = [0.95, 0.99]\n[[axis]]\nrounds.lag = [0, 1]\n";
    let planned = runs_of(&format!("{text}{LIMIT}")).expect("valid");
    let seen: Vec<&str> = planned.iter().map(|run| run.name.as_str()).collect();
    assert_eq!(seen.len(), 8);
    assert_eq!(
        [seen[0], seen[7]],
        [
            "shared-push-ea-polyak_keep-0.95-lag-0-seed1",
            "shared-push-no-cloning-polyak_keep-0.99-lag-1-seed1"
        ]
    );
    let last = &planned[7].config;
    assert_eq!(
        (last.advice.strategy.as_str(), last.advice.share, last.rounds.lag),
        ("mc-q:0.05", 1.0, 1)
    );
    assert!((last.ddpg.polyak_keep - 0.99).abs() < 1e-6);
    assert_eq!(last.name, planned[7].name);
}

#[test]
fn settings_of_a_task_override_those_of_all_runs_and_a_variant_overrides_both() {
    let text = "tasks = [\"push\", \"pick-and-place\"]\n[[variant]]\nname = \"a\"\n\
                [[variant]]\nname = \"b\"\nset = { ddpg.discount = 0.97 }\n\
                [run]\nddpg.discount = 0.95\n[per_task.push]\nddpg.discount = 0.96\n";
    let runs = runs_of(text).expect("valid");
    let discounts: Vec<_> =
        runs.iter().map(|run| (run.name.as_str(), run.config.ddpg.discount)).collect();
    let expected = [
        ("push-a-seed1", 0.96),
        ("push-b-seed1", 0.97),
        ("pick-and-place-a-seed1", 0.95),
        ("pick-and-place-b-seed1", 0.97),
    ];
    assert_eq!(discounts, expected);
}

#[test]
fn runs_have_no_time_limit_unless_one_is_set() {
    let minutes = |text: &str| runs_of(text).expect("valid")[0].config.stop.max_minutes;
    assert_eq!(minutes(LIMIT), 0.0);
    assert_eq!(minutes("[run]\nstop.max_minutes = 2"), 2.0);
}

#[test]
fn a_teacher_is_named_if_the_run_needs_one() {
    let text = "strategies = [\"none\", \"ea\"]\n[teachers]\nshared-push = \"mine.safetensors\"\n";
    let teachers: Vec<_> = runs_of(&format!("{text}{LIMIT}"))
        .expect("valid")
        .into_iter()
        .map(|run| run.teacher)
        .collect();
    assert_eq!(teachers, [None, Some(PathBuf::from("mine.safetensors"))]);
}

#[test]
fn errors_fit_on_one_line() {
    let check = |text: &str, words: &[&str]| {
        let error = runs_of(&format!("{text}\n{LIMIT}")).expect_err("must be refused");
        let message = format!("{error:#}");
        assert!(!message.contains('\n'), "{message}");
        words.iter().for_each(|word| assert!(message.contains(word), "{message:?} lacks {word:?}"));
    };
    check("nonsense = 1", &["line 1", "nonsense"]);
    check("seeds = [", &["line"]);
    check("tasks = [\"fold\"]", &["fold", "push"]);
    check("strategies = [\"mc-q:x\"]", &["mc-q:x"]);
    check("seeds = [1, 1]", &["push-mc-q-0.1-seed1", "twice"]);
    check("seeds = [18446744073709551615]", &["seed"]);
    check("[[axis]]\n\"ddpg.polyak_keep\" = 0.9", &["axis", "list"]);
    check("[[axis]]\n\"ddpg.polyak\" = [0.9]", &["ddpg.polyak"]);
    let axes: String = ["ddpg.polyak_keep", "ddpg.discount", "ddpg.bc_weight"]
        .map(|key| format!("[[axis]]\n\"{key}\" = {:?}\n", [0.5; 1000]))
        .concat();
    check(&axes, &["lists 1000000 runs", "10000"]);
    check("[[axis]]\nseed = []", &["seed", "empty"]);
    for key in ["tasks", "strategies", "seeds", "axis", "variant"] {
        check(&format!("{key} = []"), &[key, "is an empty list"]);
    }
    check("[[variant]]\nname = \"a/b\"", &["a/b"]);
    check("tasks = [\"push\"]\n[per_task.fold]\nseed = 2", &["[per_task.fold]", "`tasks`"]);
    check("strategies = [\"ea\"]\n[run.advice]\nstrategy = \"none\"", &["advice.strategy"]);
    let unlimited =
        runs_of("[run.stop]\nmax_env_steps = 0").expect_err("must be refused").to_string();
    assert!(unlimited.contains("max_env_steps"), "{unlimited}");
    let many: Vec<String> = (0..10_001).map(|seed| seed.to_string()).collect();
    check(&format!("seeds = [{}]", many.join(",")), &["10001", "at most"]);
}

#[test]
fn an_empty_file_is_rejected() {
    for text in ["", "\n\n", "# nothing yet\n"] {
        let error = runs_of(text).expect_err("must be refused").to_string();
        assert!(error.starts_with("is empty: expected"), "{text:?}: {error}");
    }
}

#[test]
fn every_shipped_sweep_file_is_valid() {
    let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy");
    let files = std::fs::read_dir(directory).expect("ships").flatten().map(|entry| entry.path());
    let counts: BTreeMap<String, usize> = files
        .filter(|path| path.to_string_lossy().contains("/sweep-"))
        .map(|path| {
            let name = path.file_stem().expect("named").to_string_lossy().into_owned();
            (name, read(&path).expect("valid").runs.len())
        })
        .collect();
    let expected = [
        ("sweep-carry-bar", 9),
        ("sweep-few-units", 15),
        ("sweep-paper-batches", 6),
        ("sweep-paper-students", 8),
        ("sweep-paper-teachers", 6),
        ("sweep-recipe", 24),
        ("sweep-recipe-cooldown", 2),
        ("sweep-recipe-long", 10),
        ("sweep-recipe-starts", 4),
        ("sweep-recipe-teachers", 12),
        ("sweep-small", 8),
        ("sweep-students", 6),
        ("sweep-table2", 90),
        ("sweep-table2-classic", 18),
        ("sweep-table2-copies", 6),
        ("sweep-table2-further", 18),
        ("sweep-table2-none", 12),
        ("sweep-table2-teachers", 2),
        ("sweep-teachers", 6),
    ];
    let counts: Vec<_> = counts.iter().map(|(name, count)| (name.as_str(), *count)).collect();
    assert_eq!(counts, expected);
}

#[test]
fn a_task_of_a_server_is_that_of_all_runs_and_part_of_their_names() {
    let mut description = tandem_core::Layout::new(tandem_core::Task::Push, 2).description();
    description.name = "lab/reach-1".to_owned();
    let task = tandem_core::TaskSpec::new(description).expect("valid");
    let settings = served_task::settings(&task).expect("TOML");
    let file = parse(&format!("seeds = [1, 2]\nenv_command = \"serve\"\n{LIMIT}")).expect("valid");
    assert!(!names_task(&file));
    let runs = runs(&file, &settings).expect("valid");
    let names: Vec<&str> = runs.iter().map(|run| run.name.as_str()).collect();
    assert_eq!(names, ["lab-reach-1-mc-q-0.1-seed1", "lab-reach-1-mc-q-0.1-seed2"]);
    assert_eq!(runs[0].config.task_spec().expect("valid"), task);
    let environment = environment(&file).expect("valid");
    assert_eq!(environment.env_command.as_deref(), Some("serve"));
}

#[test]
fn a_contradictory_server_is_refused() {
    let check = |keys: &str, expected: &str| {
        let file = parse(&format!("seeds = [1]\n{keys}\n{LIMIT}")).expect("valid");
        assert_eq!(environment(&file).expect_err("refused").to_string(), expected);
    };
    check("env = \"a:1\"\nenv_command = \"b\"", {
        "env and env_command are both set: expected one of them"
    });
    check("env_token_file = \"token\"", "env_token_file is set without env");
    let seconds = "env_timeout_s: expected a number of seconds, more than 0";
    check("env = \"a:1\"\nenv_timeout_s = 0.0", seconds);
    check("env = \"a:1\"\nenv_timeout_s = -1.0", seconds);
}

#[test]
fn a_setting_that_two_lists_set_is_refused() {
    let axis = |key: &str| format!("[[axis]]\n\"{key}\" = [1, 2]\n");
    let variant = "[[variant]]\nname = \"a\"\nset = { seed = 7, advice.strategy = \"none\" }\n";
    let check = |text: String, expected: &str| {
        let error = runs_of(&format!("{text}{LIMIT}")).expect_err("refused").to_string();
        assert!(error.starts_with(expected), "{error}");
    };
    check(format!("seeds = [1]\n{}", axis("seed")), "seed is set by axes and by seeds");
    check(format!("seeds = [1]\n{variant}"), "seed is set by strategies and variants and by seeds");
    let strategy = "[[axis]]\nadvice.strategy = [\"ea\"]\n";
    check(
        format!("{variant}{strategy}"),
        "advice.strategy is set by strategies and variants and by axes",
    );
    check(axis("rounds.lag") + &axis("rounds.lag"), "rounds.lag is set twice by axes");
    check(
        ("tasks = [\"push\"]\n[[axis]]\ntask = [\"push\"]\n").to_owned(),
        "task is set by tasks and by axes",
    );
}
