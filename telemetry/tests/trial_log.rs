//! Logs of trials: writing, reading with the mcap crate, and recovery.

use std::collections::BTreeMap;
use std::path::Path;

use foxglove::messages::{JointStates, Log, SceneUpdate};
use mcap::records::Record;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader};
use prost::Message as _;
use tandem_core::{Layout, Task};
use tandem_telemetry::{
    Error, LogLevel, TrialMetadata, TrialOutcome, TrialRecorder, TrialSnapshot, recover,
};

use crate::episode_log_tests::synthetic;

const N_SNAPSHOTS: u32 = 60;

fn metadata() -> TrialMetadata {
    TrialMetadata {
        policy: "student-push".to_owned(),
        layout: Layout::new(Task::Push, 2),
        mode: "closed-loop".to_owned(),
        trial: 4,
        seed: 777,
        policy_digest: "5f3a".to_owned(),
        driver: "simulated".to_owned(),
        speed: 0.5,
        block_half_m: Some(0.045),
    }
}

fn outcome() -> TrialOutcome {
    TrialOutcome {
        cause: Some("stopped".to_owned()),
        detail: Some("arm 1 is too fast".to_owned()),
        goal_distances_m: vec![0.012, 0.25],
        duration_s: 2.4,
    }
}

/// Records a trial in which the motion ends after two thirds.
fn recorded(path: &Path) -> TrialRecorder {
    let mut recorder = TrialRecorder::create(path, &metadata()).unwrap();
    for snapshot in 0..N_SNAPSHOTS {
        let progress = snapshot as f32 / N_SNAPSHOTS as f32;
        let scene = synthetic::scene(progress);
        let tools: Vec<[f64; 3]> =
            scene.arms.iter().map(|arm| arm.end_effector.map(f64::from)).collect();
        let joints = vec![vec![f64::from(snapshot), 0.5, 0.25, 0.125]; 2];
        let moving = snapshot < 40;
        recorder
            .record(&TrialSnapshot {
                time_s: 0.04 * f64::from(snapshot),
                scene: &scene,
                planned_joints: moving.then_some(joints.as_slice()),
                measured_joints: if snapshot == 0 { &[] } else { &joints },
                planned_tools: if moving { &tools } else { &[] },
                measured_tools: &tools,
                openings: if snapshot == 0 { &[] } else { &[0.5, 1.0] },
            })
            .unwrap();
    }
    recorder.log(LogLevel::Warning, "the envelope stopped arm 1").unwrap();
    recorder
}

/// Contents of a log: messages by topic, schemas by topic, metadata records by name.
#[derive(Default)]
struct LogContents {
    messages: BTreeMap<String, Vec<Vec<u8>>>,
    schemas: BTreeMap<String, String>,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
}

fn read(path: &Path) -> LogContents {
    let bytes = std::fs::read(path).unwrap();
    let mut contents = LogContents::default();
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let topic = message.channel.topic.clone();
        let schema = message.channel.schema.as_ref().unwrap().name.clone();
        contents.schemas.insert(topic.clone(), schema);
        contents.messages.entry(topic).or_default().push(message.data.into_owned());
    }
    let mut reader = LinearReader::new();
    let mut unread = bytes.as_slice();
    while let Some(event) = reader.next_event() {
        match event.unwrap() {
            LinearReadEvent::ReadRequest(n_wanted) => {
                let (next, rest) = unread.split_at(n_wanted.min(unread.len()));
                reader.insert(next.len()).copy_from_slice(next);
                reader.notify_read(next.len());
                unread = rest;
            }
            LinearReadEvent::Record { data, opcode } => {
                if let Record::Metadata(record) = mcap::parse_record(opcode, data).unwrap() {
                    contents.metadata.insert(record.name, record.metadata);
                }
            }
        }
    }
    contents
}

