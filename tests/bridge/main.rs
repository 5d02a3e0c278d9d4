//! `tandem bridge` with the built program: a service with simulated arms, and the commands of operators.
//!
//! The arms move in real time. On a busy machine the service may miss a deadline and stop them, as it should. The tests
//! then try again.
#![expect(clippy::panic, reason = "a test panics where it fails")]

mod logs;
mod program;

use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::Stdio;

use serde_json::{Value, json};

use crate::logs::logs;
use crate::program::{Bridge, end, fails_with, signal, stderr, tandem, was_busy};

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
    let tools_m = || -> Vec<f64> {
        let status = bridge.status();
        let arms = status["arms"].as_array().expect("arms");
        let tools = arms.iter().filter_map(|arm| arm["tool_in_world_m"].as_array());
        tools.flatten().filter_map(Value::as_f64).collect()
    };
    let before_m = tools_m();
    assert_eq!(before_m.len(), 6, "{before_m:?}");
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
    let after_m = tools_m();
    let has_moved = before_m.iter().zip(&after_m).any(|(a, b)| (a - b).abs() > 1e-3);
    assert!(after_m.len() == 6 && !has_moved, "{before_m:?} {after_m:?}");
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
    // The port is taken before the arms are, whose motion a second bridge would stop.
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("binds");
    let taken = taken.local_addr().expect("is bound").to_string();
    let second = [&guessed[..], &["--accept-defaults", "--listen", &taken]].concat();
    refused(&second, 75, "cannot listen on");
    refused(&[&["calibrate"], &guessed[..]].concat(), 64, "confirm with --yes");
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
