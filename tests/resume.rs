//! Resumed runs: settings that a resume may change, processes that it waits for, and refused resumes.

use std::ffi::OsStr;
use std::fs;
use std::io::{BufRead as _, BufReader};
use std::os::unix::ffi::OsStrExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::LazyLock;
use std::time::Duration;

use tandem_policy::Policy;
use tempfile::TempDir;

/// A small advised run of 12 rounds.
const SMALL: [&str; 22] = [
    "--max-env-steps",
    "4800",
    "--set",
    "rounds.rollouts=1",
    "--set",
    "rounds.updates_per_env_step=0.15",
    "--set",
    "ddpg.n_hidden=32",
    "--set",
    "evaluation.episodes=8",
    "--set",
    "evaluation.test_episodes=8",
    "--set",
    "evaluation.every_env_steps=2000",
    "--set",
    "checkpoint.every_rounds=2",
    "--set",
    "advice.budget=750",
    "--set",
    "world.substeps=10",
    "--set",
    "ddpg.batch_size=64",
];

/// The directory and digest of a complete undisturbed run.
static UNDISTURBED: LazyLock<(TempDir, String)> = LazyLock::new(|| {
    let keep = tempfile::tempdir().expect("a directory");
    let ended = start(&keep.path().join("run")).wait_with_output().expect("ends");
    (keep, digest(&ended))
});

