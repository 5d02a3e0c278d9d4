//! A sweep of real runs that is interrupted, killed and restarted, and the report on it.

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, SystemTime};

use serde_json::Value;

/// Settings of small runs with 7 rounds.
const SMALL: [(&str, &str); 10] = [
    ("stop.max_env_steps", "5600"),
    ("ddpg.n_hidden", "32"),
    ("ddpg.batch_size", "64"),
    ("rounds.updates_per_env_step", "0.1"),
    ("evaluation.episodes", "8"),
    ("evaluation.test_episodes", "8"),
    ("evaluation.every_env_steps", "1600"),
    ("evaluation.recorded_episodes", "0"),
    ("checkpoint.every_rounds", "2"),
    ("world.substeps", "10"),
];

const RUNS: [&str; 4] = [
    "shared-push-none-seed1",
    "shared-push-mc-q-0.1-seed1",
    "shared-push-none-seed2",
    "shared-push-mc-q-0.1-seed2",
];

fn tandem() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.current_dir(env!("CARGO_MANIFEST_DIR"));
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// Writes a sweep file with the small runs' settings.
fn write_sweep(path: &Path, lists: &str, extra: &[(&str, &str)]) {
    let settings = SMALL.iter().chain(extra).map(|(key, value)| format!("{key} = {value}\n"));
    fs::write(path, format!("{lists}\n[run]\n{}", settings.collect::<String>())).expect("writes");
}

fn sweep(file: &Path, out: &Path, more: &[&str]) -> Command {
    let mut command = tandem();
    command.arg("sweep").arg(file).arg("--out").arg(out).args(more);
    command
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Returns the JSON object on the last line of standard output.
fn last_object(output: &Output) -> Value {
    assert!(output.status.success(), "{:?}: {}", output.status, text(&output.stderr));
    let stdout = text(&output.stdout);
    serde_json::from_str(stdout.lines().last().expect("a line")).expect("JSON")
}

fn signal(signal: &str, pid: u32) {
    let sent = Command::new("kill").args([signal, &pid.to_string()]).status().expect("kill runs");
    assert!(sent.success(), "no process {pid}");
}

/// Polls `holds` every 20 ms for up to two minutes.
fn eventually(what: &str, holds: impl Fn() -> bool) {
    let held = (0..6000).any(|_| {
        let holds = holds();
        if !holds {
            std::thread::sleep(Duration::from_millis(20));
        }
        holds
    });
    assert!(held, "{what}: not within two minutes");
}

fn wait_for_checkpoint(run: &Path) {
    let is_saved = || {
        let saved = fs::read_dir(run.join("checkpoint")).into_iter().flatten().flatten();
        saved
            .map(|entry| entry.path())
            .any(|path| path.extension().is_some_and(|e| e == "safetensors"))
    };
    eventually("a checkpoint", is_saved);
}

/// Returns the process id of the sweep's only child, the active run.
fn child_of(sweep: &Child) -> u32 {
    let pid = sweep.id();
    let children = fs::read_to_string(format!("/proc/{pid}/task/{pid}/children"));
    let children = children.expect("the sweep lives");
    children.split_whitespace().next().expect("a run is under way").parse().expect("a number")
}

fn is_gone(pid: u32) -> bool {
    let state = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    state.is_empty() || state.contains(") Z ")
}

/// Returns names, content and modification times of the finished runs' summaries.
fn finished(out: &Path) -> Vec<(&'static str, Vec<u8>, SystemTime)> {
    let summary = |name: &'static str| {
        let path = out.join(name).join("summary.json");
        let bytes = fs::read(&path).ok()?;
        let written_at = fs::metadata(&path).ok()?.modified().ok()?;
        Some((name, bytes, written_at))
    };
    RUNS.into_iter().filter_map(summary).collect()
}

/// Trains the run that the sweep calls `name` without interruptions and returns its digest.
fn undisturbed_digest(name: &str, dir: &Path) -> String {
    let (strategy, seed) =
        name.strip_prefix("shared-push-").expect("push").split_once("-seed").expect("a seed");
    let mut command = tandem();
    command.args(["train", "--json", "--max-minutes", "0", "--seed", seed]);
    command.args(["--strategy", &strategy.replacen("mc-q-", "mc-q:", 1)]);
    for (key, value) in SMALL {
        command.args(["--set", &format!("{key}={value}")]);
    }
    let output = command.arg("--out").arg(dir.join(name)).output().expect("runs");
    last_object(&output)["digest"].as_str().expect("a digest").to_owned()
}

