//! Runs on the disk: started, disturbed, resumed, compared with an undisturbed one.

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
const PATIENCE: usize = 6000;
/// Ticks of 20 ms after which a run that waits for its disk is interrupted.
const WAITS: usize = 50;

/// What an undisturbed run leaves behind, and its calls.
pub(crate) static CALM: LazyLock<(Left, Vec<String>)> = LazyLock::new(|| {
    let device = Device::new();
    let ended = Run::start(&device, None, false).end();
    (Left::behind(&device, &ended), device.calls())
});

/// What a run leaves behind: everything that must not depend on how often it was disturbed.
#[derive(Debug, PartialEq)]
pub(crate) struct Left {
    digest: String,
    metrics: Vec<Value>,
    /// Units spent, and every verdict.
    account: Vec<String>,
    /// Digests of the best and the last policy.
    policies: [String; 2],
}

impl Left {
    fn behind(device: &Device, ended: &Ended) -> Self {
        assert_eq!(ended.status.code(), Some(0), "{}", ended.said);
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

/// Checks that every episode's log that has its name is whole.
fn check_logs(device: &Device) {
    let logs = fs::read_dir(device.root().join("run/mcap")).into_iter().flatten().flatten();
    for path in
        logs.map(|entry| entry.path()).filter(|path| path.extension() == Some("mcap".as_ref()))
    {
        read_episode(&path).expect("whole");
    }
}

/// Units spent and verdicts in a ledger that nobody has open.
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

/// How a run ended.
pub(crate) struct Ended {
    pub(crate) status: ExitStatus,
    /// What it wrote to standard error.
    pub(crate) said: String,
    digest: Option<String>,
}

/// A `tandem train`.
pub(crate) struct Run<'a> {
    device: &'a Device,
    process: Child,
}

impl<'a> Run<'a> {
    pub(crate) fn start(device: &'a Device, fault: Option<&Fault>, resume: bool) -> Self {
        let (output, said) = (device.beside("output"), device.beside("said"));
        let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
        command.args(["train", "--json"]);
        match resume {
            true => command.args(["--resume", "--workers", "2"]),
            false => command.args(SMALL),
        };
        command.arg("--out").arg(device.root().join("run"));
        command.current_dir(env!("CARGO_MANIFEST_DIR")).stdin(Stdio::null());
        command.stdout(File::create(output).expect("creates"));
        command.stderr(File::create(said).expect("creates"));
        device.attach(&mut command, fault);
        Self { device, process: command.spawn().expect("starts") }
    }

    fn said(&self) -> String {
        fs::read_to_string(self.device.beside("said")).expect("readable")
    }

    fn ended(&self, status: ExitStatus) -> Ended {
        let output = fs::read_to_string(self.device.beside("output")).expect("readable");
        let after = output.lines().last().and_then(|line| line.split("\"digest\":\"").nth(1));
        let digest = after.and_then(|after| after.split('"').next()).map(str::to_owned);
        Ended { status, said: self.said(), digest }
    }

    /// Waits for the end, and calls `look` now and then.
    fn end_watched(mut self, mut look: impl FnMut(&Self)) -> Ended {
        for _ in 0..PATIENCE {
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
            self.said()
        );
        self.ended(status)
    }

    /// Waits for the end.
    pub(crate) fn end(self) -> Ended {
        self.end_watched(|_| ())
    }

    /// Waits for the end. A run that waits for its disk to recover is interrupted once it has said so.
    fn end_or_interrupt(self) -> Ended {
        let mut n_waited = 0;
        self.end_watched(|run| {
            n_waited += usize::from(run.device.is_hit() && names_the_fault(&run.said()));
            if n_waited == WAITS {
                signal("-INT", run.process.id());
            }
        })
    }

    /// Waits until the power is cut, and ends every process.
    fn end_by_power_cut(mut self) -> Ended {
        for _ in 0..PATIENCE {
            if self.device.is_hit() || self.process.try_wait().expect("a child").is_some() {
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

/// Whether a line names what cannot be written, and why.
pub(crate) fn names_the_fault(said: &str) -> bool {
    let of_sqlite = ["disk I/O error", "disk is full", "unable to open database file"];
    let causes = [&["Input/output error", "No space left"][..], &of_sqlite].concat();
    let whats = ["checkpoint", "ledger", "metrics.jsonl", "policy", "run.toml", "/run", "in-use"];
    let names = |line: &str, words: &[&str]| words.iter().any(|word| line.contains(word));
    said.lines().any(|line| names(line, &causes) && names(line, &whats))
}

/// Runs on a disk with a fault, then goes on where it is whole.
pub(crate) fn check(fault: &Fault) {
    let device = Device::new();
    let run = Run::start(&device, Some(fault), false);
    let ended = match fault.mode {
        Mode::Once | Mode::Kill => run.end(),
        Mode::Dead => run.end_or_interrupt(),
        Mode::Cut => run.end_by_power_cut(),
    };
    let hit = device.calls().into_iter().find(|call| call.starts_with('!'));
    let what = format!("{fault}, {hit:?}: {:?}: {}", ended.status, ended.said);
    check_end(&ended, fault, &what);
    check_logs(&device);
    let ended = match ended.status.code() {
        Some(0) => ended,
        _ => Run::start(&device, None, device.root().join("run/run.toml").exists()).end(),
    };
    assert_eq!(ended.status.code(), Some(0), "resumed after {what}: {}", ended.said);
    let left = Left::behind(&device, &ended);
    assert_eq!(left.digest, CALM.0.digest, "after {what}");
    assert_eq!(left, CALM.0, "after {what}");
}

/// Checks that a run ended as the fault allows, with one line that says why.
fn check_end(ended: &Ended, fault: &Fault, what: &str) {
    assert!(!ended.said.contains("panicked"), "{what}");
    match ended.status.code() {
        Some(0) => {}
        Some(130) => assert_eq!(fault.mode, Mode::Dead, "{what}"),
        None => {
            assert_eq!(ended.status.signal(), Some(9), "{what}");
            assert!(matches!(fault.mode, Mode::Kill | Mode::Cut), "{what}");
        }
        code => {
            assert_eq!(code, Some(75), "{what}");
            let last = ended.said.lines().last().unwrap_or_default();
            let is_killed = fault.mode == Mode::Kill && last.contains("killed by signal 9");
            assert!(last.starts_with("tandem: "), "{what}");
            assert!(names_the_fault(last) || is_killed, "{what}");
        }
    }
}
