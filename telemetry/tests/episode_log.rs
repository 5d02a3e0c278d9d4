//! Logs of episodes: writing, reading and recovery.

use std::collections::BTreeMap;
use std::path::Path;

use tandem_core::TaskSpec;
use tandem_telemetry::{
    EpisodeLog, EpisodeMetadata, EpisodeRecorder, Error, LoggedTransition, read_episode, recover,
};

#[path = "support/layout.rs"]
mod layout;
#[path = "support/live.rs"]
mod live;
#[path = "support/motion.rs"]
mod motion;
#[path = "support/synthetic.rs"]
pub(crate) mod synthetic;

/// Length of the magic bytes of an MCAP file.
const MAGIC_BYTES: usize = 8;

/// Returns the bits of all numbers of a step, to compare NaN and −0 as well.
fn bits(step: &LoggedTransition) -> Vec<u32> {
    let vectors = [&step.observation, &step.goal, &step.action, &step.rewards_per_arm];
    vectors.into_iter().flatten().chain([&step.reward]).map(|number| number.to_bits()).collect()
}

fn complete_log() -> (tempfile::TempDir, Vec<u8>) {
    let dir = tempfile::tempdir().unwrap();
    let path = synthetic::write_log(&dir.path().join("whole.mcap")).unwrap();
    let bytes = std::fs::read(path).unwrap();
    (dir, bytes)
}

/// Writes `bytes` as the log of a killed writer, recovers it and reads the result.
fn recovered(dir: &Path, bytes: &[u8]) -> Result<(u64, Result<EpisodeLog, Error>), Error> {
    let (source, destination) = (dir.join("cut.mcap.part"), dir.join("cut.mcap"));
    std::fs::write(&source, bytes).unwrap();
    let counts = recover(&source, &destination)?;
    Ok((counts.messages, read_episode(&destination)))
}

#[test]
fn an_episode_is_read_back_bit_for_bit() {
    let dir = tempfile::tempdir().unwrap();
    let mut steps = synthetic::transitions();
    steps[3].observation[5] = f32::NAN;
    steps[4].action[0] = -0.0;
    steps[5].reward = f32::MIN_POSITIVE / 2.0;
    let mut recorder =
        EpisodeRecorder::create(&dir.path().join("e.mcap"), &synthetic::metadata()).unwrap();
    for (step, transition) in (0..).zip(&steps) {
        recorder
            .record_step(
                &synthetic::scene(0.02 * step as f32),
                &synthetic::record(step, transition),
            )
            .unwrap();
    }
    recorder.record_outcome(&synthetic::scene(1.0), &synthetic::last_observation()).unwrap();
    let log = read_episode(&recorder.finish().unwrap()).unwrap();
    assert_eq!(log.metadata, synthetic::metadata());
    assert_eq!(log.last_observation, Some(synthetic::last_observation()));
    assert_eq!(
        log.transitions.iter().map(bits).collect::<Vec<_>>(),
        steps.iter().map(bits).collect::<Vec<_>>()
    );
    let words = |step: &LoggedTransition| (step.advised_arms, step.contacts, step.advice.clone());
    assert_eq!(
        log.transitions.iter().map(words).collect::<Vec<_>>(),
        steps.iter().map(words).collect::<Vec<_>>()
    );
}

/// Returns the topics of a log with the number of their messages.
fn topics(bytes: &[u8]) -> BTreeMap<String, usize> {
    let mut topics = BTreeMap::new();
    for message in mcap::MessageStream::new(bytes).unwrap() {
        *topics.entry(message.unwrap().channel.topic.clone()).or_default() += 1;
    }
    topics
}