#[test]
fn a_log_has_its_topics_metadata_and_final_name() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("trial.mcap");
    let recorder = recorded(&path);
    assert!(!path.exists() && dir.path().join("trial.mcap.part").exists());
    assert_eq!(recorder.finish(&outcome()).unwrap(), path);
    assert!(!dir.path().join("trial.mcap.part").exists());
    let contents = read(&path);
    let counts: Vec<(&str, &str, usize)> = contents
        .messages
        .iter()
        .map(|(topic, messages)| (topic.as_str(), contents.schemas[topic].as_str(), messages.len()))
        .collect();
    assert_eq!(
        counts,
        [
            ("/joint_states", "foxglove.JointStates", 59),
            ("/log", "foxglove.Log", 3),
            ("/planned/joint_states", "foxglove.JointStates", 40),
            ("/scene", "foxglove.SceneUpdate", 61),
            ("/tf", "foxglove.FrameTransforms", 60),
        ]
    );
    let [trial, ended] =
        ["tandem.trial", "tandem.trial.outcome"].map(|name| &contents.metadata[name]);
    let entries = ["subject", "task", "arms", "mode", "trial", "seed", "policy_digest", "driver"];
    assert_eq!(
        entries.map(|key| trial[key].as_str()),
        ["student-push", "push", "2", "closed-loop", "4", "777", "5f3a", "simulated"]
    );
    assert_eq!(["speed", "block_half_m"].map(|key| trial[key].as_str()), ["0.5", "0.045"]);
    let entries = ["outcome", "cause", "detail", "goal_distances_m", "duration_s"];
    assert_eq!(
        entries.map(|key| ended[key].as_str()),
        ["failure", "stopped", "arm 1 is too fast", "0.012 0.25", "2.4"]
    );
    assert!(trial.contains_key("checksum") && ended.contains_key("checksum"));
}

#[test]
fn a_snapshot_shows_both_paths_so_far_and_the_planned_tool_positions() {
    let dir = tempfile::tempdir().unwrap();
    let path = recorded(&dir.path().join("trial.mcap")).finish(&outcome()).unwrap();
    let contents = read(&path);
    let scene = |idx: usize| SceneUpdate::decode(&*contents.messages["/scene"][idx]).unwrap();
    let shape = |idx: usize, id: &str| {
        let scene = scene(idx);
        let entity = scene.entities.into_iter().find(|entity| entity.id == id).unwrap();
        (entity.lines[0].points.len(), entity.spheres.len())
    };
    let moving = shape(39, "planned0");
    assert!(moving.0 > 20 && moving.1 == 1, "{moving:?}");
    assert_eq!(shape(59, "planned0"), (moving.0, 0), "the planned path remains after the motion");
    assert!(shape(59, "measured1").0 > shape(39, "measured1").0);
    let [planned, measured] = ["planned1", "measured1"].map(|id| {
        let entity = scene(39).entities.into_iter().find(|entity| entity.id == id).unwrap();
        (entity.lines[0].thickness, entity.lines[0].color.unwrap().a)
    });
    assert!(planned.0 < measured.0 && planned.1 < measured.1);
    let caption = |idx: usize| {
        let scene = scene(idx);
        scene.entities.iter().find(|entity| entity.id == "caption").unwrap().texts[0].text.clone()
    };
    assert_eq!(caption(25), "student-push, push, closed-loop, trial 4\n1.00 s");
    assert!(caption(60).ends_with("\nfailure: stopped: arm 1 is too fast"), "{}", caption(60));
}

