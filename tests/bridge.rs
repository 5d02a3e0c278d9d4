//! `tandem bridge` with the built program: a service with simulated arms, and the commands of operators.
//!
//! The arms move in real time. On a busy machine the service may miss a deadline and stop them, as it should. The tests
//! then try again.
#![expect(clippy::panic, reason = "a test panics where it fails")]

use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader, Read as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use prost_reflect::{DescriptorPool, DynamicMessage};
use serde_json::{Value, json};
use tempfile::TempDir;

/// The causes of stops that a busy machine may produce.
const BUSY: [&str; 6] =
    ["late", "owner-silent", "state-old", "state-stale", "command-lost", "drive-fault"];
/// The limit of every wait, in pauses, sufficient for busy machines.
const MAX_PAUSES: usize = 1200;
const SERVE: [&str; 6] = ["bridge", "--driver", "sim", "--listen", "127.0.0.1:0", "--no-dashboard"];
const PAUSE: Duration = Duration::from_millis(50);

/// A bridge process that is killed on drop.
struct Bridge {
    process: Child,
    address: String,
    directory: TempDir,
}

fn tandem(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.args(args).current_dir(env!("CARGO_MANIFEST_DIR"));
    command.env_remove("TANDEM_TOKEN_FILE").env_remove("RUST_LOG");
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

impl Bridge {
    fn serve(more: &[&str]) -> Self {
        Self::spawn(tandem(&[&SERVE[..], more].concat()).stderr(Stdio::inherit()))
    }

    fn spawn(command: &mut Command) -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        let mut process = command.spawn().expect("starts");
        let mut line = String::new();
        let mut output = BufReader::new(process.stdout.take().expect("piped"));
        output.read_line(&mut line).expect("a line");
        let address = line.trim().strip_prefix("listening on ").expect("an address").to_owned();
        Self { process, address, directory }
    }

    fn command(&self, what: &[&str]) -> Command {
        let args = [&["bridge"], what, &["--connect", &self.address]].concat();
        tandem(&args)
    }

    fn run(&self, what: &[&str]) -> Output {
        self.command(what).output().expect("runs")
    }

    fn json(&self, what: &[&str]) -> Value {
        let output = self.run(&[what, &["--json"]].concat());
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        serde_json::from_slice(&output.stdout).expect("one JSON object")
    }

    fn status(&self) -> Value {
        self.json(&["status"])
    }

    /// Waits until the status is as wanted. Returns `None` if a busy machine has stopped the arms.
    fn eventually(&self, wanted: impl Fn(&Value) -> bool) -> Option<Value> {
        for _ in 0..MAX_PAUSES {
            let status = self.status();
            if wanted(&status) {
                return Some(status);
            }
            if was_busy(&status) {
                return None;
            }
            std::thread::sleep(PAUSE);
        }
        panic!("{}", self.status())
    }

    /// Resets the arms.
    fn reset(&self) {
        for _ in 0..MAX_PAUSES {
            let output = self.run(&["reset"]);
            if output.status.success() || stderr(&output).contains("not stopped but Idle") {
                return;
            }
            assert_eq!(output.status.code(), Some(75), "{}", stderr(&output));
            std::thread::sleep(PAUSE);
        }
        panic!("{}", self.status())
    }

    /// Runs `work` with arms that are not stopped, and repeats it if a busy machine stops them.
    fn with_arms<T>(&self, work: impl Fn() -> Option<T>) -> T {
        for _ in 0..20 {
            self.reset();
            if let Some(done) = work() {
                return done;
            }
        }
        panic!("{}", self.status())
    }

    /// Starts a slow motion. Returns `None` if a busy machine has stopped it.
    fn moving(&self) -> Option<Child> {
        let slowly = ["move", "deploy/first-motion.json", "--speed", "0.05"];
        let mover = self.command(&slowly).spawn().expect("starts");
        let is_under_way = |status: &Value| status["motion"]["played_s"].as_f64() > Some(0.0);
        match self.eventually(is_under_way) {
            Some(_) => Some(mover),
            None => {
                end(mover);
                None
            }
        }
    }
}