#[test]
fn an_episode_of_a_described_task_is_read_back_with_its_description() {
    let dir = tempfile::tempdir().unwrap();
    let record = |n_goal_per_arm: usize| {
        let task = synthetic::described(n_goal_per_arm);
        let metadata = EpisodeMetadata { task: task.clone(), ..synthetic::metadata() };
        let path = dir.path().join(format!("{n_goal_per_arm}.mcap"));
        let path = synthetic::write_described_log(&path, &task).unwrap();
        let (log, steps) = (read_episode(&path).unwrap(), synthetic::transitions_of(&task));
        let last = vec![0.5; task.n_observation()];
        assert_eq!((&log.metadata, &log.last_observation), (&metadata, &Some(last)));
        assert_eq!(
            log.transitions.iter().map(bits).collect::<Vec<_>>(),
            steps.iter().map(bits).collect::<Vec<_>>()
        );
        topics(&std::fs::read(path).unwrap())
    };
    let of_numbers = [("/outcome", 1), ("/stats", 12), ("/transition", 12)];
    let of_points = [("/outcome", 1), ("/scene", 13), ("/stats", 12), ("/transition", 12)];
    let expected = |topics: &[(&str, usize)]| -> BTreeMap<String, usize> {
        topics.iter().map(|(topic, n)| ((*topic).to_owned(), *n)).collect()
    };
    assert_eq!(record(3), expected(&of_points));
    assert_eq!(record(2), expected(&of_points));
    assert_eq!(record(1), expected(&of_numbers), "a goal of one number is no point");
}

/// The part of the message `/outcome` that a viewer shows.
#[derive(Clone, PartialEq, prost::Message)]
struct ShownOutcome {
    #[prost(bool, tag = "2")]
    success: bool,
    #[prost(bool, repeated, tag = "3")]
    success_per_arm: Vec<bool>,
}

/// Returns the outcome of an episode in which the arms are at their goals in the last observations, each in a number of
/// its own, and succeed after three.
fn outcome(n_at_goal: [usize; 2]) -> (bool, Vec<bool>) {
    let mut description = synthetic::described(1).description().clone();
    description.manipulation.success_steps = 3;
    let task = TaskSpec::new(description).unwrap();
    let n_steps = task.episode_steps();
    let observation = |step: usize| {
        let mut observation = vec![0.0; task.n_observation()];
        for (arm_idx, n_at_goal) in n_at_goal.into_iter().enumerate() {
            observation[5 * arm_idx] = if step + n_at_goal > n_steps { 0.5 } else { 0.0 };
        }
        observation
    };
    let dir = tempfile::tempdir().unwrap();
    let metadata = EpisodeMetadata { task: task.clone(), ..synthetic::metadata() };
    let mut recorder =
        EpisodeRecorder::create(&dir.path().join("outcome.mcap"), &metadata).unwrap();
    for (step, mut transition) in (0..).zip(synthetic::transitions_of(&task)) {
        transition.observation = observation(step as usize);
        transition.goal = vec![0.5; task.n_goal()];
        recorder.record_step(None, &synthetic::record(step, &transition)).unwrap();
    }
    recorder.record_outcome(None, &observation(n_steps)).unwrap();
    let path = recorder.finish().unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let mut messages = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap);
    let message = messages.find(|message| message.channel.topic == "/outcome").unwrap();
    let outcome = <ShownOutcome as prost::Message>::decode(&*message.data).unwrap();
    let log = read_episode(&path).unwrap();
    let per_arm: Vec<bool> = task.arms().filter_map(|arm| log.arm_succeeded(arm)).collect();
    assert_eq!((log.succeeded(), &per_arm), (Some(outcome.success), &outcome.success_per_arm));
    (outcome.success, outcome.success_per_arm)
}

#[test]
fn an_outcome_is_a_success_after_as_many_steps_as_the_task_asks_for() {
    assert_eq!(outcome([3, 3]), (true, vec![true, true]));
    assert_eq!(outcome([3, 2]), (false, vec![true, false]), "the goal for two steps of three");
    assert_eq!(outcome([12, 0]), (false, vec![true, false]));
}

#[test]
fn the_same_episode_gives_the_same_bytes() {
    assert_eq!(complete_log().1, complete_log().1);
}

#[test]
fn a_file_has_its_final_name_only_when_it_is_complete() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("e.mcap");
    let recorder = synthetic::recorded(&path).unwrap();
    assert!(!path.exists() && dir.path().join("e.mcap.part").exists());
    assert_eq!(recorder.finish().unwrap(), path);
    assert!(path.exists() && !dir.path().join("e.mcap.part").exists());
}