#[test]
fn joint_states_and_log_lines_contain_what_was_recorded() {
    let dir = tempfile::tempdir().unwrap();
    let path = recorded(&dir.path().join("trial.mcap")).finish(&outcome()).unwrap();
    let contents = read(&path);
    let names = |topic: &str| {
        let states = JointStates::decode(&*contents.messages[topic][7]).unwrap();
        states.joints.into_iter().map(|joint| joint.name).collect::<Vec<_>>()
    };
    let joints: Vec<String> =
        (0..2).flat_map(|arm| (1..=4).map(move |joint| format!("arm{arm}/joint{joint}"))).collect();
    assert_eq!(names("/planned/joint_states"), joints);
    assert_eq!(names("/joint_states")[..8], joints);
    assert_eq!(names("/joint_states")[8..], ["arm0/gripper", "arm1/gripper"]);
    let lines: Vec<(i32, String)> = contents.messages["/log"]
        .iter()
        .map(|bytes| Log::decode(bytes.as_slice()).unwrap())
        .map(|line| (line.level, line.message))
        .collect();
    let expected = [
        (
            2,
            "student-push, push, closed-loop, trial 4, seed 777: driver simulated, speed 0.5, blocks of 90 mm",
        ),
        (3, "the envelope stopped arm 1"),
        (4, "failure: stopped: arm 1 is too fast"),
    ];
    assert_eq!(lines, expected.map(|(level, line)| (level, line.to_owned())));
}

#[test]
fn the_log_of_a_killed_recorder_is_recovered() {
    let dir = tempfile::tempdir().unwrap();
    let recorder = recorded(&dir.path().join("trial.mcap"));
    // A kill at this moment would leave what is on disk.
    let on_disk = std::fs::read(dir.path().join("trial.mcap.part")).unwrap();
    drop(recorder);
    let (cut, recovered) = (dir.path().join("cut.mcap.part"), dir.path().join("recovered.mcap"));
    for n_bytes in [on_disk.len(), on_disk.len() / 2] {
        std::fs::write(&cut, &on_disk[..n_bytes]).unwrap();
        let counts = recover(&cut, &recovered).unwrap();
        assert!(counts.ended_by.is_some() && counts.metadata_records == 1, "{counts:?}");
        let contents = read(&recovered);
        assert_eq!(contents.metadata["tandem.trial"]["trial"], "4");
        assert!(!contents.messages["/log"].is_empty());
    }
    std::fs::write(&cut, &on_disk).unwrap();
    recover(&cut, &recovered).unwrap();
    assert!(read(&recovered).messages["/scene"].len() >= 50);
}

#[test]
fn a_trial_without_motion_has_a_complete_log() {
    let dir = tempfile::tempdir().unwrap();
    let recorder = TrialRecorder::create(&dir.path().join("trial.mcap"), &metadata()).unwrap();
    let contents = read(&recorder.finish(&TrialOutcome::default()).unwrap());
    assert_eq!(contents.messages.keys().collect::<Vec<_>>(), ["/log"]);
    assert_eq!(contents.metadata["tandem.trial.outcome"]["outcome"], "success");
}

#[test]
fn wrong_numbers_of_arms_and_invalid_times_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let mut recorder = TrialRecorder::create(&dir.path().join("trial.mcap"), &metadata()).unwrap();
    let scene = synthetic::scene(0.0);
    let joints = vec![vec![0.0; 4]];
    let snapshot = TrialSnapshot {
        time_s: 0.0,
        scene: &scene,
        planned_joints: None,
        measured_joints: &[],
        planned_tools: &[],
        measured_tools: &[],
        openings: &[],
    };
    let mut refusal = |snapshot: TrialSnapshot<'_>| recorder.record(&snapshot).unwrap_err();
    for (field, invalid) in [
        ("planned_joints", TrialSnapshot { planned_joints: Some(&joints), ..snapshot }),
        ("measured_joints", TrialSnapshot { measured_joints: &joints, ..snapshot }),
        ("planned_tools", TrialSnapshot { planned_tools: &[[0.0; 3]; 3], ..snapshot }),
        ("measured_tools", TrialSnapshot { measured_tools: &[[0.0; 3]; 1], ..snapshot }),
        ("openings", TrialSnapshot { openings: &[0.0; 3], ..snapshot }),
    ] {
        let error = refusal(invalid);
        assert!(error.to_string().starts_with(field), "{error}");
    }
    for time_s in [-0.1, f64::NAN, f64::INFINITY] {
        assert!(matches!(refusal(TrialSnapshot { time_s, ..snapshot }), Error::Time { .. }));
    }
}