/// Interrupts a sweep in its first run, kills its restart in the third run and lets the next restart finish.
fn disturbed_sweep(file: &Path, out: &Path) -> Value {
    let first = sweep(file, out, &[]).spawn().expect("starts");
    wait_for_checkpoint(&out.join(RUNS[0]));
    signal("-INT", first.id());
    let interrupted = first.wait_with_output().expect("ends");
    assert_eq!(interrupted.status.code(), Some(130), "{}", text(&interrupted.stderr));
    assert!(
        text(&interrupted.stderr).contains("tandem sweep "),
        "the command that resumes the sweep"
    );

    let mut second = sweep(file, out, &[]).spawn().expect("starts");
    wait_for_checkpoint(&out.join(RUNS[2]));
    let run = child_of(&second);
    let other = sweep(file, out, &[]).output().expect("runs");
    assert_eq!(other.status.code(), Some(75), "two sweeps in one directory");
    let before = finished(out);
    signal("-KILL", second.id());
    second.wait().expect("the sweep has ended");
    assert!((2..4).contains(&before.len()), "{before:?}");

    let third = sweep(file, out, &["--json"]).output().expect("runs");
    assert!(is_gone(run), "a run of the killed sweep outlived the restart");
    let after = finished(out);
    assert_eq!(after[..before.len()], before[..], "finished runs are left alone");
    last_object(&third)
}

#[test]
fn an_interrupted_sweep_ends_with_the_bits_of_undisturbed_runs() {
    let keep = tempfile::tempdir().expect("a directory");
    let (file, out) = (keep.path().join("sweep.toml"), keep.path().join("sweep"));
    write_sweep(&file, "strategies = [\"none\", \"mc-q:0.1\"]\nseeds = [1, 2]", &[]);
    let result = disturbed_sweep(&file, &out);
    assert_eq!(result["finished"], 4, "{result}");
    for (run, name) in result["runs"].as_array().expect("a list").iter().zip(RUNS) {
        assert_eq!(run["name"], name);
        assert_eq!(run["summary"]["digest"], undisturbed_digest(name, keep.path()), "{name}");
    }

    let planned =
        last_object(&sweep(&file, &out, &["--dry-run", "--json"]).output().expect("runs"));
    let states = planned["runs"].as_array().expect("a list").iter().map(|run| run["state"].clone());
    assert_eq!(states.collect::<Vec<_>>(), ["finished"; 4]);

    write_sweep(
        &file,
        "strategies = [\"none\", \"mc-q:0.1\"]\nseeds = [1, 2]",
        &[("ddpg.discount", "0.9")],
    );
    let refused = sweep(&file, &out, &[]).output().expect("runs");
    assert_eq!(refused.status.code(), Some(64));
    let why = text(&refused.stderr);
    assert!(why.contains(RUNS[0]) && why.contains("ddpg.discount is 0.95"), "{why}");

    report_has_every_run(&out, keep.path());
}

/// Checks the report on the finished sweep: two strategies with two seeds, four evaluations per undisturbed run.
fn report_has_every_run(out: &Path, directory: &Path) {
    let csv = directory.join("runs.csv");
    let markdown = directory.join("runs.md");
    let mut report = tandem();
    report.arg("report").arg(out).arg("--csv").arg(&csv).arg("--markdown").arg(&markdown);
    let report = report.output().expect("runs");
    assert!(report.status.success() && report.stderr.is_empty(), "{}", text(&report.stderr));
    let table = text(&report.stdout);
    let is_path = |line: &str| {
        ["report ", "figures ", "csv ", "markdown "].iter().any(|label| line.starts_with(label))
    };
    assert!(table.lines().all(|line| is_path(line) || line.chars().count() <= 80));
    for strategy in ["none", "mc-q:0.1"] {
        let line = table.lines().find(|line| line.starts_with(&format!("{strategy} ")));
        let cells: Vec<&str> = line.expect("a row").split_whitespace().collect();
        assert_eq!(cells[1], "2", "seeds of {strategy}");
    }
    let lines: Vec<String> =
        fs::read_to_string(&csv).expect("written").lines().skip(1).map(str::to_owned).collect();
    assert_eq!(lines.len(), 4);
    for line in &lines {
        let cells: Vec<&str> = line.split(',').collect();
        // An evaluation that was in progress when the run was stopped is not repeated.
        let n_evaluations: u32 = cells[6].parse().expect("a count");
        let was_disturbed = [RUNS[0], RUNS[2]].contains(&cells[4]);
        assert!(if was_disturbed { n_evaluations > 0 } else { n_evaluations == 4 }, "{line}");
        assert!(!cells[24].is_empty(), "test success in {line}");
    }
    let tables = fs::read_to_string(&markdown).expect("written");
    let rows = tables.lines().filter(|line| line.starts_with("| mc-q:0.1 |"));
    assert!(tables.starts_with("### shared-push, 2 arms: ") && rows.count() == 4, "{tables}");
    let page = fs::read_to_string(out.join("report.html")).expect("written");
    for text in ["<svg", "shared-push, 2 arms", "MC-Q01"] {
        assert!(page.contains(text), "{text}");
    }
    assert!(out.join("report-figures/shared-push-2-success-paper-epochs-strategies.svg").is_file());
}