#[test]
fn a_killed_writer_loses_at_most_the_last_steps() {
    let dir = tempfile::tempdir().unwrap();
    let mut recorder =
        EpisodeRecorder::create(&dir.path().join("e.mcap"), &synthetic::metadata()).unwrap();
    for (step, transition) in (0..37).zip(&synthetic::transitions()) {
        recorder.record_step(&synthetic::scene(0.0), &synthetic::record(step, transition)).unwrap();
    }
    // A kill at this moment would leave what is on disk.
    let on_disk = std::fs::read(dir.path().join("e.mcap.part")).unwrap();
    let (_, log) = recovered(dir.path(), &on_disk).unwrap();
    let log = log.unwrap();
    assert!((30..=37).contains(&log.transitions.len()), "{}", log.transitions.len());
    assert_eq!(log.transitions, synthetic::transitions()[..log.transitions.len()]);
}

#[test]
fn a_file_cut_anywhere_is_recovered_and_more_bytes_give_no_fewer_messages() {
    let (dir, bytes) = complete_log();
    let mut best = 0;
    for n_bytes in (MAGIC_BYTES..bytes.len()).step_by(307).chain([bytes.len() - 1, bytes.len()]) {
        let (n_messages, log) = match recovered(dir.path(), &bytes[..n_bytes]) {
            Ok((n_messages, log)) => (n_messages, Some(log.unwrap())),
            Err(Error::NothingToRecover { .. }) => (0, None),
            Err(error) => panic!("{n_bytes} bytes: {error:?}"),
        };
        assert!(
            n_messages >= best,
            "{n_bytes} bytes gave {n_messages} messages, fewer gave {best}"
        );
        best = n_messages;
        assert_eq!(log.is_some(), n_messages > 0, "{n_bytes} bytes");
        if let Some(log) = log {
            assert!(log.transitions == synthetic::transitions()[..log.transitions.len()]);
        }
    }
    assert_eq!(best, 51 * 3 + 50 * 2 + 2);
}

#[test]
fn a_damaged_file_is_refused_and_its_recovery_never_panics() {
    let (dir, bytes) = complete_log();
    let mut n_recovered = 0;
    for offset in (0..120).chain((120..bytes.len()).step_by(307)) {
        let mut damaged = bytes.clone();
        damaged[offset] ^= 0x5a;
        let path = dir.path().join("damaged.mcap");
        std::fs::write(&path, &damaged).unwrap();
        assert!(read_episode(&path).is_err(), "byte {offset}");
        let recovered = recovered(dir.path(), &damaged);
        let is_mcap = !matches!(recovered, Err(Error::NotMcap { .. }));
        assert_eq!(is_mcap, offset >= MAGIC_BYTES, "byte {offset}");
        match recovered {
            Ok((n_messages, log)) => {
                n_recovered += 1;
                assert!(n_messages > 0, "byte {offset}");
                let log = log.map_or_else(|_| Vec::new(), |log| log.transitions);
                assert!(log == synthetic::transitions()[..log.len()], "byte {offset}");
            }
            Err(Error::NotMcap { .. } | Error::NothingToRecover { .. }) => {}
            Err(error) => panic!("byte {offset}: {error:?}"),
        }
    }
    println!(
        "{n_recovered} of {} damaged logs gave messages",
        120 + (bytes.len() - 120).div_ceil(307)
    );
    assert!(n_recovered > 0, "no damaged log gave messages");
}

