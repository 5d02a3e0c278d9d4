//! Logs of the motions of a bridge.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use tandem_telemetry::{
    ArmView, ArmsPhase, ArmsView, Error, MotionJournal, MotionView, StopView, read_episode, recover,
};

use crate::episode_log_tests::{layout, synthetic};

const PERIOD_S: f64 = 0.01;

/// Returns the arms at rest, without a motion, at a time.
fn idle(step: u32) -> ArmsView {
    let scene = synthetic::scene(0.5);
    let arm = |number: f64| ArmView {
        angles_rad: vec![number + f64::from(step), 0.5, 0.25, 0.125],
        velocities_radps: vec![0.0; 4],
        tool_m: [0.1, 0.2, 0.3],
        table_gap_m: 0.05,
        self_gap_m: 0.04,
        ..ArmView::default()
    };
    ArmsView {
        time_s: 100.0 + PERIOD_S * f64::from(step),
        unix_ms: 1_795_449_600_000,
        phase: ArmsPhase::Idle,
        is_connected: true,
        at_rest: true,
        arms: vec![arm(1000.0), arm(2000.0)],
        arms_gap_m: Some(0.127),
        scene: Some(scene),
        ..ArmsView::default()
    }
}

/// Returns the arms during the first motion.
pub(crate) fn moving(step: u32) -> ArmsView {
    let mut view = idle(step);
    for arm in &mut view.arms {
        arm.planned_rad = arm.angles_rad.iter().map(|angle| angle + 0.01).collect();
        arm.planned_tool_m = Some([0.1, 0.2, 0.31]);
    }
    let motion = MotionView {
        name: "lift".to_owned(),
        client: "127.0.0.1".to_owned(),
        speed: 0.5,
        played_s: 0.5 * PERIOD_S * f64::from(step),
        duration_s: 2.0,
    };
    let (phase, motion) = (ArmsPhase::Moving, Some(motion));
    ArmsView { phase, motion, n_motions: 1, at_rest: false, ..view }
}

fn stopped(step: u32, cause: &str) -> ArmsView {
    let sentence = format!("at 100.000 s: {cause}");
    let stop = StopView { name: cause.to_owned(), sentence, time_s: 100.0 };
    ArmsView { phase: ArmsPhase::Stopped, stop: Some(stop), n_motions: 1, ..idle(step) }
}

fn journal(directory: &Path) -> MotionJournal {
    let bridge = BTreeMap::from([("driver".to_owned(), "sim".to_owned())]);
    MotionJournal::create(directory, 1 << 30, bridge).unwrap()
}

fn record(journal: &mut MotionJournal, views: impl IntoIterator<Item = ArmsView>) {
    views.into_iter().for_each(|view| journal.record(&Arc::new(view)));
}

fn logs(directory: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(directory).unwrap();
    let mut logs: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    logs.sort();
    logs
}

fn names(directory: &Path) -> Vec<String> {
    let logs = logs(directory);
    logs.iter().map(|log| log.file_name().unwrap().to_str().unwrap().to_owned()).collect()
}

fn metadata(log: &Path, name: &str) -> BTreeMap<String, String> {
    let bytes = std::fs::read(log).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let index = summary.metadata_indexes.iter().find(|index| index.name == name).unwrap();
    mcap::read::metadata(&bytes, index).unwrap().metadata
}

#[test]
fn a_motion_leaves_a_log_from_a_second_before_it_until_the_arms_rest_after_the_stop() {
    let directory = tempfile::tempdir().unwrap();
    let mut journal = journal(directory.path());
    record(&mut journal, (0..300).map(idle));
    record(&mut journal, (300..400).map(moving));
    record(&mut journal, (400..600).map(|step| stopped(step, "requested")));
    assert_eq!(names(directory.path()), ["motion-20261123160000-000001.mcap"]);
    let log = logs(directory.path()).remove(0);
    layout::check_paths("bridge.json", &log);
    let outcome = metadata(&log, "tandem.motion.outcome");
    assert_eq!((outcome["outcome"].as_str(), outcome["cause"].as_str()), ("stopped", "requested"));
    assert_eq!(outcome["detail"], "at 100.000 s: requested");
    let inputs = metadata(&log, "tandem.motion");
    let expected = [("driver", "sim"), ("name", "lift"), ("client", "127.0.0.1"), ("speed", "0.5")];
    expected.iter().for_each(|(key, value)| assert_eq!(inputs[*key], *value));
    let messages = layout::messages(&log);
    // One second before, one second of motion and half a second after it.
    let n_measured = messages["/joint_states"].len();
    assert!((248..=253).contains(&n_measured), "{n_measured}");
    assert_eq!(messages["/planned/joint_states"].len(), 100);
    assert!((45..=60).contains(&messages["/scene"].len()), "{}", messages["/scene"].len());
    assert!(matches!(read_episode(&log), Err(Error::MotionLog { .. })));
}

