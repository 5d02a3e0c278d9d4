//! `tandem train --print-run`: the run file of the other options.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

/// Runs `tandem train` with `args` in `directory` and returns its exit code, standard output and standard error.
fn train(directory: &Path, args: &[&str]) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.arg("train").args(args).stdin(Stdio::null()).current_dir(directory);
    let output = command.env_remove("RUST_LOG").output().expect("runs");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code(), text(&output.stdout), text(&output.stderr))
}

#[test]
fn the_run_file_of_options_gives_the_same_run() {
    let keep = tempfile::tempdir().expect("a directory");
    let print = |args: &[&str]| {
        let (code, text, messages) = train(keep.path(), &[args, &["--print-run"]].concat());
        assert_eq!((code, messages.as_str()), (Some(0), ""), "{args:?}");
        text
    };
    for (args, lines) in [
        (&[][..], &["task = \"shared-push\"", "name = \"shared-push-2-mc-q-0.1-seed1\""][..]),
        (&["--arms", "1", "--recipe", "paper", "--seed", "7"], &["recipe = \"paper\"", "seed = 7"]),
        (&["--task", "pick-and-place", "--out", "a/mine"], &["name = \"mine\""]),
        (&["--max-minutes", "3"], &["max_env_steps = 0", "max_minutes = 3.0"]),
        (&["--set", "ddpg.discount=0.9", "--max-env-steps", "4000"], &["every_env_steps = 800"]),
        (&["--strategy", "init:teacher"], &["strategy = \"init:teacher\""]),
    ] {
        let text = print(args);
        for line in lines {
            assert!(text.lines().any(|one| one == *line), "{args:?}: {line:?} is not in {text}");
        }
        fs::write(keep.path().join("run.toml"), &text).expect("writes");
        let out = match args {
            [.., "--out", out] => &["--run", "run.toml", "--out", out][..],
            _ => &["--run", "run.toml"],
        };
        assert_eq!(print(out), text, "{args:?}");
    }
    let names = fs::read_dir(keep.path()).expect("there").count();
    assert_eq!(names, 1, "only the file of this test: nothing was started");
}

#[test]
fn options_that_a_printed_page_or_file_does_not_show_are_refused() {
    let keep = tempfile::tempdir().expect("a directory");
    for (args, named) in [
        (&["--settings", "--arms", "1"][..], "--arms"),
        (&["--settings", "--task", "push"], "--task"),
        (&["--settings", "--recipe", "paper"], "--recipe"),
        (&["--settings", "--set", "seed=2"], "--set"),
        (&["--settings", "--print-run"], "--print-run"),
        (&["--print-run", "--json"], "--json"),
        (&["--print-run", "--resume", "--out", "x"], "--resume"),
        (&["--print-run", "--strategy", "none", "--budget", "5"], "--budget: a run with strategy"),
        (&["--print-run", "--set", "ddpg.discont=0.9"], "ddpg.discount"),
    ] {
        let (code, text, messages) = train(keep.path(), args);
        assert_eq!((code, text.as_str()), (Some(64), ""), "{args:?}");
        assert!(messages.contains(named), "{args:?}: {messages}");
    }
}
