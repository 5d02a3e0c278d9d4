//! `tandem bench scale` with the built program: few workers, few rounds.

use std::collections::BTreeMap;
use std::process::{Command, Stdio};

use serde_json::Value;

/// Runs the benchmark and returns value and unit of its figures by name.
fn scale(args: &[&str]) -> BTreeMap<String, (f64, String)> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.args(["bench", "scale", "--json"]).args(args).stdin(Stdio::null());
    let output = command.output().expect("runs");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{:?}: {errors}", output.status);
    let figure = |line: &str| {
        let figure: Value = serde_json::from_str(line).expect("JSON");
        let text = |key: &str| figure[key].as_str().expect("a text").to_owned();
        (text("name"), (figure["value"].as_f64().expect("a number"), text("unit")))
    };
    String::from_utf8_lossy(&output.stdout).lines().map(figure).collect()
}

#[test]
fn real_and_idle_workers_are_measured() {
    let figures = scale(&[
        "--workers",
        "1,2",
        "--idle",
        "8",
        "--rounds",
        "2",
        "--slot-s",
        "0.2",
        "--join-leave",
        "4",
    ]);
    let value = |name: &str| figures.get(name).unwrap_or_else(|| panic!("no {name}")).0;
    for setting in ["workers-1", "workers-2", "idle-8", "join-leave-4"] {
        for figure in ["rounds", "env-steps", "received", "sent", "learner-memory", "median-round"]
        {
            let name = format!("scale/{setting}/{figure}");
            assert!(value(&name) > 0.0, "{name}: {}", value(&name));
        }
    }
    // 8 workers that each simulate 2 episodes of 50 steps cannot deliver a round faster than their delay.
    assert!(value("scale/idle-8/median-round") >= 0.2);
    assert!(value("scale/idle-8/env-steps") <= 8.0 * 100.0 / 0.2 * 1.01);
    // Each of them fetches 0.86 MB and delivers 2 episodes of some 13 kB; there is little other traffic.
    // Transfers in progress at the start and end of the measured rounds may or may not be counted.
    let per_slot = value("scale/idle-8/rounds") * 8.0;
    let (sent_mb, received_mb) = (0.86 * per_slot, 0.0256 * per_slot);
    assert!((0.4..1.7).contains(&(value("scale/idle-8/sent") / sent_mb)), "{figures:?}");
    assert!((0.4..1.7).contains(&(value("scale/idle-8/received") / received_mb)), "{figures:?}");
    assert_eq!(value("scale/idle-8/failed-calls"), 0.0);
    let longest = value("scale/join-leave-4/longest-round");
    assert!(longest >= value("scale/join-leave-4/median-round"));
}

#[test]
fn more_workers_leaving_than_there_are_is_refused() {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.args(["bench", "scale", "--workers", "0", "--idle", "4", "--join-leave", "5"]);
    let output = command.output().expect("runs");
    assert_eq!(output.status.code(), Some(64));
    assert!(String::from_utf8_lossy(&output.stderr).contains("--join-leave 5"));
}