#[test]
fn a_failed_run_is_reported_and_retried_at_the_next_start() {
    let keep = tempfile::tempdir().expect("a directory");
    let (file, out) = (keep.path().join("sweep.toml"), keep.path().join("sweep"));
    let lists = "strategies = [\"none\", \"ea\"]\n";
    // A file is where a directory of the run belongs.
    let blocked = out.join("shared-push-ea-seed1/policy");
    fs::create_dir_all(blocked.parent().expect("a parent")).expect("creates");
    fs::write(&blocked, "").expect("writes");
    let shorter =
        SMALL.map(|(key, value)| (key, if key == "stop.max_env_steps" { "1600" } else { value }));
    let settings: String =
        shorter.iter().map(|(key, value)| format!("{key} = {value}\n")).collect();
    fs::write(&file, format!("{lists}\n[run]\n{settings}")).expect("writes");

    let failed = sweep(&file, &out, &["--jobs", "2"]).output().expect("runs");
    let message = text(&failed.stderr);
    assert_eq!(failed.status.code(), Some(75), "{message}");
    assert!(
        message.contains("shared-push-ea-seed1: failed:") && message.contains("cannot write to"),
        "{message}"
    );
    assert!(message.contains("1 of 2 runs failed"), "{message}");
    assert!(text(&failed.stdout).contains("1 of 2"), "{}", text(&failed.stdout));

    fs::remove_file(&blocked).expect("removes");
    let again = sweep(&file, &out, &["--json"]).output().expect("runs");
    assert!(text(&again.stderr).contains("failed before"), "{}", text(&again.stderr));
    let result = last_object(&again);
    assert_eq!(result["finished"], 2, "{result}");
    assert!(result["runs"][1]["failure"].is_null(), "{result}");
}

#[test]
fn a_run_whose_directory_cannot_be_created_counts_as_failed() {
    let keep = tempfile::tempdir().expect("a directory");
    let (file, out) = (keep.path().join("sweep.toml"), keep.path().join("sweep"));
    write_sweep(&file, "seeds = [1]", &[]);
    fs::create_dir(&out).expect("creates");
    fs::write(out.join("shared-push-mc-q-0.1-seed1"), "").expect("writes");
    let failed = sweep(&file, &out, &["--json"]).output().expect("runs");
    let message = text(&failed.stderr);
    assert_eq!(failed.status.code(), Some(75), "{message}");
    assert!(message.contains("1 of 1 runs failed") && message.contains("not saved"), "{message}");
    let result: Value = serde_json::from_slice(&failed.stdout).expect("JSON");
    assert!(result["runs"][0]["failure"].is_string(), "{result}");
}

#[test]
fn a_teacher_that_cannot_advise_is_refused_before_any_run() {
    let keep = tempfile::tempdir().expect("a directory");
    let (file, out) = (keep.path().join("sweep.toml"), keep.path().join("sweep"));
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for (teacher, reason) in [
        (keep.path().join("none.safetensors"), "cannot read policy file"),
        (root.join("policies/student-push.safetensors"), "drives 2 arms"),
    ] {
        let lists =
            format!("strategies = [\"none\", \"ea\"]\n[teachers]\nshared-push = {teacher:?}");
        write_sweep(&file, &lists, &[]);
        let refused = sweep(&file, &out, &[]).output().expect("runs");
        let message = text(&refused.stderr);
        assert_eq!(refused.status.code(), Some(64), "{message}");
        assert!(message.contains("the teacher of shared-push-ea-seed1: "), "{message}");
        assert!(message.contains(reason) && message.lines().count() == 1, "{message}");
        assert!(!out.exists(), "a refused sweep leaves no files");
        let plan = sweep(&file, &out, &["--dry-run"]).output().expect("lists");
        assert!(plan.status.success() && text(&plan.stderr).contains(reason));
    }
}

