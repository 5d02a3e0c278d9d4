//! The built program, as a service and as a command with unusable input.

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::net::{SocketAddr, TcpListener};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use tempfile::TempDir;

/// A process that is killed on drop.
pub(crate) struct Running {
    child: Child,
    /// The process's working directory.
    _directory: TempDir,
    /// The address of a service. Unused for workers.
    pub(crate) address: SocketAddr,
}

impl Running {
    /// Starts a process that does not listen.
    pub(crate) fn start(args: &[&str]) -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        let mut command = command(args, directory.path());
        let child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("starts");
        Self { child, _directory: directory, address: ([127, 0, 0, 1], 0).into() }
    }

    /// Starts a service and reads its address.
    pub(crate) fn service(args: &[&str]) -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        let mut command = command(args, directory.path());
        let child = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn();
        let mut child = child.expect("starts");
        let mut line = String::new();
        let mut output = BufReader::new(child.stdout.take().expect("piped"));
        output.read_line(&mut line).expect("a line");
        let address = line.trim().strip_prefix("listening on ").expect("the line").parse();
        Self { child, _directory: directory, address: address.expect("an address") }
    }

    /// Returns the peak resident memory, MiB.
    pub(crate) fn peak_mib(&self) -> u64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.child.id()));
        let status = status.expect("the process runs");
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).expect("a figure");
        let kib: u64 = line.split_whitespace().next().expect("a number").parse().expect("kB");
        kib / 1024
    }

    /// Waits for the process and returns true if it succeeded in time.
    pub(crate) fn ends_well(&mut self) -> bool {
        for _ in 0..1200 {
            if let Some(status) = self.child.try_wait().expect("there") {
                return status.success();
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        false
    }

    /// Sends SIGTERM and returns true if the process then succeeds in time.
    pub(crate) fn ends_on_sigterm(&mut self) -> bool {
        let sent = Command::new("kill").args(["-TERM", &self.child.id().to_string()]).status();
        sent.expect("kill runs").success() && self.ends_well()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        drop(self.child.kill());
        drop(self.child.wait());
    }
}

/// Returns the command that runs the program in `directory` without outside settings.
fn command(args: &[&str], directory: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.args(args).stdin(Stdio::null()).current_dir(directory);
    for variable in ["RUST_LOG", "TANDEM_LEDGER", "TANDEM_TOKEN_FILE"] {
        command.env_remove(variable);
    }
    command
}

/// Returns the path of a shipped policy.
pub(crate) fn shipped(name: &str) -> String {
    format!("{}/policies/{name}.safetensors", env!("CARGO_MANIFEST_DIR"))
}

/// Creates unusable files and directories under the names that [`CASES`] refers to.
fn prepare(directory: &Path) {
    let whole = fs::read(shipped("teacher-push")).expect("ships");
    let mut altered = whole.clone();
    *altered.last_mut().expect("not empty") ^= 1;
    let files: [(&str, &[u8]); 10] = [
        ("whole", &whole),
        ("empty", b""),
        ("garbage", &[0x8f; 3000]),
        ("torn", &whole[..1000]),
        ("altered", &altered),
        ("utf16.toml", b"\xff\xfes\0e\0e\0d\0"),
        ("unknown.toml", b"[ddpg]\ndiscont = 0.9\n"),
        ("twice.toml", b"seed = 1\nseed = 2\n"),
        ("advised.toml", b"arms = 2\n"),
        ("no-speed.json", b"{\"way_points\": []}"),
    ];
    for (name, bytes) in files {
        fs::write(directory.join(name), bytes).expect("written");
    }
    fs::create_dir(directory.join("folder")).expect("created");
    fs::create_dir_all(directory.join("runs/half")).expect("created");
    fs::write(directory.join("runs/half/run.toml"), "arms = 1\n").expect("written");
    let made = Command::new("mkfifo").arg(directory.join("pipe")).status();
    assert!(made.expect("mkfifo runs").success());
}

/// Command lines, their exit codes and a part of the error message. `@name` is a prepared file or directory, `@empty/x`
/// a path that cannot be written, `%name` a shipped policy and `BUSY` an address in use.
const CASES: [(&str, i32, &str); 114] = [
    ("", 64, "Usage"),
    ("dance", 64, "dance"),
    ("--log [[ policy show %teacher-push", 64, "[["),
    ("train --no-such-flag", 64, "--no-such-flag"),
    ("train --run @missing.toml", 64, "missing.toml"),
    ("train --run @folder", 64, "folder"),
    ("train --run @garbage", 64, "garbage"),
    ("train --run @utf16.toml", 64, "UTF-8"),
    ("train --run @unknown.toml", 64, "did you mean \"ddpg.discount\"?"),
    ("train --run @twice.toml", 64, "line 2"),
    ("train --run @empty/x", 64, "empty/x"),
    ("train --set ddpg.discont=0.9", 64, "ddpg.discount"),
    ("train --set ddpg.discount", 64, "KEY=VALUE"),
    ("train --set ddpg.discount=nan", 64, "[0, 1)"),
    ("train --max-minutes nan", 64, "stop.max_minutes"),
    ("train --arms 3", 64, "1 or 2"),
    ("train --set rounds.slots=4096 --set rounds.rollouts=17", 64, "65,536 / rounds.rollouts"),
    ("train --no-dashboard --set ddpg.n_hidden=4096 --set ddpg.n_hidden_layers=2", 64, "66 MiB"),
    ("train --arms two", 64, "two"),
    ("train --seed -1", 64, "-1"),
    ("train --seed 18446744073709551615", 64, "below 2^63"),
    ("train --max-env-steps 1e19", 64, "below 2^63"),
    ("train --live --record none", 64, "--live shows recorded episodes"),
    ("train --task shove", 64, "shove"),
    ("train --strategy bogus", 64, "bogus"),
    ("train --workers 0", 64, "--workers"),
    ("train --resume", 64, "--resume needs --out DIR"),
    ("train --resume --out @folder", 64, "folder"),
    ("train --teacher @missing", 65, "missing"),
    ("train --teacher @torn", 65, "torn"),
    ("train --teacher %student-push", 64, "drives 2 arms"),
    ("train --teacher %teacher-pick-and-place", 64, "pick-and-place"),
    ("train --out @empty/x", 64, "empty is a file"),
    ("train --out @empty", 64, "it is a file"),
    ("train --resume --out @empty", 64, "it is a file"),
    ("eval", 64, "--policy"),
    ("policy export @whole --onnx @whole", 64, "FILE is the same file"),
    (
        "policy export @whole --onnx @a.onnx --critic-onnx @folder/../a.onnx",
        64,
        "--onnx is the same file",
    ),
    ("eval --policy @missing", 65, "missing"),
    ("eval --policy @folder", 65, "folder is a directory without policy/best.safetensors"),
    ("train --teacher @runs/half", 65, "without policy/best.safetensors"),
    ("teacher --ledger memory --policy @runs/half", 65, "without policy/best.safetensors"),
    ("eval --policy @empty", 65, "empty"),
    ("eval --policy @garbage", 65, "garbage"),
    ("eval --policy @altered", 65, "digest"),
    ("eval --policy %teacher-push --arms 2", 64, "1 arm"),
    ("eval --policy %teacher-push --episodes 0", 64, "episodes"),
    ("eval --policy %teacher-push --episodes 1 --record @empty/x.mcap", 64, "x.mcap"),
    ("eval --policy %teacher-push --episodes 1 --record-dir @empty/x", 64, "empty/x"),
    ("eval --composed-teachers %student-push --robustness", 64, "a teacher drives one"),
    ("eval --composed-teachers %teacher-push --robustness --baselines", 64, "--policy"),
    ("eval --composed-teachers %teacher-push --baselines", 64, "--policy"),
    ("eval --policy %teacher-push --episodes 1 --record @folder", 64, "not a regular file"),
    ("eval --policy @whole --episodes 1 --record @whole", 64, "--policy is the same file"),
    (
        "eval --policy @whole --episodes 1 --record @x.png --film @x.png",
        64,
        "--record is the same file",
    ),
    ("report @folder --out @whole", 64, "the name must end in .html"),
    ("bridge trial --policy %student-push --policy %student-push", 64, "\"student-push\""),
    ("bridge trial --policy %student-push --mode twin --mode twin", 64, "--mode twin"),
    ("bench scale --workers 0 --idle 0", 64, "nothing to measure"),
    ("eval --policy %teacher-push --robustness --baselines", 64, "--baselines"),
    ("eval --policy %teacher-push --robustness --film @empty/x.gif", 64, "--film"),
    ("eval --policy %teacher-push --film @empty/x.gif", 64, "there is no directory"),
    ("report @folder --csv @empty/x.csv", 64, "there is no directory"),
    ("eval --composed-teachers %student-push", 64, "a teacher drives one"),
    (
        "eval --composed-teachers %teacher-pick-and-place-classic --task carry-bar --arms 1",
        64,
        "--arms 1: carry-bar takes two arms",
    ),
    ("teacher", 64, "--policy"),
    ("teacher --policy @missing", 65, "missing"),
    ("teacher --policy @torn", 65, "torn"),
    ("teacher --policy %student-push", 64, "drives 1 arm"),
    ("teacher --policy %teacher-push --listen BUSY", 75, "cannot listen"),
    ("teacher --policy %teacher-push --listen nowhere", 64, "nowhere"),
    ("learner --run @missing.toml --out @out", 64, "missing.toml"),
    ("learner --run @unknown.toml --out @out", 64, "ddpg.discont"),
    (
        "learner --run @advised.toml --out @out --teacher 127.0.0.1:1 --listen BUSY",
        75,
        "cannot listen",
    ),
    ("learner --run @advised.toml --out @out", 64, "teacher"),
    ("learner --run @advised.toml --out @empty/x --teacher 127.0.0.1:1", 64, "empty is a file"),
    ("worker", 64, "--connect"),
    ("policy show @missing", 65, "missing"),
    ("policy show @folder --json", 65, "folder"),
    ("mcap recover @missing", 65, "missing"),
    ("mcap recover @folder --to @mended", 65, "folder"),
    ("mcap recover @garbage --to @mended", 65, "garbage\" is not an MCAP file"),
    ("mcap recover @garbage --to @empty", 64, "exists"),
    ("replay", 64, "FILE"),
    ("replay @missing", 65, "missing"),
    ("replay @folder", 65, "no *.mcap"),
    ("replay @empty --verify", 65, "empty"),
    ("replay @garbage --live --json", 64, "leave out --film, --json"),
    ("picture --policy %teacher-push --out @empty/x.png", 64, "x.png"),
    ("picture --policy %teacher-push --out arms.svg", 64, "must end in .png"),
    ("eval --policy %teacher-push --film arms.mp4", 64, "must end in .gif"),
    ("eval --policy %teacher-push --film arms.gif --film-size 9x9", 64, "expected 64 to 4096"),
    ("eval --policy %teacher-push --film arms.gif --film-speed nan", 64, "expected 0.05 to 20"),
    ("bench dance", 64, "dance"),
    ("train --teacher /dev/zero", 65, "\"/dev/zero\": it is not a regular file"),
    ("train --run /dev/zero", 64, "it has more than 16 MiB"),
    ("eval --policy @pipe", 65, "it is not a regular file"),
    ("eval --policy %teacher-push --episodes 1 --record @pipe", 64, "it is not a regular file"),
    ("replay @pipe", 65, "it is not a regular file"),
    ("mcap recover @pipe --to @mended", 65, "it is not a regular file"),
    ("report @empty", 65, "no metrics row"),
    ("report @garbage", 65, "no metrics row"),
    ("bridge move /dev/zero", 65, "it has more than 16 MiB"),
    ("bridge move @no-speed.json", 65, "it has no speed: add \"speed\": 1.0, or give --speed"),
    ("bridge status --connect 127.0.0.1:1", 75, "start one with `tandem bridge --driver sim`"),
    ("status 127.0.0.1:1", 75, "nothing listens there; `tandem status DIR` shows a `tandem train`"),
    ("status @missing", 64, "expected HOST:PORT"),
    ("status @folder", 64, "holds no run"),
    ("status @runs/half", 75, "no learner of a `tandem train` is running in"),
    ("train --resume", 64, "there are: runs/half (not saved yet)"),
    ("train --resume --out @out", 64, "holds no run to resume; there are: runs/half"),
    ("health 127.0.0.1:1 --tls-ca /dev/zero", 64, "it has more than 16 MiB"),
    ("sweep @empty --dry-run", 64, "is empty"),
    ("sweep /dev/null --dry-run", 64, "is empty"),
];

#[test]
fn unusable_inputs_are_reported_in_one_line() {
    let directory = tempfile::tempdir().expect("a directory");
    prepare(directory.path());
    let busy = TcpListener::bind("127.0.0.1:0").expect("a free address");
    let busy = busy.local_addr().expect("an address").to_string();
    for (line, code, expected) in CASES {
        let args: Vec<String> = line
            .split_whitespace()
            .map(|arg| match (arg.strip_prefix('@'), arg.strip_prefix('%')) {
                (Some(name), _) => directory.path().join(name).display().to_string(),
                (_, Some(name)) => shipped(name),
                _ => arg.replace("BUSY", &busy),
            })
            .collect();
        let args: Vec<&str> = args.iter().map(String::as_str).collect();
        let output = command(&args, directory.path()).output().expect("runs");
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{line}: {stderr}");
        assert!(stderr.contains(expected), "{line}: {stderr:?} lacks {expected:?}");
        assert!(
            !stderr.contains("panicked") && !stderr.contains("RUST_BACKTRACE"),
            "{line}: {stderr}"
        );
        let lines = stderr
            .lines()
            .filter(|line| line.starts_with("tandem: ") || line.starts_with("error: "));
        assert!(lines.count() == 1 || stderr.starts_with("Trains policies"), "{line}: {stderr}");
        if stderr.starts_with("tandem: ") {
            assert_eq!(stderr.lines().count(), 1, "{line}: {stderr}");
        }
        assert!(stderr.len() < 3000, "{line}: {} bytes", stderr.len());
    }
    assert!(!directory.path().join("mended").exists(), "garbage was recovered");
}

/// Options of a report, each with a path.
type Options<'a> = &'a [(&'a str, &'a str)];

/// A directory with the run `done`, of which reports are made.
struct Reports {
    directory: TempDir,
    metrics: Vec<u8>,
}

impl Reports {
    fn new() -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        prepare(directory.path());
        let recorded = format!(
            "{}/docs/results/students/shared-push-2-mc-q-0.1-seed1/metrics.jsonl",
            env!("CARGO_MANIFEST_DIR")
        );
        let metrics = fs::read(recorded).expect("metrics");
        fs::create_dir(directory.path().join("done")).expect("created");
        fs::write(directory.path().join("done/metrics.jsonl"), &metrics).expect("written");
        Self { directory, metrics }
    }

    fn path(&self, name: &str) -> String {
        self.directory.path().join(name).display().to_string()
    }

    /// Makes the report of `run` with `options`, whose paths are in the directory. Returns its exit code and output.
    fn of(&self, run: &str, options: Options<'_>) -> (Option<i32>, String, String) {
        let mut args = vec!["report".to_owned(), self.path(run)];
        let options = options.iter().flat_map(|(name, path)| [(*name).to_owned(), self.path(path)]);
        args.extend(options);
        let args: Vec<&str> = args.iter().map(String::as_str).collect();
        let output = command(&args, self.directory.path()).output().expect("runs");
        let [stdout, stderr] = [output.stdout, output.stderr].map(String::from_utf8);
        (output.status.code(), stdout.expect("text"), stderr.expect("text"))
    }
}

