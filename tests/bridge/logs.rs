//! Recordings of a bridge's motions.

use std::collections::BTreeMap;
use std::io::{BufReader, Read as _};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use prost_reflect::{DescriptorPool, DynamicMessage};
use serde_json::{Value, json};

use crate::program::{
    Bridge, MAX_PAUSES, PAUSE, SERVE, end, fails_with, signal, stderr, tandem, was_busy,
};

/// Returns the logs in a directory.
pub(crate) fn logs(directory: &Path) -> Vec<PathBuf> {
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
    let finished = ["motion-1-1.mcap", "motion-1-2.mcap"].map(|name| directory.path().join(name));
    finished.iter().for_each(|log| std::fs::write(log, vec![0; 700_000]).expect("writes"));
    let mut second = tandem(&SERVE);
    second.args(["--log-budget", "1MB", "--record"]).arg(directory.path());
    fails_with(75, &second.output().expect("runs"), "choose another --record");
    finished.iter().for_each(|log| std::fs::remove_file(log).expect("the log is still there"));
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
