//! A trial's log: written, read by others, cut short, mended.
#![expect(clippy::unwrap_used, reason = "a test that cannot go on may end")]

use std::collections::BTreeMap;
use std::path::Path;

use foxglove::messages::{JointStates, Log, SceneUpdate};
use mcap::records::Record;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader};
use prost::Message as _;
use tandem_core::{Layout, Task};
use tandem_telemetry::{
    Error, LogLevel, TrialLook, TrialMetadata, TrialOutcome, TrialRecorder, recover,
};

#[path = "support/synthetic.rs"]
#[expect(dead_code, reason = "only the scene is shown")]
mod synthetic;

const N_LOOKS: u32 = 60;

fn metadata() -> TrialMetadata {
    TrialMetadata {
        subject: "student-push".to_owned(),
        layout: Layout::new(Task::Push, 2),
        mode: "closed-loop".to_owned(),
        trial: 4,
        seed: 777,
        policy_digest: "5f3a".to_owned(),
        driver: "simulated".to_owned(),
        speed: 0.5,
        block_half_m: 0.045,
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
    for look in 0..N_LOOKS {
        let progress = look as f32 / N_LOOKS as f32;
        let scene = synthetic::scene(progress);
        let tools: Vec<[f64; 3]> =
            scene.arms.iter().map(|arm| arm.end_effector.map(f64::from)).collect();
        let joints = vec![vec![f64::from(look), 0.5, 0.25, 0.125]; 2];
        let moving = look < 40;
        recorder
            .look(&TrialLook {
                time_s: 0.04 * f64::from(look),
                scene: &scene,
                planned_joints: moving.then_some(joints.as_slice()),
                measured_joints: if look == 0 { &[] } else { &joints },
                planned_tools: if moving { &tools } else { &[] },
                measured_tools: &tools,
                openings: if look == 0 { &[] } else { &[0.5, 1.0] },
            })
            .unwrap();
    }
    recorder.log(LogLevel::Warning, "the envelope stopped arm 1").unwrap();
    recorder
}

/// What somebody else's reader sees: messages by topic, schemas by topic, metadata records by name.
#[derive(Default)]
struct Seen {
    messages: BTreeMap<String, Vec<Vec<u8>>>,
    schemas: BTreeMap<String, String>,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
}

fn read(path: &Path) -> Seen {
    let bytes = std::fs::read(path).unwrap();
    let mut seen = Seen::default();
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let topic = message.channel.topic.clone();
        let schema = message.channel.schema.as_ref().unwrap().name.clone();
        seen.schemas.insert(topic.clone(), schema);
        seen.messages.entry(topic).or_default().push(message.data.into_owned());
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
                    seen.metadata.insert(record.name, record.metadata);
                }
            }
        }
    }
    seen
}