impl Drop for Bridge {
    fn drop(&mut self) {
        drop(self.process.kill());
        drop(self.process.wait());
    }
}

fn was_busy(status: &Value) -> bool {
    status["stopped"]["name"].as_str().is_some_and(|name| BUSY.contains(&name))
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn end(mut child: Child) {
    drop(child.kill());
    drop(child.wait());
}

fn signal(child: &Child, signal: &str) {
    let sent = Command::new("kill").args([signal, &child.id().to_string()]).status();
    assert!(sent.expect("kill runs").success());
}

fn fails_with(code: i32, output: &Output, expected: &str) {
    let message = stderr(output);
    assert_eq!(output.status.code(), Some(code), "{message}");
    let line = message.lines().last().unwrap_or_default();
    assert!(line.starts_with("tandem: ") && line.contains(expected), "{message}");
}

#[test]
fn operators_describe_reset_move_and_stop() {
    let bridge = Bridge::serve(&["--speed", "0.8"]);
    let described = bridge.json(&["describe"]);
    assert_eq!(
        (&described["driver"], &described["arms"][1]["model"]),
        (&json!("sim"), &json!("m1n4s200"))
    );
    assert_eq!(described["limits"]["speed"], json!(0.8));
    assert_eq!(bridge.status()["stopped"]["name"], json!("not-reset"));
    let early = bridge.run(&["move", "deploy/first-motion.json"]);
    if !stderr(&early).contains("the position of the arms is not known") {
        fails_with(75, &early, "tandem bridge reset");
    }

    bridge.reset();
    let check = bridge.json(&["move", "deploy/first-motion.json", "--check-only"]);
    assert!(check["accepted"]["duration_s"].as_f64() > Some(0.5), "{check}");
    bridge.with_arms(|| {
        let moved = bridge.run(&["move", "deploy/first-motion.json", "--json"]);
        if moved.status.code() == Some(75) && was_busy(&bridge.status()) {
            return None;
        }
        assert_eq!(moved.status.code(), Some(0), "{}", stderr(&moved));
        let done: Value = serde_json::from_slice(&moved.stdout).expect("one JSON object");
        assert_eq!((&done["done"], &done["progress"]["speed"]), (&json!(true), &json!(0.8)));
        let at_m = &done["progress"]["arms"][0]["tool_in_world_m"];
        for (axis, goal_m) in [-0.12, 0.0, 0.095].into_iter().enumerate() {
            let got_m = at_m[axis].as_f64().expect("a number");
            assert!((got_m - goal_m).abs() < 0.003, "{at_m}");
        }
        Some(())
    });

    let stopped = bridge.run(&["stop"]);
    assert_eq!((stopped.status.code(), stopped.stdout.starts_with(b"stopped\n")), (Some(0), true));
    let status = bridge.status();
    assert!(status["stopped"]["name"] == json!("requested") || was_busy(&status), "{status}");
    fails_with(75, &bridge.run(&["move", "deploy/first-motion.json"]), "tandem bridge reset");
    let lines = bridge.run(&["status"]);
    assert!(lines.stdout.starts_with(b"phase   stopped: at "));

    let mut health = tandem(&["health", &bridge.address, "--service", "tandem.v1.Bridge"]);
    let health = health.output().expect("runs");
    assert_eq!(health.stdout, b"serving\n");
    let mut bridge = bridge;
    signal(&bridge.process, "-TERM");
    assert_eq!(bridge.process.wait().expect("ends").code(), Some(0));
    let unconfirmed = "the stop is not confirmed, use the emergency stop: ";
    fails_with(75, &bridge.run(&["stop"]), unconfirmed);
}

#[test]
fn an_impossible_motion_is_refused_and_moves_nothing() {
    let bridge = Bridge::serve(&[]);
    bridge.reset();
    let file = bridge.directory.path().join("motion.json");
    let path = file.to_string_lossy();
    let try_out = |text: &str, expected: &str| {
        std::fs::write(&file, text).expect("writes");
        fails_with(65, &bridge.run(&["move", &path, "--check-only"]), expected);
        fails_with(65, &bridge.run(&["move", &path]), expected);
    };
    let at = |left_m: [f64; 3], opening: f64| {
        let arms = json!([
            {"tool_m": left_m, "opening": opening},
            {"tool_m": [0.12, 0.0, 0.095], "opening": 0.5},
        ]);
        json!({"speed": 1.0, "way_points": [arms]}).to_string()
    };
    try_out("{", "does not hold a motion");
    let elsewhere =
        json!({"angles_rad": [0, 2, 5, 3], "velocities_radps": [0, 0, 0, 0], "opening": 0.5});
    let arm = json!([elsewhere, elsewhere]);
    let joint_motion = json!({"period_s": 0.1, "arms": [arm, arm]});
    try_out(
        &json!({"speed": 1.0, "joint_motion": joint_motion}).to_string(),
        "tandem bridge to-start",
    );
    try_out(r#"{"speed": 1.0}"#, "either way_points or joint_motion");
    try_out(&at([-0.12, 0.0, 0.02], 0.5), "mm above the table, at least 4.0");
    try_out(&at([-0.12, 0.0, 0.1], 1.5), "arms[0].opening: expected a number in [0, 1], got 1.5");
    try_out(&at([-0.12, 0.9, 0.1], 0.5), "waypoint 0 of arm 0");
    let one_arm = json!({"speed": 1.0, "way_points": [[{"tool_m": [0, 0, 0], "opening": 1}]]});
    try_out(&one_arm.to_string(), "way_points[0].arms: expected 2 arms, got 1 arms");
    let missing = Path::new("no-such-motion.json").to_string_lossy();
    fails_with(65, &bridge.run(&["move", &missing]), "cannot read \"no-such-motion.json\"");
    let mut nowhere = tandem(&["bridge", "move", &path, "--connect", "nowhere"]);
    fails_with(64, &nowhere.output().expect("runs"), "is not an address");
}

#[test]
fn the_arms_stop_when_the_client_of_a_motion_ends() {
    let bridge = Bridge::serve(&[]);
    let interrupted = bridge.with_arms(|| {
        let mover = bridge.moving()?;
        signal(&mover, "-INT");
        let ended = mover.wait_with_output().expect("ends");
        (ended.status.code() == Some(130) || !was_busy(&bridge.status())).then_some(ended)
    });
    assert_eq!(interrupted.status.code(), Some(130), "{}", stderr(&interrupted));
    assert!(stderr(&interrupted).contains("interrupted: the arms are stopped"));
    assert!(bridge.status()["stopped"].is_object());

    let status = bridge.with_arms(|| {
        end(bridge.moving()?);
        bridge.eventually(|status| status["stopped"].is_object() && !was_busy(status))
    });
    assert_eq!(status["stopped"]["name"], json!("owner-left"));
}

#[test]
fn a_bridge_with_a_token_refuses_calls_without_it() {
    let directory = tempfile::tempdir().expect("a directory");
    let token = directory.path().join("token");
    std::fs::write(&token, "the-right-token-0123").expect("writes");
    let token = token.to_string_lossy();
    let bridge = Bridge::serve(&["--token-file", &token]);
    for what in ["status", "stop", "describe", "reset"] {
        fails_with(64, &bridge.run(&[what]), "requires a token: name its file in --token-file");
        let known = bridge.run(&[what, "--token-file", &token]);
        assert_ne!(known.status.code(), Some(64), "{}", stderr(&known));
    }
}

#[test]
fn a_cell_file_describes_the_arms_and_operators_practise_a_stop() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("cell.toml");
    let (cell, logs_at) = (path.to_string_lossy(), directory.path().join("logs"));
    let printed = tandem(&["bridge", "cell"]).output().expect("runs");
    let text = String::from_utf8(printed.stdout).expect("text");
    let changed = text
        .replace("[0.39, 0.0, 0.0]", "[0.41, 0.0, 0.0]")
        .replace("name = \"right\"", "name = \"east\"")
        .replace(
            "yaw_degrees = 180.0",
            "yaw_degrees = 180.0\nlag_s = 0.03\nreaction_s = 0.05\nbrake_s = 0.06",
        );
    std::fs::write(&path, &changed).expect("writes");
    let bridge = Bridge::serve(&["--cell", &cell, "--record", &logs_at.to_string_lossy()]);
    let described = bridge.json(&["describe"]);
    let east = &described["arms"][1];
    assert_eq!((&east["name"], &east["is_measured"]), (&json!("east"), &json!(true)));
    assert_eq!(east["base_in_world_m"], json!([0.41, 0.0, 0.0]));
    assert_eq!(
        (&described["arms"][0]["is_measured"], &east["brake_s"]),
        (&json!(false), &json!(0.06))
    );
    assert_eq!(described["limits"]["reaction_s"], json!(0.05));
    assert_eq!(described["cell_file"], json!(cell));

    let stopped = bridge.with_arms(|| {
        let injected = bridge.json(&["inject", "emergency-stop", "--arm", "east"]);
        assert_eq!(injected["injected"][0]["arm"], json!(1));
        bridge.eventually(|status| status["stopped"]["name"] == json!("emergency-stop"))
    });
    assert_eq!(
        (&stopped["stopped"]["arm"], &stopped["injected"][0]["fault"]),
        (&json!(1), &json!("emergency-stop"))
    );
    assert_eq!(stopped["arms"][1]["emergency_stop"], json!(true));
    fails_with(75, &bridge.run(&["reset"]), "arm 1: the emergency stop is pressed");
    let lines = bridge.run(&["status"]);
    assert!(String::from_utf8_lossy(&lines.stdout).contains("drill   emergency-stop, arm 1"));
    assert_eq!(bridge.json(&["inject", "--clear"])["injected"], json!([]));
    bridge.reset();
    fails_with(
        64,
        &bridge.run(&["inject", "torque", "--arm", "west"]),
        "the arms are left and east",
    );
    for (args, expected) in [
        (["torque", "--joint", "9"], "--joint 9: the arm has joints 1 to 4"),
        (["torque", "--arm", "2"], "the arms are left and east"),
        (["contact", "--joint", "2"], "--joint belongs to"),
        (["late-states", "--arm", "east"], "--arm does not belong to late-states"),
    ] {
        fails_with(64, &bridge.run(&[&["inject"], &args[..]].concat()), expected);
    }
    let log = logs(&logs_at).pop().expect("a log of the stop");
    drop(bridge);
    let bytes = std::fs::read(log).expect("a log");
    let has = |text: &str| bytes.windows(text.len()).any(|part| part == text.as_bytes());
    assert!(has("arm1.name") && has("0.41 0 0") && has("arm1.is_measured"));
}

#[test]
fn real_arms_need_measured_times_and_a_cell_is_refused_with_its_key() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("cell.toml");
    let cell = path.to_string_lossy();
    let printed = tandem(&["bridge", "cell"]).output().expect("runs");
    let text = String::from_utf8(printed.stdout).expect("text");
    std::fs::write(&path, &text).expect("writes");
    let refused = |args: &[&str], code, expected: &str| {
        fails_with(code, &tandem(&[&["bridge"], args].concat()).output().expect("runs"), expected);
    };
    let real = ["--driver", "quarc", "--arms-at", "tcpip://127.0.0.1:1"];
    refused(&real, 64, "real arms need a cell file");
    let guessed = [&real[..], &["--cell", &cell]].concat();
    refused(&guessed, 64, "no lag_s, reaction_s and brake_s of left and right: measure");
    refused(&[&guessed[..], &["--accept-defaults"]].concat(), 75, "not connected");
    refused(
        &["to-start", "--yes", real[0], real[1], real[2], real[3]],
        64,
        "real arms need a cell",
    );
    // An address that cannot be right is no reason to try again.
    let at = |driver, address| ["--driver", driver, "--arms-at", address, "--accept-defaults"];
    refused(&at("sim", "tcpip://127.0.0.1:1"), 64, "--arms-at belongs to real arms");
    refused(&at("quarc", "127.0.0.1"), 64, "quarc expects tcpip://HOST:PORT");
    refused(&at("quarc", "ws://127.0.0.1:1"), 64, "quarc expects tcpip://HOST:PORT");
    refused(&at("quarc", "tcpip://127.0.0.1:1?nagle='off'"), 64, "quarc expects tcpip://HOST:PORT");
    refused(&at("kinova-ros", "ws://"), 64, "kinova-ros expects ws://HOST:PORT");
    std::fs::write(&path, text.replace("yaw_degrees = 0.0", "yaw = 0.0")).expect("writes");
    refused(&["cell", &cell], 65, "unknown field `yaw`");
    let nowhere = ["--listen", "127.0.0.1:0", "--no-dashboard", "--record", "/proc"];
    refused(&nowhere, 64, "cannot write to \"/proc\"");
    let close = text.replace("[0.39, 0.0, 0.0]", "[0.1, 0.0, 0.0]");
    std::fs::write(&path, close).expect("writes");
    refused(&["--cell", &cell, "--listen", "127.0.0.1:0"], 65, "simulated arms would start");
}

