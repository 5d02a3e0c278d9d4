//! Runs, evaluations and sweeps of a task that is not built-in, from the command line.

#[path = "described/policy.rs"]
mod policy;
#[path = "described/reach.rs"]
mod reach;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::LazyLock;
use std::time::Duration;

use serde_json::Value;
use tandem_core::{Task, TaskSpec};
use tempfile::TempDir;

use policy::PolicyServer;
use reach::{ReachServer, one_arm, two_arms};

/// A small run of ten rounds, each with 160 environment steps.
const SMALL: [&str; 18] = [
    "--max-env-steps",
    "1600",
    "--set",
    "ddpg.n_hidden=32",
    "--set",
    "ddpg.batch_size=64",
    "--set",
    "rounds.updates_per_env_step=0.2",
    "--set",
    "rounds.warmup_env_steps=160",
    "--set",
    "evaluation.episodes=8",
    "--set",
    "evaluation.test_episodes=20",
    "--set",
    "evaluation.every_env_steps=800",
    "--set",
    "checkpoint.every_rounds=1",
];

fn tandem(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.args(args).current_dir(env!("CARGO_MANIFEST_DIR"));
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn run(args: &[&str]) -> Output {
    tandem(args).output().expect("runs")
}

fn text(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Returns the JSON object on the last line of standard output.
fn json(output: &Output) -> Value {
    assert!(output.status.success(), "{:?}: {}", output.status, stderr(output));
    let text = String::from_utf8_lossy(&output.stdout);
    serde_json::from_str(text.lines().last().expect("a line")).expect("an object")
}

/// Checks that a command ended with `code` and printed one line that contains `what`.
fn check_refused(refused: &Output, code: i32, what: &str) {
    let message = stderr(refused);
    assert_eq!(refused.status.code(), Some(code), "{message}");
    assert!(message.contains(what), "{message:?} lacks {what:?}");
    assert_eq!(message.lines().count(), 1, "{message}");
}

/// Arguments of the advised two-arm run.
fn advised<'a>(server: &'a ReachServer, teacher: &'a Path, out: &'a Path) -> Vec<&'a str> {
    let mut args = vec!["train", "--json", "--workers", "2", "--strategy", "mc-q:0"];
    args.extend(["--budget", "300", "--env", &server.address, "--teacher", text(teacher)]);
    args.extend(SMALL);
    args.extend(["--out", text(out)]);
    args
}

/// A teacher for one arm and a student for two, trained once for all tests.
struct Trained {
    keep: TempDir,
    teacher: Value,
    student: Value,
}

impl Trained {
    fn teacher_path(&self) -> PathBuf {
        self.keep.path().join("one/policy/best.safetensors")
    }

    fn student_path(&self) -> PathBuf {
        self.keep.path().join("two/policy/best.safetensors")
    }

    /// Copies the student's run.
    fn copied(&self) -> (TempDir, PathBuf) {
        let keep = tempfile::tempdir().expect("a directory");
        let out = keep.path().join("two");
        let copied =
            Command::new("cp").arg("-a").arg(self.keep.path().join("two")).arg(&out).status();
        assert!(copied.expect("cp runs").success());
        (keep, out)
    }
}

static TRAINED: LazyLock<Trained> = LazyLock::new(|| {
    let keep = tempfile::tempdir().expect("a directory");
    let (one, two) = (ReachServer::start(one_arm()), ReachServer::start(two_arms()));
    let out = keep.path().join("one");
    let args = ["train", "--json", "--env", &one.address, "--out", text(&out)];
    let teacher = json(&run(&[&args[..], &SMALL].concat()));
    let path = out.join("policy/best.safetensors");
    let student = json(&run(&advised(&two, &path, &keep.path().join("two"))));
    Trained { keep, teacher, student }
});

/// Polls `holds` every 20 ms for up to two minutes.
fn eventually(holds: impl Fn() -> bool) -> bool {
    (0..6000).any(|_| {
        std::thread::sleep(Duration::from_millis(20));
        holds()
    })
}

/// Returns the two-arm task with another tolerance.
fn other_task() -> TaskSpec {
    let mut description = two_arms().description().clone();
    description.tolerance = 0.5;
    TaskSpec::new(description).expect("consistent")
}

