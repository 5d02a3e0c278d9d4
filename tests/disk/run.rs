//! Runs on the failing disk: started, disturbed, resumed and compared with an undisturbed run.

use std::fs::{self, File};
use std::os::unix::process::ExitStatusExt as _;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::LazyLock;
use std::time::Duration;

use rusqlite::{Connection, OpenFlags};
use serde_json::Value;
use tandem_policy::Policy;
use tandem_telemetry::read_episode;

use crate::device::{Device, Fault, Mode};

/// A small advised run of 6 rounds with a checkpoint after each; its budget runs out on the way.
const SMALL: [&str; 28] = [
    "--arms",
    "1",
    "--strategy",
    "ea",
    "--budget",
    "300",
    "--max-env-steps",
    "2400",
    "--set",
    "rounds.slots=4",
    "--set",
    "rounds.updates_per_env_step=0.05",
    "--set",
    "ddpg.n_hidden=16",
    "--set",
    "evaluation.episodes=4",
    "--set",
    "evaluation.test_episodes=8",
    "--set",
    "evaluation.every_env_steps=800",
    "--set",
    "evaluation.recorded_episodes=1",
    "--set",
    "checkpoint.every_rounds=1",
    "--set",
    "world.substeps=10",
    "--workers",
    "2",
];

/// Ticks of 20 ms after which a run counts as hanging.
const HANG_LIMIT: usize = 6000;
/// Ticks of 20 ms after which a run that waits for its disk is interrupted.
const DISK_WAIT_LIMIT: usize = 50;

/// The result of an undisturbed run, and its disk calls.
pub(crate) static UNDISTURBED: LazyLock<(RunResult, Vec<String>)> = LazyLock::new(|| {
    let device = Device::new();
    let ended = Run::start(&device, None, false).end();
    (RunResult::read(&device, &ended), device.calls())
});

/// The part of a run's output that must not depend on faults.
#[derive(Debug, PartialEq)]
pub(crate) struct RunResult {
    digest: String,
    metrics: Vec<Value>,
    /// Units spent, and every verdict.
    account: Vec<String>,
    /// Digests of the best and the last policy.
    policies: [String; 2],
}

impl RunResult {
    fn read(device: &Device, ended: &Ended) -> Self {
        assert_eq!(ended.status.code(), Some(0), "{}", ended.stderr);
        let out = device.root().join("run");
        let row = |line| -> Value {
            let mut row: Value = serde_json::from_str(line).expect("a row");
            row.as_object_mut().expect("an object").remove("wall_s").expect("a time");
            row
        };
        let metrics = fs::read_to_string(out.join("metrics.jsonl")).expect("metrics");
        let policies = ["policy/best.safetensors", "policy/last.safetensors"];
        Self {
            digest: ended.digest.clone().expect("a digest"),
            metrics: metrics.lines().map(row).collect(),
            account: account(&out.join("ledger.sqlite")),
            policies: policies.map(|name| Policy::load(&out.join(name)).expect(name).digest()),
        }
    }
}

/// Checks that every episode log with its final name is complete.
fn check_logs(device: &Device) {
    let logs = fs::read_dir(device.root().join("run/mcap")).into_iter().flatten().flatten();
    for path in
        logs.map(|entry| entry.path()).filter(|path| path.extension() == Some("mcap".as_ref()))
    {
        read_episode(&path).expect("whole");
    }
}

/// Reads the units spent and the verdicts from a ledger that is not in use.
pub(crate) fn account(ledger: &Path) -> Vec<String> {
    let connection = Connection::open_with_flags(ledger, OpenFlags::SQLITE_OPEN_READ_ONLY);
    let connection = connection.expect("a ledger");
    let sql = "SELECT name || ' ' || budget || ' ' || spent FROM accounts
        UNION ALL SELECT episode || ' ' || word || ' ' || asked || ' ' || charged FROM verdicts
        ORDER BY 1";
    let mut statement = connection.prepare(sql).expect(sql);
    let rows = statement.query_map((), |row| row.get(0)).expect(sql);
    rows.collect::<Result<_, _>>().expect("rows")
}

/// The exit status and output of a finished run.
pub(crate) struct Ended {
    pub(crate) status: ExitStatus,
    /// The content of standard error.
    pub(crate) stderr: String,
    digest: Option<String>,
}

/// A `tandem train` process.
pub(crate) struct Run<'a> {
    device: &'a Device,
    process: Child,
}

impl<'a> Run<'a> {
    pub(crate) fn start(device: &'a Device, fault: Option<&Fault>, resume: bool) -> Self {
        let (output, stderr) = (device.sibling("output"), device.sibling("stderr"));
        let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
        command.args(["train", "--json"]);
        match resume {
            true => command.args(["--resume", "--workers", "2"]),
            false => command.args(SMALL),
        };
        command.arg("--out").arg(device.root().join("run"));
        command.current_dir(env!("CARGO_MANIFEST_DIR")).stdin(Stdio::null());
        command.stdout(File::create(output).expect("creates"));
        command.stderr(File::create(stderr).expect("creates"));
        device.attach(&mut command, fault);
        Self { device, process: command.spawn().expect("starts") }
    }

    fn stderr(&self) -> String {
        fs::read_to_string(self.device.sibling("stderr")).expect("readable")
    }

    fn ended(&self, status: ExitStatus) -> Ended {
        let output = fs::read_to_string(self.device.sibling("output")).expect("readable");
        let after = output.lines().last().and_then(|line| line.split("\"digest\":\"").nth(1));
        let digest = after.and_then(|after| after.split('"').next()).map(str::to_owned);
        Ended { status, stderr: self.stderr(), digest }
    }