/// Returns the next line of `lines` that contains `wanted`.
fn line_with(lines: &mut impl Iterator<Item = std::io::Result<String>>, wanted: &str) -> String {
    let line = lines.map(|line| line.expect("text")).find(|line| line.contains(wanted));
    line.unwrap_or_else(|| panic!("no line contains {wanted:?}"))
}

#[test]
fn arms_in_a_process_of_their_own_brake_when_the_bridge_is_killed() {
    let mut arms = tandem(&["bridge", "arms", "--listen", "127.0.0.1:0"]).spawn().expect("starts");
    let mut told = BufReader::new(arms.stdout.take().expect("piped")).lines();
    let address = line_with(&mut told, "listening on ");
    let address = address.strip_prefix("listening on ").expect("an address");
    let at = format!("tcpip://{address}");
    let serve = ["bridge", "--driver", "quarc", "--arms-at", &at, "--accept-defaults"];
    let serve = [&serve[..], &["--listen", "127.0.0.1:0", "--no-dashboard"]].concat();
    let bridge = Bridge::spawn(tandem(&serve).stderr(Stdio::inherit()));
    line_with(&mut told, "connected: ");
    fails_with(75, &bridge.run(&["inject", "contact"]), "simulated arms only");
    let mover = bridge.with_arms(|| bridge.moving());
    // Dropping a bridge kills it.
    drop(bridge);
    line_with(&mut told, "the drives brake by themselves");
    line_with(&mut told, "the arms are at rest");
    end(mover);
    // A new bridge finds the arms where they are, stopped.
    let bridge = Bridge::spawn(tandem(&serve).stderr(Stdio::inherit()));
    assert_eq!(bridge.status()["stopped"]["name"], json!("not-reset"));
    bridge.reset();
    end(arms);
}