fn tandem(args: &[&str], out: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.args(args).arg("--out").arg(out).current_dir(env!("CARGO_MANIFEST_DIR"));
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn start(out: &Path) -> Child {
    let args = [&["train", "--json", "--workers", "2"], &SMALL[..]].concat();
    tandem(&args, out).spawn().expect("starts")
}

fn resume(out: &Path, more: &[&str]) -> Output {
    let args = [&["train", "--json", "--resume", "--workers", "2"], more].concat();
    tandem(&args, out).output().expect("runs")
}

fn stderr(ended: &Output) -> String {
    String::from_utf8_lossy(&ended.stderr).into_owned()
}

fn digest(ended: &Output) -> String {
    assert!(ended.status.success(), "{:?}: {}", ended.status, stderr(ended));
    let text = String::from_utf8_lossy(&ended.stdout);
    let after = text.lines().last().and_then(|line| line.split("\"digest\":\"").nth(1));
    after.and_then(|after| after.split('"').next()).expect("a digest").to_owned()
}

/// Checks that a resume is refused with `code`, in one line that contains `what`.
fn check_refused(refused: &Output, code: i32, what: &str) {
    let message = stderr(refused);
    assert_eq!(refused.status.code(), Some(code), "{message}");
    assert!(message.contains(what), "{message:?} lacks {what:?}");
    assert_eq!(message.lines().count(), 1, "{message}");
    assert!(!message.contains("resume it with") && !message.contains("Some("), "{message}");
}

/// Reads the files that a refused resume must not change.
fn saved_files(out: &Path) -> [Vec<u8>; 2] {
    ["run.toml", "policy/teacher.safetensors"].map(|name| fs::read(out.join(name)).expect(name))
}

/// Writes another teacher for the same task to `directory`.
fn other_teacher(directory: &Path) -> String {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/teacher-push.safetensors");
    let mut policy = Policy::load(&shipped).expect("ships");
    policy.actor[0] += 0.5;
    let path = directory.join("other.safetensors");
    policy.save(&path).expect("writable");
    path.to_str().expect("UTF-8").to_owned()
}

fn signal(signal: &str, pid: u32) {
    let sent = Command::new("kill").args([signal, &pid.to_string()]).status().expect("kill runs");
    assert!(sent.success(), "no process {pid}");
}

/// Returns the process ids of a run's children whose first argument is `role`.
fn pids(run: &Child, role: &str) -> Vec<u32> {
    let pid = run.id();
    let children = fs::read_to_string(format!("/proc/{pid}/task/{pid}/children"));
    let is_role = |pid: &u32| {
        let line = fs::read_to_string(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        line.split('\0').nth(1) == Some(role)
    };
    let children = children.unwrap_or_default();
    children.split_whitespace().filter_map(|pid| pid.parse().ok()).filter(is_role).collect()
}

/// Kills a process of a run and waits until it is restarted.
fn kill_one(run: &Child, role: &str) {
    let former = pids(run, role);
    signal("-KILL", former[0]);
    let is_back = || pids(run, role).iter().any(|pid| !former.contains(pid));
    assert!(eventually(is_back), "the {role} was not restarted");
}

/// Waits until the run has written a checkpoint.
fn wait_for_checkpoint(out: &Path) {
    let is_saved = || {
        let saved = fs::read_dir(out.join("checkpoint")).into_iter().flatten().flatten();
        saved.map(|entry| entry.path()).any(|path| path.extension() == Some("safetensors".as_ref()))
    };
    assert!(eventually(is_saved), "no checkpoint in {}", out.display());
}

/// Polls `holds` every 20 ms for up to two minutes.
fn eventually(holds: impl Fn() -> bool) -> bool {
    (0..6000).any(|_| {
        std::thread::sleep(Duration::from_millis(20));
        holds()
    })
}

fn directory() -> (TempDir, PathBuf) {
    let keep = tempfile::tempdir().expect("a directory");
    let out = keep.path().join("run");
    (keep, out)
}

/// Copies the undisturbed run.
fn finished() -> (TempDir, PathBuf) {
    let (keep, out) = directory();
    let copied =
        Command::new("cp").arg("-a").arg(UNDISTURBED.0.path().join("run")).arg(&out).status();
    assert!(copied.expect("cp runs").success());
    (keep, out)
}

#[test]
fn a_refused_resume_leaves_the_active_run_alone() {
    let (keep, out) = directory();
    let run = start(&out);
    wait_for_checkpoint(&out);
    // The run must not end before every resume has been tried.
    let workers = pids(&run, "worker");
    workers.iter().for_each(|pid| signal("-STOP", *pid));
    let (before, other) = (saved_files(&out), other_teacher(keep.path()));
    for name in fs::read_dir(&out).expect("a run").flatten().map(|entry| entry.file_name()) {
        if name.as_bytes().ends_with(b".lock") {
            fs::remove_file(out.join(name)).expect("removes");
        }
    }
    for more in [&[][..], &["--set", "ddpg.discount=0.5"], &["--teacher", &other]] {
        check_refused(&resume(&out, more), 75, "another process uses");
        assert_eq!(saved_files(&out), before, "{more:?}");
    }
    kill_one(&run, "learner");
    assert_eq!(saved_files(&out), before);
    // Edits of the run file have no effect either.
    let text = String::from_utf8_lossy(&before[0]).replace("discount = 0.95", "discount = 0.5");
    assert_ne!(text.as_bytes(), before[0]);
    fs::write(out.join("run.toml"), text).expect("writable");
    fs::copy(&other, out.join("policy/teacher.safetensors")).expect("writable");
    kill_one(&run, "teacher");
    kill_one(&run, "learner");
    workers.iter().for_each(|pid| signal("-CONT", *pid));
    assert_eq!(digest(&run.wait_with_output().expect("ends")), UNDISTURBED.1);
    assert!(!out.join("in-use").exists(), "the marker is removed at the end of the run");
}

#[test]
fn a_resume_with_other_settings_is_refused_and_names_them() {
    let (keep, out) = finished();
    let (before, other) = (saved_files(&out), other_teacher(keep.path()));
    let refusals = [
        ("ddpg.n_hidden=64", "tandem: ddpg.n_hidden is 64 here and 32 in the run's checkpoint \""),
        ("ddpg.discount=0.5", "tandem: ddpg.discount is 0.5 here and 0.95 in the run's checkpoint"),
        ("seed=77", "tandem: seed is 77 here and 1 in"),
        ("advice.budget=99", "tandem: advice.budget is 99 here and 750 in"),
    ];
    for (setting, what) in refusals {
        check_refused(&resume(&out, &["--set", setting]), 64, what);
    }
    check_refused(&resume(&out, &["--teacher", &other]), 64, "another policy");
    check_refused(&resume(&out, &["--arms", "1"]), 64, "arms is 1 here and 2 in the run file");
    assert_eq!(saved_files(&out), before);

    let changed = keep.path().join("changed.toml");
    let text = String::from_utf8_lossy(&before[0]).replace("n_hidden = 32", "n_hidden = 64");
    fs::write(&changed, text).expect("writable");
    let args = ["learner", "--start-or-resume", "--teacher", "127.0.0.1:1", "--run"];
    let refused = tandem(&[&args[..], &[changed.to_str().expect("UTF-8")]].concat(), &out).output();
    let refused = refused.expect("runs");
    assert_eq!(refused.status.code(), Some(64), "{}", stderr(&refused));
    assert!(
        stderr(&refused).contains("ddpg.n_hidden is 64 here and 32 in"),
        "{}",
        stderr(&refused)
    );
    assert_eq!(saved_files(&out), before);

    assert_eq!(digest(&resume(&out, &[])), UNDISTURBED.1, "the run can still be resumed");
}

#[test]
fn a_lost_copy_of_the_teacher_is_replaced_by_the_same_teacher_only() {
    let (keep, out) = finished();
    let copy = out.join("policy/teacher.safetensors");
    let kept = keep.path().join("kept.safetensors");
    fs::rename(&copy, &kept).expect("moves");
    let other = other_teacher(keep.path());
    check_refused(&resume(&out, &["--teacher", &other]), 64, "another policy");
    assert!(!copy.exists());
    let given = kept.to_str().expect("UTF-8");
    assert_eq!(digest(&resume(&out, &["--teacher", given])), UNDISTURBED.1);
    fs::copy(&other, &copy).expect("writable");
    check_refused(&resume(&out, &[]), 64, "another policy");
}

#[test]
fn a_run_whose_ledger_loses_its_log_restarts_the_teacher() {
    let (_keep, out) = directory();
    let run = start(&out);
    wait_for_checkpoint(&out);
    fs::remove_file(out.join("ledger.sqlite-wal")).expect("the log of a ledger in use");
    let ended = run.wait_with_output().expect("ends");
    assert_eq!(digest(&ended), UNDISTURBED.1);
    let log = fs::read_to_string(out.join("tandem.log")).expect("a log");
    assert!(log.contains("a file beside the ledger was removed or replaced"), "{log}");
}

#[test]
fn a_finished_run_can_be_extended() {
    let (_keep, out) = finished();
    let longer = resume(&out, &["--max-env-steps", "5600"]);
    assert_ne!(digest(&longer), UNDISTURBED.1);
    let summary = String::from_utf8_lossy(&longer.stdout);
    assert!(summary.contains("\"env_steps\":5600,"), "{summary}");
    let settings = fs::read_to_string(out.join("run.toml")).expect("readable");
    assert!(settings.contains("max_env_steps = 5600"), "{settings}");
    let again = resume(&out, &[]);
    assert_eq!(digest(&again), digest(&longer), "the extension is kept");
    let remark = "nothing was trained: 5600 environment steps reached; a larger --max-env-steps";
    assert!(stderr(&again).contains(remark), "{}", stderr(&again));
    assert!(!stderr(&longer).contains("nothing was trained"), "{}", stderr(&longer));
}

#[test]
fn a_longer_run_file_keeps_the_interval_between_evaluations() {
    let (keep, out) = directory();
    let file = keep.path().join("short.toml");
    let play = |program_args: &[&str], max_env_steps: u64| {
        let settings = "name = \"run\"\n[advice]\nstrategy = \"none\"\n[rounds]\nrollouts = 1\nupdates_per_env_step = 0.1\n\
                        [ddpg]\nn_hidden = 32\n[evaluation]\nepisodes = 8\ntest_episodes = 8\n";
        let text = format!("{settings}[stop]\nmax_env_steps = {max_env_steps}\n");
        fs::write(&file, text).expect("writable");
        let ended = tandem(program_args, &out).arg("--run").arg(&file).output().expect("runs");
        assert!(ended.status.success(), "{:?}: {}", ended.status, stderr(&ended));
    };
    play(&["train", "--json", "--workers", "2"], 1600);
    play(&["train", "--json", "--workers", "2", "--resume"], 3200);
    let settings = fs::read_to_string(out.join("run.toml")).expect("readable");
    assert!(settings.contains("every_env_steps = 320\n"), "{settings}");
    assert!(settings.contains("max_env_steps = 3200\n"), "{settings}");
    // A finished run ends at once.
    play(&["learner", "--start-or-resume"], 3200);
}

#[test]
fn a_run_goes_on_with_its_own_program_after_another_has_taken_its_place() {
    let (keep, out) = directory();
    let program = keep.path().join("tandem");
    fs::copy(env!("CARGO_BIN_EXE_tandem"), &program).expect("a copy");
    let args = [&["train", "--json", "--workers", "2"], &SMALL[..]].concat();
    let mut command = Command::new(&program);
    command.args(args).arg("--out").arg(&out).current_dir(env!("CARGO_MANIFEST_DIR"));
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let run = command.spawn().expect("starts");
    assert!(eventually(|| pids(&run, "worker").len() == 2), "the workers do not start");
    fs::remove_file(&program).expect("removes");
    fs::write(&program, "not a program").expect("writable");
    kill_one(&run, "worker");
    assert_eq!(digest(&run.wait_with_output().expect("ends")), UNDISTURBED.1);
}

#[test]
fn an_interrupted_run_whose_directory_was_moved_says_so() {
    let (keep, out) = directory();
    let run = start(&out);
    wait_for_checkpoint(&out);
    fs::rename(&out, keep.path().join("moved")).expect("moves");
    signal("-INT", run.id());
    let ended = run.wait_with_output().expect("ends");
    let message = stderr(&ended);
    assert_eq!(ended.status.code(), Some(75), "{message}");
    let line = message.lines().last().unwrap_or_default();
    let is_named = line.contains("was moved, removed or replaced");
    assert!(is_named && !message.contains("is saved"), "{message}");
}

#[test]
fn a_new_run_is_not_put_among_other_runs() {
    let (keep, out) = finished();
    let refused = tandem(&["train"], keep.path()).output().expect("runs");
    check_refused(&refused, 64, "holds other runs, such as");
    let sweep = keep.path().join("sweep.toml");
    fs::write(&sweep, "seeds = [1]\n[run]\nstop.max_env_steps = 800\n").expect("writes");
    let sweep = sweep.to_str().expect("UTF-8");
    let refused = tandem(&["sweep", sweep], &out).output().expect("runs");
    check_refused(&refused, 64, "holds a run: choose another --out");
}

#[test]
fn a_run_without_a_checkpoint_keeps_the_settings_of_its_run_file() {
    let (_keep, out) = finished();
    fs::remove_dir_all(out.join("checkpoint")).expect("removes");
    let refused = resume(&out, &["--set", "ddpg.n_hidden=64"]);
    check_refused(&refused, 64, "tandem: ddpg.n_hidden is 64 here and 32 in the run's ");
    assert!(stderr(&refused).contains("run.toml"), "{}", stderr(&refused));
}

#[test]
fn a_run_killed_and_resumed_at_once_reaches_the_same_result() {
    let (_keep, out) = directory();
    let mut run = start(&out);
    wait_for_checkpoint(&out);
    signal("-KILL", run.id());
    assert_eq!(digest(&resume(&out, &[])), UNDISTURBED.1);
    run.wait().expect("is gone");
}

#[test]
fn a_resume_waits_for_the_teacher_of_an_earlier_start() {
    let (_keep, out) = finished();
    let mut teacher = Command::new(env!("CARGO_BIN_EXE_tandem"))
        .arg("teacher")
        .args(["--policy".as_ref(), out.join("policy/teacher.safetensors").as_os_str()])
        .args(["--ledger".as_ref(), out.join("ledger.sqlite").as_os_str()])
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("starts");
    let mut line = String::new();
    let output = teacher.stdout.take().expect("piped");
    BufReader::new(output).read_line(&mut line).expect("readable");
    let mut resumed = tandem(&["train", "--json", "--resume"], &out).spawn().expect("starts");
    let mut messages = BufReader::new(resumed.stderr.take().expect("piped"));
    let mut line = String::new();
    messages.read_line(&mut line).expect("readable");
    assert!(line.contains("teacher of an earlier start still uses"), "{line}");
    signal("-TERM", teacher.id());
    teacher.wait().expect("ends");
    let rest =
        std::thread::spawn(move || messages.lines().map_while(Result::ok).collect::<Vec<_>>());
    assert_eq!(digest(&resumed.wait_with_output().expect("ends")), UNDISTURBED.1);
    drop(rest.join());
}

#[test]
fn a_teacher_killed_during_startup_is_restarted() {
    let (_keep, out) = directory();
    let run = start(&out);
    assert!((0..20_000).any(|_| {
        std::thread::sleep(Duration::from_millis(1));
        pids(&run, "teacher").first().is_some_and(|pid| {
            signal("-KILL", *pid);
            true
        })
    }));
    let ended = run.wait_with_output().expect("ends");
    assert_eq!(digest(&ended), UNDISTURBED.1);
    let line = "the teacher was killed by signal 9 and is restarted";
    assert!(stderr(&ended).contains(line), "{}", stderr(&ended));
}

#[test]
fn a_run_directory_name_need_not_be_utf8() {
    let keep = tempfile::tempdir().expect("a directory");
    let out = keep.path().join(OsStr::from_bytes(b"run \xff"));
    assert_eq!(digest(&start(&out).wait_with_output().expect("ends")), UNDISTURBED.1);
    assert_eq!(digest(&resume(&out, &[])), UNDISTURBED.1);
    assert!(out.join("report.html").exists());
}