    /// Waits for the end and calls `look` periodically.
    fn end_watched(mut self, mut look: impl FnMut(&Self)) -> Ended {
        for _ in 0..HANG_LIMIT {
            if let Some(status) = self.process.try_wait().expect("a child") {
                return self.ended(status);
            }
            look(&self);
            std::thread::sleep(Duration::from_millis(20));
        }
        drop(self.process.kill());
        let status = self.process.wait().expect("a child");
        assert!(
            status.success(),
            "the run neither ends nor says what it waits for: {}",
            self.stderr()
        );
        self.ended(status)
    }

    /// Waits for the end.
    pub(crate) fn end(self) -> Ended {
        self.end_watched(|_| ())
    }

    /// Waits for the end. Interrupts a run that reports that it is waiting for its disk.
    fn end_or_interrupt(self) -> Ended {
        let mut n_waited = 0;
        self.end_watched(|run| {
            n_waited += usize::from(run.device.is_triggered() && names_the_fault(&run.stderr()));
            if n_waited == DISK_WAIT_LIMIT {
                signal("-INT", run.process.id());
            }
        })
    }

    /// Waits for the power cut, then kills every process.
    fn end_by_power_cut(mut self) -> Ended {
        for _ in 0..HANG_LIMIT {
            if self.device.is_triggered() || self.process.try_wait().expect("a child").is_some() {
                break;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        if self.process.try_wait().expect("a child").is_none() {
            let parent = self.process.id();
            signal("-STOP", parent);
            let children = fs::read_to_string(format!("/proc/{parent}/task/{parent}/children"));
            for pid in children.unwrap_or_default().split_whitespace() {
                signal("-KILL", pid.parse().expect("a number"));
            }
            signal("-KILL", parent);
        }
        let status = self.process.wait().expect("a child");
        self.device.lose_unsynced();
        self.ended(status)
    }
}

pub(crate) fn signal(signal: &str, pid: u32) {
    let sent = Command::new("kill").args([signal, &pid.to_string()]).stderr(Stdio::null()).status();
    sent.expect("kill runs");
}

/// Returns true if a line names the file that cannot be written and the cause.
pub(crate) fn names_the_fault(stderr: &str) -> bool {
    let of_sqlite = ["disk I/O error", "disk is full", "unable to open database file"];
    let causes = [&["Input/output error", "No space left"][..], &of_sqlite].concat();
    let files = [
        "checkpoint",
        "ledger",
        "metrics.jsonl",
        "tensorboard",
        "policy",
        "run.toml",
        "/run",
        "in-use",
    ];
    let names = |line: &str, words: &[&str]| words.iter().any(|word| line.contains(word));
    stderr.lines().any(|line| names(line, &causes) && names(line, &files))
}

/// Runs on a disk with a fault, then resumes on a healthy disk.
pub(crate) fn check(fault: &Fault) {
    let device = Device::new();
    let run = Run::start(&device, Some(fault), false);
    let ended = match fault.mode {
        Mode::Once | Mode::Kill => run.end(),
        Mode::Dead => run.end_or_interrupt(),
        Mode::Cut => run.end_by_power_cut(),
    };
    let hit = device.calls().into_iter().find(|call| call.starts_with('!'));
    let what = format!("{fault}, {hit:?}: {:?}: {}", ended.status, ended.stderr);
    assert!(device.is_triggered(), "the fault did not occur: {what}");
    check_end(&ended, fault, &what);
    check_logs(&device);
    let ended = match ended.status.code() {
        Some(0) => ended,
        _ => Run::start(&device, None, device.root().join("run/run.toml").exists()).end(),
    };
    assert_eq!(ended.status.code(), Some(0), "resumed after {what}: {}", ended.stderr);
    let result = RunResult::read(&device, &ended);
    assert_eq!(result.digest, UNDISTURBED.0.digest, "after {what}");
    assert_eq!(result, UNDISTURBED.0, "after {what}");
}

/// Checks that a run whose state cannot be saved says so when it is interrupted.
pub(crate) fn check_unsaved(fault: &Fault) {
    let device = Device::new();
    let ended = Run::start(&device, Some(fault), false).end_or_interrupt();
    let last = ended.stderr.lines().last().unwrap_or_default();
    assert_eq!(ended.status.code(), Some(75), "{fault}: {}", ended.stderr);
    assert!(last.contains("resume it with") && names_the_fault(last), "{fault}: {}", ended.stderr);
}

/// Checks that a run ended in a way that the fault allows, with one line that gives the reason.
fn check_end(ended: &Ended, fault: &Fault, what: &str) {
    assert!(!ended.stderr.contains("panicked"), "{what}");
    match ended.status.code() {
        Some(0) => {}
        Some(130) => assert_eq!(fault.mode, Mode::Dead, "{what}"),
        None => {
            assert_eq!(ended.status.signal(), Some(9), "{what}");
            assert!(matches!(fault.mode, Mode::Kill | Mode::Cut), "{what}");
        }
        code => {
            assert_eq!(code, Some(75), "{what}");
            let last = ended.stderr.lines().last().unwrap_or_default();
            let is_killed = fault.mode == Mode::Kill && last.contains("killed by signal 9");
            assert!(last.starts_with("tandem: "), "{what}");
            assert!(names_the_fault(last) || is_killed, "{what}");
        }
    }
}