#[test]
fn a_trial_has_its_topics_its_metadata_and_its_name() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("trial.mcap");
    let recorder = recorded(&path);
    assert!(!path.exists() && dir.path().join("trial.mcap.part").exists());
    assert_eq!(recorder.finish(&outcome()).unwrap(), path);
    assert!(!dir.path().join("trial.mcap.part").exists());
    let seen = read(&path);
    let counts: Vec<(&str, &str, usize)> = seen
        .messages
        .iter()
        .map(|(topic, messages)| (topic.as_str(), seen.schemas[topic].as_str(), messages.len()))
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
    let [trial, ended] = ["tandem.trial", "tandem.trial.outcome"].map(|name| &seen.metadata[name]);
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
fn a_look_shows_both_ways_so_far_and_where_the_tools_should_be() {
    let dir = tempfile::tempdir().unwrap();
    let path = recorded(&dir.path().join("trial.mcap")).finish(&outcome()).unwrap();
    let seen = read(&path);
    let scene = |idx: usize| SceneUpdate::decode(&*seen.messages["/scene"][idx]).unwrap();
    let shape = |idx: usize, id: &str| {
        let scene = scene(idx);
        let entity = scene.entities.into_iter().find(|entity| entity.id == id).unwrap();
        (entity.lines[0].points.len(), entity.spheres.len())
    };
    let moving = shape(39, "planned0");
    assert!(moving.0 > 20 && moving.1 == 1, "{moving:?}");
    assert_eq!(shape(59, "planned0"), (moving.0, 0), "the plan stays when the motion is over");
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
fn joints_and_lines_of_text_say_what_was_recorded() {
    let dir = tempfile::tempdir().unwrap();
    let path = recorded(&dir.path().join("trial.mcap")).finish(&outcome()).unwrap();
    let seen = read(&path);
    let names = |topic: &str| {
        let states = JointStates::decode(&*seen.messages[topic][7]).unwrap();
        states.joints.into_iter().map(|joint| joint.name).collect::<Vec<_>>()
    };
    let joints: Vec<String> =
        (0..2).flat_map(|arm| (1..=4).map(move |joint| format!("arm{arm}/joint{joint}"))).collect();
    assert_eq!(names("/planned/joint_states"), joints);
    assert_eq!(names("/joint_states")[..8], joints);
    assert_eq!(names("/joint_states")[8..], ["arm0/gripper", "arm1/gripper"]);
    let lines: Vec<(i32, String)> = seen.messages["/log"]
        .iter()
        .map(|bytes| Log::decode(bytes.as_slice()).unwrap())
        .map(|line| (line.level, line.message))
        .collect();
    let expected = [
        (
            2,
            "student-push, push, closed-loop, trial 4 of seed 777 begins: driver simulated, speed 0.5, blocks of 90 mm",
        ),
        (3, "the envelope stopped arm 1"),
        (4, "failure: stopped: arm 1 is too fast"),
    ];
    assert_eq!(lines, expected.map(|(level, line)| (level, line.to_owned())));
}

#[test]
fn what_a_killed_recorder_left_is_mended() {
    let dir = tempfile::tempdir().unwrap();
    let recorder = recorded(&dir.path().join("trial.mcap"));
    // What is on the disk at this moment is what a kill would leave.
    let on_disk = std::fs::read(dir.path().join("trial.mcap.part")).unwrap();
    drop(recorder);
    let (cut, mended) = (dir.path().join("cut.mcap.part"), dir.path().join("mended.mcap"));
    for n_bytes in [on_disk.len(), on_disk.len() / 2] {
        std::fs::write(&cut, &on_disk[..n_bytes]).unwrap();
        let counts = recover(&cut, &mended).unwrap();
        assert!(counts.ended_by.is_some() && counts.metadata_records == 1, "{counts:?}");
        let seen = read(&mended);
        assert_eq!(seen.metadata["tandem.trial"]["trial"], "4");
        assert!(!seen.messages["/log"].is_empty());
    }
    std::fs::write(&cut, &on_disk).unwrap();
    recover(&cut, &mended).unwrap();
    assert!(read(&mended).messages["/scene"].len() >= 50);
}

#[test]
fn a_trial_that_never_moved_has_a_whole_log_too() {
    let dir = tempfile::tempdir().unwrap();
    let recorder = TrialRecorder::create(&dir.path().join("trial.mcap"), &metadata()).unwrap();
    let seen = read(&recorder.finish(&TrialOutcome::default()).unwrap());
    assert_eq!(seen.messages.keys().collect::<Vec<_>>(), ["/log"]);
    assert_eq!(seen.metadata["tandem.trial.outcome"]["outcome"], "success");
}

#[test]
fn another_number_of_arms_and_times_without_sense_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let mut recorder = TrialRecorder::create(&dir.path().join("trial.mcap"), &metadata()).unwrap();
    let scene = synthetic::scene(0.0);
    let joints = vec![vec![0.0; 4]];
    let look = TrialLook {
        time_s: 0.0,
        scene: &scene,
        planned_joints: None,
        measured_joints: &[],
        planned_tools: &[],
        measured_tools: &[],
        openings: &[],
    };
    let mut refusal = |look: TrialLook<'_>| recorder.look(&look).unwrap_err();
    for (field, spoilt) in [
        ("planned_joints", TrialLook { planned_joints: Some(&joints), ..look }),
        ("measured_joints", TrialLook { measured_joints: &joints, ..look }),
        ("planned_tools", TrialLook { planned_tools: &[[0.0; 3]; 3], ..look }),
        ("measured_tools", TrialLook { measured_tools: &[[0.0; 3]; 1], ..look }),
        ("openings", TrialLook { openings: &[0.0; 3], ..look }),
    ] {
        let error = refusal(spoilt);
        assert!(error.to_string().starts_with(field), "{error}");
    }
    for time_s in [-0.1, f64::NAN, f64::INFINITY] {
        assert!(matches!(refusal(TrialLook { time_s, ..look }), Error::Time { .. }));
    }
}