#[test]
fn altered_metadata_are_refused() {
    let (dir, bytes) = complete_log();
    let seed = synthetic::metadata().seed.to_string();
    let entry = [&4_u32.to_le_bytes(), &b"seed"[..], &[u8::try_from(seed.len()).unwrap(), 0, 0, 0]];
    let entry = [entry.concat().as_slice(), seed.as_bytes()].concat();
    let at = bytes.windows(entry.len()).position(|window| window == entry).unwrap();
    let mut altered = bytes[..bytes.len() - 100].to_vec();
    altered[at + entry.len() - 1] ^= 1;
    let (n_messages, log) = recovered(dir.path(), &altered).unwrap();
    let refusal = log.unwrap_err();
    assert!(matches!(refusal, Error::NotAnEpisode { .. }) && n_messages > 0, "{refusal:?}");
    assert!(refusal.to_string().contains("checksum"), "{refusal}");
}

#[test]
fn a_file_that_is_not_the_log_of_an_episode_is_refused() {
    let (dir, bytes) = complete_log();
    let path = dir.path().join("other.mcap");
    let refusal = |content: &[u8]| {
        std::fs::write(&path, content).unwrap();
        read_episode(&path).unwrap_err().to_string()
    };
    assert!(refusal(b"not an mcap file at all").contains("is not an MCAP file"));
    let last_byte_changed = [&bytes[..bytes.len() - 1], b"?"].concat();
    let part = |n_bytes| &bytes[..n_bytes];
    let half = part(bytes.len() / 2);
    for content in [part(0), part(5), half, part(bytes.len() - 3), &last_byte_changed] {
        assert!(refusal(content).contains("not a complete MCAP file"), "{}", refusal(content));
    }
    assert!(matches!(recover(&path, &dir.path().join("x")), Ok(_) | Err(Error::ReadLog { .. })));
    assert!(matches!(
        read_episode(&dir.path().join("absent")),
        Err(Error::Io { action: "read", .. })
    ));
}

#[test]
fn garbage_is_not_recovered_as_an_empty_file() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("garbage"), b"garbage").unwrap();
    let destination = dir.path().join("recovered.mcap");
    assert!(matches!(
        recover(&dir.path().join("garbage"), &destination),
        Err(Error::NotMcap { .. })
    ));
    assert!(!destination.exists());
}

#[test]
fn a_file_without_messages_is_not_recovered_as_an_empty_file() {
    let (dir, bytes) = complete_log();
    let names = || std::fs::read_dir(dir.path()).unwrap().count();
    let n_before = names() + 1;
    for n_bytes in [MAGIC_BYTES, MAGIC_BYTES + 1, 100] {
        let refusal = recovered(dir.path(), &bytes[..n_bytes]).unwrap_err();
        assert!(matches!(refusal, Error::NothingToRecover { .. }), "{refusal:?}");
        assert!(refusal.to_string().ends_with("cut.mcap.part\" has no message to recover"));
        assert_eq!(names(), n_before, "only the log itself is there");
    }
}

#[test]
fn vectors_that_do_not_fit_the_task_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let mut recorder =
        EpisodeRecorder::create(&dir.path().join("e.mcap"), &synthetic::metadata()).unwrap();
    let step = &synthetic::transitions()[0];
    let scene = synthetic::scene(0.0);
    let mut check = |field: &str, alter: &dyn Fn(&mut LoggedTransition)| {
        let mut altered = step.clone();
        alter(&mut altered);
        let error = recorder.record_step(&scene, &synthetic::record(0, &altered)).unwrap_err();
        assert!(error.to_string().starts_with(field), "{error}");
    };
    check("observation", &|step| step.observation.truncate(28));
    check("goal", &|step| step.goal.push(0.0));
    check("action", &|step| step.action.push(0.0));
    check("rewards_per_arm", &|step| step.rewards_per_arm.clear());
    check("advice", &|step| step.advice.truncate(1));
}

#[test]
fn time_before_the_start_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let mut recorder =
        EpisodeRecorder::create(&dir.path().join("e.mcap"), &synthetic::metadata()).unwrap();
    for time_s in [-0.1, f64::NAN, f64::INFINITY] {
        let scene = tandem_core::scene::Scene { time_s, ..synthetic::scene(0.0) };
        let step = &synthetic::transitions()[0];
        assert!(matches!(
            recorder.record_step(&scene, &synthetic::record(0, step)),
            Err(Error::Time { .. })
        ));
    }
}