#[test]
fn a_student_of_two_arms_is_advised_by_a_teacher_of_one_and_tested() {
    let (teacher, student) = (&TRAINED.teacher, &TRAINED.student);
    assert_eq!((&teacher["task"], &teacher["arms"]), (&"lab/reach".into(), &1.into()));
    assert_eq!((&student["task"], &student["arms"]), (&"lab/reach".into(), &2.into()));
    for summary in [teacher, student] {
        assert_eq!(summary["episodes"], 20, "{summary}");
        assert!(summary["success"].is_f64() && summary["mean_return"].is_f64(), "{summary}");
    }
    assert_eq!(teacher["advice_spent"], 0);
    let spent = student["advice_spent"].as_u64().expect("a count");
    assert!(spent > 0, "{student}");
    assert_eq!(spent + student["budget_left"].as_u64().expect("a count"), 300);
    assert!(student["environment"].as_str().expect("checked").starts_with("deterministic"));
    let shown = json(&run(&["policy", "show", text(&TRAINED.student_path()), "--json"]));
    assert_eq!(shown["description"]["tolerance"], 0.25, "{shown}");
    let shown = run(&["policy", "show", text(&TRAINED.student_path())]);
    let shown = String::from_utf8_lossy(&shown.stdout).into_owned();
    let line = shown.lines().find(|line| line.starts_with("description "));
    assert!(line.is_some_and(|line| line.contains("\"tolerance\":0.25")), "{shown}");
}

#[test]
fn an_interrupted_run_remembers_its_server_and_ends_with_the_same_digest() {
    let keep = tempfile::tempdir().expect("a directory");
    let (server, out) = (ReachServer::start(two_arms()), keep.path().join("run"));
    // Five of ten rounds, each with 8 slots of 11 requests.
    server.answer_only(440);
    let started = tandem(&advised(&server, &TRAINED.teacher_path(), &out)).spawn();
    let started = started.expect("starts");
    let n_checkpoints =
        || fs::read_dir(out.join("checkpoint")).map_or(0, |saved| saved.flatten().count());
    assert!(eventually(|| server.is_holding() && n_checkpoints() > 1));
    let pid = started.id().to_string();
    assert!(Command::new("kill").args(["-INT", &pid]).status().expect("kill runs").success());
    let interrupted = started.wait_with_output().expect("ends");
    assert_eq!(interrupted.status.code(), Some(130), "{}", stderr(&interrupted));
    let line = format!("  tandem train --resume --out {} --workers 2\n", out.display());
    assert!(stderr(&interrupted).contains(&line), "{}", stderr(&interrupted));
    server.answer_only(usize::MAX);
    let resumed = run(&["train", "--json", "--resume", "--out", text(&out)]);
    let line = format!("environments of the server at {}\n", server.address);
    assert!(stderr(&resumed).contains(&line), "{}", stderr(&resumed));
    let resumed = json(&resumed);
    for key in ["digest", "policy_digest", "advice_spent", "success"] {
        assert_eq!(resumed[key], TRAINED.student[key], "{key}");
    }
}

#[test]
fn a_resumed_run_refuses_a_server_that_now_has_another_task() {
    let (_keep, out) = TRAINED.copied();
    let server = ReachServer::start(two_arms());
    let remembered = out.join("environment.toml");
    fs::write(&remembered, format!("env = {:?}\n", server.address)).expect("writable");
    let files = || {
        ["run.toml", "metrics.jsonl", "environment.toml", "policy/best.safetensors"]
            .map(|name| fs::read(out.join(name)).expect(name))
    };
    let before = files();
    server.set_task(other_task());
    let refused = run(&["train", "--resume", "--out", text(&out)]);
    let what =
        "serves another task than the run's: tolerance is 0.25 in the run and 0.5 at the server";
    check_refused(&refused, 64, what);
    // A server on the command line replaces the remembered one only once the run continues.
    let other = ReachServer::start(other_task());
    let refused = run(&["train", "--resume", "--out", text(&out), "--env", &other.address]);
    check_refused(&refused, 64, what);
    assert!(files() == before, "a refused resume changes nothing");
    let moved = ReachServer::start(two_arms());
    let resumed =
        run(&["train", "--json", "--resume", "--out", text(&out), "--env", &moved.address]);
    assert_eq!(json(&resumed)["digest"], TRAINED.student["digest"]);
    let remembered = fs::read_to_string(remembered).expect("readable");
    assert_eq!(remembered, format!("env = {:?}\n", moved.address));
}