#[test]
fn a_report_prints_its_tables_without_a_page_and_replaces_no_file_of_a_run() {
    let reports = Reports::new();
    let (code, tables, message) = reports.of("done", &[("--out", "empty/x.html")]);
    assert_eq!(code, Some(64), "{message}");
    assert!(message.contains("choose another --out"), "{message}");
    assert!(
        tables.contains("success of the policy alone") && !tables.contains("report  "),
        "{tables}"
    );
    let policy = fs::read(shipped("student-push")).expect("ships");
    fs::create_dir(reports.path("done/policy")).expect("created");
    fs::write(reports.path("done/policy/best.safetensors"), &policy).expect("written");
    fs::create_dir(reports.path("other")).expect("created");
    fs::write(reports.path("other/metrics.jsonl"), &reports.metrics).expect("written");
    let best = ("--csv", "done/policy/best.safetensors");
    let cases: [(&str, Options<'_>, &str); 5] = [
        ("done", &[("--csv", "done/metrics.jsonl")], "that the report reads"),
        ("done", &[best], "that the report reads"),
        ("done", &[("--markdown", "done/policy/teacher.toml")], "that the report reads"),
        ("other", &[best, ("--film-strips", "done")], "--film-strips is the same file"),
        ("other", &[best, ("--composed-teachers", "done")], "--composed-teachers is the same file"),
    ];
    for (run, options, expected) in cases {
        let (code, tables, message) = reports.of(run, options);
        assert_eq!((code, tables.as_str()), (Some(64), ""), "{options:?}: {message}");
        assert!(message.contains(expected), "{options:?}: {message}");
    }
    let content = |name: &str| fs::read(reports.path(name)).expect("there");
    assert!(content("done/metrics.jsonl") == reports.metrics, "the metrics are replaced");
    assert!(content("done/policy/best.safetensors") == policy, "the policy is replaced");
}

#[test]
fn a_report_lists_the_files_that_it_has_written_and_reports_each_other_one() {
    let reports = Reports::new();
    let (page, no_page) = (("--out", "x.html"), ("--out", "empty/x.html"));
    let (csv, no_csv) = (("--csv", "x.csv"), ("--csv", "/proc/x.csv"));
    let markdown = ("--markdown", "m.md");
    let no_page_message = "the page is not written, choose another --out";
    let cases: [(Options<'_>, &[&str], &[&str]); 3] = [
        (&[page, no_csv, markdown], &["report", "markdown"], &["cannot write /proc/x.csv"]),
        (&[no_page, csv], &["csv"], &[no_page_message]),
        (
            &[no_page, no_csv, markdown],
            &["markdown"],
            &["cannot write /proc/x.csv", no_page_message],
        ),
    ];
    for (options, listed, failed) in cases {
        let (code, tables, message) = reports.of("done", options);
        assert_eq!(code, Some(64), "{options:?}: {message}");
        let paths = [("report", "x.html"), ("csv", "x.csv"), ("markdown", "m.md")];
        for (label, name) in paths {
            let is_listed = tables.contains(&format!("{label:<13} {}\n", reports.path(name)));
            assert_eq!(is_listed, listed.contains(&label), "{options:?}: {tables}");
            assert_eq!(fs::remove_file(reports.path(name)).is_ok(), is_listed, "{name}");
        }
        assert!(!tables.contains("/proc/") && !tables.contains("empty/"), "{options:?}: {tables}");
        let errors: Vec<&str> =
            message.lines().filter(|line| line.starts_with("tandem: ")).collect();
        assert_eq!(errors.len(), failed.len(), "{options:?}: {message}");
        for (error, expected) in errors.iter().zip(failed) {
            assert!(error.contains(expected), "{options:?}: {error}");
        }
    }
}

#[test]
fn reading_a_pipe_without_a_writer_times_out() {
    let directory = tempfile::tempdir().expect("a directory");
    prepare(directory.path());
    let pipe = directory.path().join("pipe").display().to_string();
    let policy = shipped("teacher-push");
    let lines: [&[&str]; 3] = [
        &["train", "--run", &pipe],
        &["sweep", &pipe],
        &["teacher", "--policy", &policy, "--ledger", "memory", "--token-file", &pipe],
    ];
    let start = |args: &&[&str]| {
        let mut command = command(args, directory.path());
        command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().expect("starts")
    };
    for child in lines.iter().map(start).collect::<Vec<_>>() {
        let ended = child.wait_with_output().expect("ends");
        let stderr = String::from_utf8_lossy(&ended.stderr).into_owned();
        assert_eq!(ended.status.code(), Some(64), "{stderr}");
        assert!(stderr.contains("pipe\"") && stderr.contains("no end of it came"), "{stderr}");
    }
}

#[test]
fn a_text_file_can_be_a_pipe() {
    let directory = tempfile::tempdir().expect("a directory");
    let script = r#"exec "$0" sweep <(printf 'seeds = [1, 2]\n[run]\nstop.max_env_steps = 800\n') --dry-run"#;
    let mut shell = Command::new("bash");
    shell.args(["-c", script, env!("CARGO_BIN_EXE_tandem")]).current_dir(directory.path());
    let output = shell.output().expect("runs");
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{stderr}");
    assert!(String::from_utf8_lossy(&output.stdout).contains("2 runs"), "{stderr}");
}