/// Returns the logs in a directory.
fn logs(directory: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(directory).expect("a directory");
    let mut logs: Vec<PathBuf> = entries.map(|entry| entry.expect("an entry").path()).collect();
    logs.sort();
    logs
}

/// Returns the measured angles of a log by time of the bridge in nanoseconds, arm by arm, radians.
fn measured_angles(log: &Path) -> BTreeMap<u64, Vec<Vec<f64>>> {
    let bytes = std::fs::read(log).expect("a log");
    let (mut times, mut angles) = (BTreeMap::new(), BTreeMap::new());
    for message in mcap::MessageStream::new(&bytes).expect("a log") {
        let message = message.expect("a message");
        let topic = message.channel.topic.as_str();
        if !["/arms", "/joint_states"].contains(&topic) {
            continue;
        }
        let schema = message.channel.schema.as_ref().expect("a schema");
        let pool = DescriptorPool::decode(schema.data.as_ref()).expect("descriptors");
        let descriptor = pool.get_message_by_name(&schema.name).expect("a message");
        let decoded = DynamicMessage::decode(descriptor, message.data.as_ref()).expect("decodes");
        if topic == "/arms" {
            let time_s = decoded.get_field_by_name("bridge_time_s").and_then(|it| it.as_f64());
            times.insert(message.log_time, nanoseconds(time_s.expect("a time")));
        } else {
            angles.insert(message.log_time, positions(&decoded));
        }
    }
    angles.into_iter().filter_map(|(at, angles)| Some((*times.get(&at)?, angles))).collect()
}