#[test]
fn a_run_keeps_address_and_digest_of_a_teacher_on_a_server() {
    let keep = tempfile::tempdir().expect("a directory");
    let (server, out) = (ReachServer::start(two_arms()), keep.path().join("run"));
    let policy = PolicyServer::start(one_arm());
    let url = PathBuf::from(format!("http://{}", policy.address));
    let trained = json(&run(&advised(&server, &url, &out)));
    assert!(trained["advice_spent"].as_u64() > Some(0), "{trained}");
    let stored = fs::read_to_string(out.join("policy/teacher.toml")).expect("stored");
    assert_eq!(stored, format!("address = {url:?}\ndigest = \"seeker-1\"\n"));
    let resume = || run(&["train", "--json", "--resume", "--out", text(&out)]);
    assert_eq!(json(&resume())["digest"], trained["digest"]);
    policy.set_digest("seeker-2");
    check_refused(&resume(), 64, "has changed since the start of the run (digest seeker-2, not");
    policy.set_task(TaskSpec::built_in(Task::Push, 1));
    let refused = run(&advised(&server, &url, &keep.path().join("other")));
    check_refused(&refused, 64, "is a teacher for push, the run is for lab/reach");
    let args = ["teacher", "--log=warn", "--ledger=memory", "--policy-digest=seeker-1", "--policy"];
    let refused = run(&[&args[..], &[text(&url)]].concat());
    check_refused(&refused, 64, "the policy has digest seeker-2, not seeker-1");
}

#[test]
fn an_evaluation_on_a_server_gives_the_results_of_the_run() {
    let (one, two) = (ReachServer::start(one_arm()), ReachServer::start(two_arms()));
    let eval = |more: &[&str]| run(&[&["eval", "--episodes", "20", "--json"], more].concat());
    let (teacher, student) = (TRAINED.teacher_path(), TRAINED.student_path());
    let evaluated = json(&eval(&["--policy", text(&student), "--env", &two.address]));
    let keys = ["task", "arms", "episodes", "success", "success_per_arm", "mean_return"];
    for key in keys.iter().chain(&["policy_digest"]) {
        assert_eq!(evaluated[key], TRAINED.student[key], "{key}");
    }
    let other = eval(&["--policy", text(&student), "--env", &two.address, "--seed", "5"]);
    assert_ne!(json(&other)["mean_return"], evaluated["mean_return"], "other goals");
    let composed = eval(&["--composed-teachers", text(&teacher), "--env", &two.address]);
    assert_eq!(json(&composed)["arms"], 2);
    let difference =
        "serves another task than the policy's: n_observation is 4 in the policy and 2 for";
    let refused = eval(&["--policy", text(&student), "--env", &one.address]);
    check_refused(&refused, 64, difference);
    two.set_task(other_task());
    let difference = "tolerance is 0.25 in the policy and 0.5 for one arm of the server's task";
    let refused = eval(&["--composed-teachers", text(&teacher), "--env", &two.address]);
    check_refused(&refused, 64, difference);
    let command = format!("`tandem eval --policy {} --env 127.0.0.1:", text(&student));
    check_refused(&eval(&["--policy", text(&student)]), 64, &command);
    let refused = run(&["scene", "--policy", text(&student)]);
    check_refused(&refused, 64, "which the simulator does not have");
    let refused = eval(&["--policy", text(&student), "--env", &two.address, "--arms", "1"]);
    check_refused(&refused, 64, "the policy is for 2 arms, not for 1 arm");
    check_refused(
        &eval(&["--policy", text(&student), "--env", &two.address, "--record", "x.mcap"]),
        64,
        "leave out --env",
    );
}