/// A run that has learned nothing may be started anew with other settings, but not while its processes use the directory.
#[test]
fn a_run_that_another_process_uses_is_left_alone() {
    let keep = tempfile::tempdir().expect("a directory");
    let (file, out) = (keep.path().join("sweep.toml"), keep.path().join("sweep"));
    write_sweep(&file, "strategies = [\"none\"]", &[]);
    let run = out.join("shared-push-none-seed1");
    fs::create_dir_all(run.join("checkpoint")).expect("creates");
    for name in ["run.toml", "ledger.sqlite"] {
        fs::write(run.join(name), "").expect("writes");
    }
    fs::write(run.join("run.toml"), "seed = 7\n").expect("writes");
    let used = tandem_system::DirectoryLock::try_take(&run.join("checkpoint"));
    let used = used.expect("locks").expect("free");
    let mut waiting = sweep(&file, &out, &["--no-dashboard"]).spawn().expect("starts");
    let lines = BufReader::new(waiting.stderr.take().expect("piped")).lines();
    let mut lines = lines.map_while(Result::ok);
    assert!(lines.any(|line| line.contains("waits for another process that uses")));
    signal("-INT", waiting.id());
    assert_eq!(waiting.wait().expect("ends").code(), Some(130));
    assert!(!run.join("failure.txt").exists(), "waiting is no failure");
    assert!(run.join("run.toml").exists() && run.join("ledger.sqlite").exists());
    drop(used);
    let trained = sweep(&file, &out, &["--json", "--no-dashboard"]).output().expect("runs");
    assert_eq!(last_object(&trained)["finished"], 1);
    assert!(!run.join("ledger.sqlite").exists(), "the former ledger is gone");
}

/// The second of two commands waits for the run, and finds it complete.
#[test]
fn two_commands_train_one_run_once() {
    let keep = tempfile::tempdir().expect("a directory");
    let (file, out) = (keep.path().join("sweep.toml"), keep.path().join("sweep"));
    write_sweep(&file, "strategies = [\"none\"]", &[]);
    let only = || sweep(&file, &out, &["--json", "--only", "0", "--no-dashboard"]);
    let both = [(); 2].map(|()| only().spawn().expect("starts"));
    let results = both.map(|one| last_object(&one.wait_with_output().expect("ends")));
    assert_eq!(results[0], results[1]);
    assert!(!out.join("shared-push-none-seed1/failure.txt").exists());
}

/// `--only` trains one run of the list, at the same time as others in the same directory.
#[test]
fn runs_of_a_sweep_are_trained_by_several_commands() {
    let dir = tempfile::tempdir().expect("a directory");
    let (file, out) = (dir.path().join("small.toml"), dir.path().join("out"));
    let short: [(&str, &str); 1] = [("stop.max_env_steps", "1600")];
    let settings: Vec<_> =
        SMALL.into_iter().filter(|(key, _)| *key != short[0].0).chain(short).collect();
    let settings: String =
        settings.iter().map(|(key, value)| format!("{key} = {value}\n")).collect();
    fs::write(&file, format!("strategies = [\"none\"]\nseeds = [1, 2]\n[run]\n{settings}"))
        .expect("writes");
    let only = |n: &str| sweep(&file, &out, &["--json", "--only", n, "--no-dashboard"]);
    let both = ["0", "1"].map(|n| only(n).spawn().expect("starts"));
    for (run, name) in both.into_iter().zip(["shared-push-none-seed1", "shared-push-none-seed2"]) {
        let summary = last_object(&run.wait_with_output().expect("ends"));
        assert_eq!((&summary["finished"], &summary["runs"][0]["name"]), (&1.into(), &name.into()));
    }
    let plan = sweep(&file, &out, &["--dry-run"]).output().expect("lists");
    assert_eq!(text(&plan.stdout).matches("finished").count(), 2, "{}", text(&plan.stdout));
    assert!(
        text(&plan.stdout).contains("  1  finished  shared-push-none-seed2\n"),
        "{}",
        text(&plan.stdout)
    );
    let planned = last_object(&only("1").arg("--dry-run").output().expect("lists"));
    let (run, named) = (&planned["runs"][0], "shared-push-none-seed2");
    assert_eq!((&run["index"], &run["name"]), (&1.into(), &named.into()), "the number of --only");
    let refused = only("2").output().expect("ends");
    assert_eq!(refused.status.code(), Some(64));
    assert!(text(&refused.stderr).contains("expected 0 to 1"), "{}", text(&refused.stderr));
}