#[test]
fn a_fault_without_a_motion_leaves_a_log_and_an_expected_stop_does_not() {
    let directory = tempfile::tempdir().unwrap();
    let mut journal = journal(directory.path());
    record(&mut journal, (0..10).map(|step| stopped(step, "not-reset")));
    record(&mut journal, (10..300).map(idle));
    record(&mut journal, (300..310).map(|step| stopped(step, "requested")));
    record(&mut journal, (310..400).map(idle));
    record(&mut journal, (400..500).map(|step| stopped(step, "drive-fault")));
    assert_eq!(names(directory.path()), ["stop-20261123160000-000001.mcap"]);
    let log = logs(directory.path()).remove(0);
    assert_eq!(metadata(&log, "tandem.motion.outcome")["cause"], "drive-fault");
}

#[test]
fn a_fault_just_after_a_motion_leaves_a_log_of_its_own() {
    let directory = tempfile::tempdir().unwrap();
    let mut journal = journal(directory.path());
    record(&mut journal, (0..100).map(moving));
    let after = |view| ArmsView { n_motions: 1, ..view };
    record(&mut journal, (100..110).map(idle).map(after));
    record(&mut journal, (110..200).map(|step| stopped(step, "emergency-stop")));
    journal.finish();
    let expected = ["motion-20261123160000-000001.mcap", "stop-20261123160000-000002.mcap"];
    assert_eq!(names(directory.path()), expected);
    let outcomes = logs(directory.path());
    let outcomes = [0, 1].map(|log| metadata(&outcomes[log], "tandem.motion.outcome"));
    assert_eq!(outcomes[0]["outcome"], "done");
    assert_eq!(outcomes[1]["outcome"], "stopped");
    assert_eq!(outcomes[1]["cause"], "emergency-stop");
    let messages = layout::messages(&logs(directory.path())[1]);
    // The last second before the stop and half a second after it.
    let n_measured = messages["/joint_states"].len();
    assert!((145..=155).contains(&n_measured), "{n_measured}");
}

#[test]
fn a_fault_while_a_motion_settles_is_its_outcome() {
    let directory = tempfile::tempdir().unwrap();
    let mut journal = journal(directory.path());
    record(&mut journal, (0..100).map(moving));
    let settling = |view| ArmsView { phase: ArmsPhase::Settling, ..view };
    record(&mut journal, (100..110).map(moving).map(settling));
    record(&mut journal, (110..200).map(|step| stopped(step, "emergency-stop")));
    journal.finish();
    assert_eq!(names(directory.path()), ["motion-20261123160000-000001.mcap"]);
    let outcome = metadata(&logs(directory.path())[0], "tandem.motion.outcome");
    assert_eq!(outcome["cause"], "emergency-stop");
}

#[test]
fn the_log_of_a_killed_bridge_can_be_recovered() {
    let directory = tempfile::tempdir().unwrap();
    let mut journal = journal(directory.path());
    record(&mut journal, (0..300).map(moving));
    let part = logs(directory.path()).remove(0);
    assert!(part.to_str().unwrap().ends_with(".mcap.part"));
    // A killed process flushes nothing.
    let copy = directory.path().join("copy.part");
    std::fs::copy(&part, &copy).unwrap();
    let recovered = recover(&copy, &directory.path().join("whole.mcap")).unwrap();
    assert_eq!(recovered.metadata_records, 1);
    let messages = layout::messages(&directory.path().join("whole.mcap"));
    assert!(messages["/joint_states"].len() >= 240, "{}", messages["/joint_states"].len());
    journal.finish();
}

#[test]
fn a_log_that_cannot_be_written_pauses_recording_for_ten_seconds() {
    let directory = tempfile::tempdir().unwrap();
    let logs = directory.path().join("logs");
    let mut journal = journal(&logs);
    std::fs::remove_dir(&logs).unwrap();
    record(&mut journal, (0..100).map(moving));
    std::fs::create_dir(&logs).unwrap();
    record(&mut journal, (100..900).map(moving));
    assert_eq!(names(&logs), [""; 0]);
    record(&mut journal, (1000..1100).map(moving));
    record(&mut journal, (1100..1300).map(idle));
    assert_eq!(names(&logs), ["motion-20261123160000-000002.mcap"]);
}

#[test]
fn the_oldest_motions_are_deleted_first() {
    let directory = tempfile::tempdir().unwrap();
    let bridge = BTreeMap::new();
    let mut journal = MotionJournal::create(directory.path(), 150_000, bridge).unwrap();
    for motion in 0..8 {
        let at = 1000 * motion;
        let views = (at..at + 100).map(moving);
        let n_motions = u64::from(motion) + 1;
        record(&mut journal, views.map(|view| ArmsView { n_motions, ..view }));
        record(&mut journal, (at + 100..at + 300).map(idle));
    }
    let names = names(directory.path());
    assert!((1..8).contains(&names.len()), "{names:?}");
    assert!(names.last().unwrap().ends_with("-000008.mcap"), "{names:?}");
    let n_bytes: u64 = logs(directory.path()).iter().map(|log| log.metadata().unwrap().len()).sum();
    assert!(n_bytes <= 150_000, "{n_bytes}");
}