#[test]
fn a_teacher_goes_to_onnx_and_back_and_advises_in_either_form() {
    let keep = tempfile::tempdir().expect("a directory");
    let (one, two) = (ReachServer::start(one_arm()), ReachServer::start(two_arms()));
    let [actor, critic, back] =
        ["actor.onnx", "critic.onnx", "back.safetensors"].map(|name| keep.path().join(name));
    let trained = TRAINED.teacher_path();
    let export = ["policy", "export", text(&trained), "--onnx", text(&actor), "--critic-onnx"];
    assert!(run(&[&export[..], &[text(&critic)]].concat()).status.success());
    let shown = json(&run(&["policy", "show", text(&actor), "--json"]));
    assert_eq!((&shown["task"], &shown["arms"]), (&"lab/reach".into(), &1.into()));

    let import = |more: &[&str]| {
        let args = ["policy", "import", text(&actor), "--out", text(&back), "--json"];
        run(&[&args[..], &["--critic", text(&critic)], more].concat())
    };
    for server in [&[][..], &["--env", &one.address]] {
        assert_eq!(json(&import(server))["digest"], TRAINED.teacher["policy_digest"]);
        let composed = ["eval", "--composed-teachers", text(&back), "--env", &two.address];
        let evaluated = json(&run(&[&composed[..], &["--episodes", "4", "--json"]].concat()));
        assert_eq!(evaluated["arms"], 2);
    }
    check_refused(&import(&["--env", &two.address]), 65, "lab/reach with 2 arms has");

    let mut args = advised(&two, &actor, keep.path());
    args.extend(["--teacher-critic", text(&critic)]);
    let student = json(&run(&args));
    assert_eq!(student["advice_spent"], TRAINED.student["advice_spent"], "{student}");
}

#[test]
fn a_sweep_trains_runs_of_the_task_of_its_server() {
    let keep = tempfile::tempdir().expect("a directory");
    let (server, out) = (ReachServer::start(one_arm()), keep.path().join("sweep"));
    let settings = SMALL.chunks(2).map(|pair| match pair {
        ["--set", setting] => format!("{setting}\n"),
        _ => "stop.max_env_steps = 1600\n".to_owned(),
    });
    let file = keep.path().join("sweep.toml");
    let lists = format!("seeds = [1, 2]\nenv = {:?}\n[run]\n", server.address);
    fs::write(&file, lists + &settings.collect::<String>()).expect("writable");
    let sweep = || run(&["sweep", text(&file), "--out", text(&out), "--json"]);
    let swept = json(&sweep());
    assert_eq!(swept["finished"], 2, "{swept}");
    assert_eq!(swept["runs"][0]["name"], "lab-reach-none-seed1");
    assert_eq!(swept["runs"][0]["summary"]["digest"], TRAINED.teacher["digest"]);
    assert_eq!(json(&sweep()), swept, "finished runs are not repeated");
}

#[test]
fn a_server_that_sends_nan_ends_the_run_with_one_line() {
    let keep = tempfile::tempdir().expect("a directory");
    let server = ReachServer::start(one_arm());
    server.send_nan();
    let out = keep.path().join("run");
    let args = ["train", "--json", "--env", &server.address, "--out", text(&out)];
    let failed = run(&[&args[..], &SMALL].concat());
    let message = stderr(&failed);
    assert_eq!(failed.status.code(), Some(65), "{message}");
    let last = message.lines().last().unwrap_or_default();
    assert!(last.contains("sent an invalid reply to the reset of episodes"), "{message}");
    assert!(last.contains("observations") && last.contains("NaN"), "{message}");
}

#[test]
fn a_task_without_a_server_is_refused() {
    let (_keep, out) = TRAINED.copied();
    fs::remove_file(out.join("environment.toml")).expect("a file");
    let refused = run(&["train", "--resume", "--out", text(&out)]);
    let what = "task \"lab/reach\" is not built-in: name the server of its environments with --env";
    check_refused(&refused, 64, what);
}

#[test]
fn the_run_file_of_a_served_task_contains_its_description() {
    let (server, keep) =
        (ReachServer::start(two_arms()), tempfile::tempdir().expect("a directory"));
    let file = keep.path().join("run.toml");
    let print = |args: &[&str]| run(&[&["train", "--print-run"], args].concat());
    let printed = print(&["--env", &server.address, "--strategy", "none"]);
    assert!(printed.status.success(), "{}", stderr(&printed));
    let text = String::from_utf8_lossy(&printed.stdout);
    assert!(text.contains("task = \"lab/reach\"") && text.contains("\n[description]\n"), "{text}");
    fs::write(&file, &printed.stdout).expect("writes");
    let again = print(&["--env", &server.address, "--run", self::text(&file)]);
    assert_eq!(again.stdout, printed.stdout, "{}", stderr(&again));
    check_refused(&print(&["--run", self::text(&file)]), 64, "with --env or --env-command");
}