fn positions(states: &DynamicMessage) -> Vec<Vec<f64>> {
    let joints = states.get_field_by_name("joints").expect("joints").into_owned();
    let mut arms = vec![Vec::new(); 2];
    for joint in joints.as_list().expect("a list") {
        let joint = joint.as_message().expect("a joint");
        let name = joint.get_field_by_name("name").expect("a name").into_owned();
        let position = joint.get_field_by_name("position").and_then(|it| it.as_f64());
        let name = name.as_str().expect("text");
        if name.contains("/joint") {
            let arm = usize::from(name.starts_with("arm1"));
            arms[arm].push(position.expect("an angle"));
        }
    }
    arms
}

/// Converts seconds to a key that can be compared.
fn nanoseconds(seconds: f64) -> u64 {
    u64::try_from(Duration::from_secs_f64(seconds).as_nanos()).expect("a short time")
}

#[test]
fn a_stopped_motion_leaves_a_log_with_the_reported_angles_and_the_cause() {
    let directory = tempfile::tempdir().expect("a directory");
    let bridge = Bridge::serve(&["--record", &directory.path().to_string_lossy()]);
    let (reported, stopped) = bridge.with_arms(|| {
        let mover = bridge.moving()?;
        let reported: Vec<Value> = (0..3).map(|_| bridge.status()).collect();
        let stopped = bridge.json(&["stop"]);
        end(mover);
        let is_stopped = stopped["stopped"]["name"] == json!("requested");
        is_stopped.then_some((reported, stopped))
    });
    let last_log =
        || logs(directory.path()).pop().filter(|log| log.extension() == Some("mcap".as_ref()));
    let n_logs = logs(directory.path()).len();
    let mut log = None;
    for _ in 0..MAX_PAUSES {
        log = last_log().filter(|_| logs(directory.path()).len() == n_logs);
        if log.is_some() {
            break;
        }
        std::thread::sleep(PAUSE);
    }
    let log = log.expect("a complete log");
    let recorded = measured_angles(&log);
    for status in &reported {
        let at = nanoseconds(status["now_s"].as_f64().expect("a time"));
        let angles: Vec<Vec<f64>> = status["arms"]
            .as_array()
            .expect("arms")
            .iter()
            .map(|arm| serde_json::from_value(arm["angles_rad"].clone()).expect("angles"))
            .collect();
        assert_eq!(recorded.get(&at), Some(&angles), "at {at} ns");
    }
    let bytes = std::fs::read(&log).expect("a log");
    let sentence = stopped["stopped"]["sentence"].as_str().expect("a sentence");
    let has = |text: &str| bytes.windows(text.len()).any(|part| part == text.as_bytes());
    assert!(has(sentence) && has("first-motion.json"), "{sentence}");
    let replayed = tandem(&["replay", &log.to_string_lossy()]).output().expect("runs");
    fails_with(65, &replayed, "the log of a bridge's motion, not of an episode");
}

#[test]
fn a_full_disk_ends_no_motion_and_is_reported_once() {
    let directory = tempfile::tempdir().expect("a directory");
    let mut command = Command::new("bash");
    command.args(["-c", "ulimit -f 8; exec \"$0\" \"$@\"", env!("CARGO_BIN_EXE_tandem")]);
    command.args(SERVE).arg("--record").arg(directory.path());
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut bridge = Bridge::spawn(&mut command);
    for _ in 0..2 {
        bridge.with_arms(|| {
            let moved = bridge.run(&["move", "deploy/first-motion.json", "--speed", "1"]);
            if moved.status.code() == Some(75) && was_busy(&bridge.status()) {
                return None;
            }
            assert_eq!(moved.status.code(), Some(0), "{}", stderr(&moved));
            Some(())
        });
    }
    signal(&bridge.process, "-TERM");
    assert_eq!(bridge.process.wait().expect("ends").code(), Some(0));
    let mut messages = String::new();
    let stderr = bridge.process.stderr.take().expect("piped");
    BufReader::new(stderr).read_to_string(&mut messages).expect("text");
    assert_eq!(messages.matches("recording paused").count(), 1, "{messages}");
}
