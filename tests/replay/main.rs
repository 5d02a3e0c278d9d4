//! Replays of recorded episodes of every kind: bit for bit equal, or the first difference is named.

mod damaged;
mod recording;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::json;
use tandem_core::layout::EPISODE_STEPS;
use tandem_core::task::TaskDescription;
use tandem_core::{Contacts, Layout, Task, TaskSpec, World};
use tandem_telemetry::{
    EpisodeLog, EpisodeMetadata, EpisodeRecorder, TransitionRecord, TrialMetadata, TrialOutcome,
    TrialRecorder, read_episode,
};
use tandem_worker::record::world_of;
use tandem_worker::replay::replay_log;

use crate::recording::{KINDS, error_line, one_log, record, stdout, summary, tandem};

#[test]
fn episodes_of_every_kind_replay_bit_for_bit() {
    let keep = tempfile::tempdir().expect("a directory");
    // A step of the shared world takes four times as many physics steps.
    let resolutions = |task: Task| match task.world() {
        World::Classic => vec![10, 20],
        World::Shared | World::Slow => vec![10],
    };
    let worlds = Task::ALL.into_iter().flat_map(|task| {
        (task.min_arms()..=2).flat_map(move |n_arms| {
            resolutions(task).into_iter().map(move |substeps| (task, n_arms, substeps))
        })
    });
    let logs: Vec<PathBuf> = std::thread::scope(|scope| {
        let threads: Vec<_> = worlds
            .map(|(task, n_arms, substeps)| {
                let directory = keep.path().join(format!("{task}-{n_arms}-{substeps}"));
                scope.spawn(move || {
                    fs::create_dir(&directory).expect("created");
                    let layout = Layout::new(task, n_arms);
                    let of_kind = |kind| record(layout, kind, substeps, &directory);
                    KINDS.into_iter().flat_map(of_kind).collect::<Vec<_>>()
                })
            })
            .collect();
        threads.into_iter().flat_map(|thread| thread.join().expect("records")).collect()
    });
    assert_eq!(logs.len(), 130);

    let read: Vec<EpisodeLog> = logs.iter().map(|log| read_episode(log).expect("whole")).collect();
    let n_logs_with = |holds: &dyn Fn(&EpisodeLog) -> bool| {
        read.iter().filter(|log| log.transitions.len() == EPISODE_STEPS && holds(log)).count()
    };
    let advised = n_logs_with(&|log| log.transitions.iter().any(|step| step.advised_arms != 0));
    let touching = n_logs_with(&|log| log.transitions.iter().any(|step| step.contacts.any()));
    let achieving = n_logs_with(&|log| log.transitions.iter().any(|step| step.reward == 0.0));
    assert_eq!(advised, 26);
    assert!(touching >= 3 && achieving >= 15, "{touching} touch, {achieving} achieve");

    let whole = tandem(&["replay", "--verify"], &[keep.path()]);
    assert_eq!(stdout(&whole), "130 of 130 episodes equal bit for bit\n");
    assert!(whole.status.success() && whole.stderr.is_empty());
    let as_json = tandem(&["replay", "--json"], &[keep.path(), &logs[0]]);
    let expected = json!({
        "episodes": 131, "equal": 131, "differing": [], "unreadable": [], "not_simulated": [],
        "cut_short": [], "trials": [],
    });
    assert_eq!(summary(&as_json), expected);
}

/// Writes the content of `log` to a new file with valid checksums, without scenes if the task is not built-in.
fn rewrite(log: &EpisodeLog, metadata: &EpisodeMetadata, path: &Path) {
    let has_scenes = metadata.task.as_built_in().is_some();
    let mut world = world_of(&log.metadata).expect("described");
    let mut recorder = EpisodeRecorder::create(path, metadata).expect("created");
    for (step, transition) in (0..).zip(&log.transitions) {
        let record = TransitionRecord {
            step,
            observation: &transition.observation,
            goal: &transition.goal,
            action: &transition.action,
            reward: transition.reward,
            rewards_per_arm: &transition.rewards_per_arm,
            advised_arms: transition.advised_arms,
            contacts: transition.contacts,
            advice: &transition.advice,
            budget_left: transition.budget_left,
        };
        let scene = has_scenes.then(|| world.scene());
        recorder.record_step(scene.as_ref(), &record).expect("recorded");
        world.step(&transition.action).expect("steps");
    }
    if let Some(last_observation) = &log.last_observation {
        let scene = has_scenes.then(|| world.scene());
        recorder.record_outcome(scene.as_ref(), last_observation).expect("recorded");
    }
    recorder.finish().expect("finished");
}

fn flip_last_bit(number: &mut f32) {
    *number = f32::from_bits(number.to_bits() ^ 1);
}

type Alteration = fn(&mut EpisodeLog);

/// Alterations, each with the step, vector and component where replay finds it.
const ALTERATIONS: [(&str, Alteration, (usize, &str, usize)); 7] = [
    (
        "seen",
        |log| flip_last_bit(&mut log.transitions[17].observation[41]),
        (17, "observation", 41),
    ),
    ("goal", |log| flip_last_bit(&mut log.transitions[20].goal[4]), (20, "goal", 4)),
    ("reward", |log| log.transitions[33].reward = -0.5, (33, "reward", 0)),
    (
        "arm",
        |log| flip_last_bit(&mut log.transitions[8].rewards_per_arm[1]),
        (8, "rewards_per_arm", 1),
    ),
    ("contacts", |log| alter_contacts(&mut log.transitions[25].contacts), (25, "contacts", 0)),
    (
        "last",
        |log| flip_last_bit(&mut log.last_observation.as_mut().expect("whole")[3]),
        (50, "observation", 3),
    ),
    ("minus", |log| log.transitions[4].goal[0] = -log.transitions[4].goal[0], (4, "goal", 0)),
];

fn alter_contacts(contacts: &mut Contacts) {
    *contacts = Contacts::from_bits(contacts.bits() ^ 1).expect("two bits");
}

#[test]
fn an_altered_number_is_found_and_named() {
    let keep = tempfile::tempdir().expect("a directory");
    let log = read_episode(&one_log(keep.path())).expect("whole");
    let (good, bad) = (keep.path().join("good"), keep.path().join("bad"));
    fs::create_dir(&good).expect("created");
    fs::create_dir(&bad).expect("created");
    for (name, alter, _) in ALTERATIONS {
        let mut altered = log.clone();
        alter(&mut altered);
        assert_ne!(format!("{altered:?}"), format!("{log:?}"), "{name} is altered");
        rewrite(&altered, &log.metadata, &bad.join(format!("{name}.mcap")));
    }
    rewrite(&log, &log.metadata, &good.join("unaltered.mcap"));

    let found = tandem(&["replay", "--json"], &[&good, &bad]);
    assert_eq!(found.status.code(), Some(65));
    let found = summary(&found);
    assert_eq!((&found["episodes"], &found["equal"]), (&json!(8), &json!(1)));
    let differing = found["differing"].as_array().expect("a list");
    assert_eq!(differing.len(), ALTERATIONS.len());
    for (name, _, (step, field, component)) in ALTERATIONS {
        let path = bad.join(format!("{name}.mcap"));
        let entry = differing.iter().find(|entry| entry["file"] == json!(path)).expect(name);
        let location = (&entry["step"], &entry["field"], &entry["component"]);
        assert_eq!(location, (&json!(step), &json!(field), &json!(component)), "{name}");
        let alone = tandem(&["replay", "--verify"], &[&path]);
        let line = error_line(&alone);
        assert_eq!(alone.status.code(), Some(65), "{line}");
        assert!(
            line.contains(&format!("{name}.mcap: step {step}: {field}[{component}] is ")),
            "{line}"
        );
    }
}

#[test]
fn a_log_of_a_described_task_is_printed_but_needs_its_environments_to_be_compared() {
    let keep = tempfile::tempdir().expect("a directory");
    let built_in = one_log(keep.path());
    let log = read_episode(&built_in).expect("whole");
    let description = TaskDescription {
        name: "lab/pick".to_owned(),
        ..Layout::new(Task::PickAndPlace, 2).description()
    };
    let task = TaskSpec::new(description).expect("valid");
    let described = keep.path().join("described.mcap");
    rewrite(&log, &EpisodeMetadata { task, ..log.metadata.clone() }, &described);

    let printed = tandem(&["replay"], &[&described]);
    assert!(printed.status.success() && printed.stderr.is_empty(), "{printed:?}");
    let lines: Vec<String> = stdout(&printed).lines().map(str::to_owned).collect();
    assert_eq!(lines[1], "task lab/pick, 2 arms, tolerance 0.05");
    assert!(lines[2].starts_with("step  arm 0, from its goal"), "{}", lines[2]);
    assert!(lines[3].starts_with("   0  0."), "{}", lines[3]);
    assert!(lines[3..].iter().take(50).all(|line| line.chars().count() <= 80), "{lines:?}");
    let n_advised = lines.iter().filter(|line| line.contains(", advised")).count();
    assert_eq!(n_advised, log.transitions.iter().filter(|step| step.advised_arms != 0).count());
    let [.., end, outcome, last] = lines.as_slice() else { panic!("{lines:?}") };
    assert!(end.starts_with(" end  0."), "{end}");
    let all_at_goal = end.matches("at goal").count() == 2;
    assert_eq!(outcome, if all_at_goal { "success" } else { "failure" });
    assert!(last.starts_with("not compared: the episode is of task \"lab/pick\""), "{last}");

    let verified = tandem(&["replay", "--verify"], &[&described]);
    assert_eq!(verified.status.code(), Some(64));
    let line = error_line(&verified);
    assert!(line.contains("described.mcap: the episode is of task \"lab/pick\""), "{line}");
    assert!(line.contains("--env or --env-command"), "{line}");
    let both = tandem(&["replay", "--json"], &[&built_in, &described]);
    assert_eq!(both.status.code(), Some(64));
    let expected = json!({
        "episodes": 2, "equal": 1, "differing": [], "unreadable": [],
        "not_simulated": [described], "cut_short": [], "trials": [],
    });
    assert_eq!(summary(&both), expected);
    fs::write(keep.path().join("garbage.mcap"), "garbage").expect("written");
    let all = tandem(&["replay", "--verify"], &[keep.path()]);
    assert_eq!(all.status.code(), Some(65), "the unreadable log is the worse problem");
}

#[test]
fn logs_of_trials_are_left_out_and_named_if_there_is_nothing_else() {
    let keep = tempfile::tempdir().expect("a directory");
    let log = one_log(keep.path());
    let trial = keep.path().join("trial.mcap");
    let metadata = TrialMetadata {
        policy: "student".to_owned(),
        layout: Layout::new(Task::Push, 2),
        mode: "closed-loop".to_owned(),
        trial: 0,
        seed: 1,
        policy_digest: "d".to_owned(),
        driver: "simulated".to_owned(),
        speed: 1.0,
        block_half_m: Some(0.028),
    };
    let recorder = TrialRecorder::create(&trial, &metadata).expect("created");
    recorder.finish(&TrialOutcome::default()).expect("complete");

    let both = tandem(&["replay", "--verify"], &[keep.path()]);
    assert!(both.status.success() && both.stderr.is_empty(), "{both:?}");
    assert_eq!(stdout(&both), "2 of 2 episodes equal bit for bit\n1 trial log left out\n");
    for args in [&["replay"][..], &["replay", "--verify"]] {
        let alone = tandem(args, &[&trial]);
        assert_eq!(alone.status.code(), Some(65));
        let line = error_line(&alone);
        assert!(line.contains("log of a trial") && line.contains("Foxglove"), "{line}");
    }
    fs::write(keep.path().join("garbage.mcap"), "garbage").expect("written");
    fs::write(keep.path().join("more.mcap"), "garbage").expect("written");
    let all = tandem(&["replay", "--verify"], &[keep.path(), &log]);
    assert_eq!(all.status.code(), Some(65));
    let line = error_line(&all);
    assert!(
        line.contains("2 logs cannot be read, the first") && !line.contains("differ"),
        "{line}"
    );
}

#[test]
fn an_episode_is_compared_in_the_environments_of_a_server() {
    let keep = tempfile::tempdir().expect("a directory");
    let log = one_log(keep.path());
    let command = format!("'{}' env --task pick-and-place", env!("CARGO_BIN_EXE_tandem"));
    let equal = tandem(&["replay", "--verify", "--env-command", &command], &[&log]);
    assert_eq!(stdout(&equal), "1 of 1 episodes equal bit for bit\n", "{equal:?}");
    assert!(equal.status.success());
    let none = tandem(&["replay", "--verify", "--env-command", "exit 3"], &[&log]);
    assert_eq!(none.status.code(), Some(64));
    assert!(error_line(&none).contains("ended with exit code 3"));
}

#[test]
fn a_film_of_an_evaluation_has_the_bytes_of_one_of_its_log() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = |name: &str| directory.path().join(name);
    let (log, played, replayed) = (path("one.mcap"), path("played.gif"), path("replayed.gif"));
    let policy = Path::new("policies/teacher-push-classic.safetensors");
    let film = ["--film-size", "96x64", "--film"];
    let eval = ["eval", "--episodes", "1", "--policy"];
    let output = Command::new(env!("CARGO_BIN_EXE_tandem"))
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .args(eval)
        .arg(policy)
        .arg("--record")
        .arg(&log)
        .args(film)
        .arg(&played)
        .output();
    let output = output.expect("runs");
    assert!(output.status.success(), "{output:?}");
    assert!(stdout(&output).contains("film          "), "{output:?}");
    let output = tandem(&["replay", film[0], film[1]], &[&log, Path::new("--film"), &replayed]);
    assert!(output.status.success(), "{output:?}");
    let [played, replayed] = [played, replayed].map(|film| fs::read(film).expect("written"));
    assert!(played.starts_with(b"GIF89a") && played == replayed);

    let strip = path("strip.png");
    let output = tandem(&["replay", film[0], film[1]], &[&log, Path::new("--film"), &strip]);
    assert!(output.status.success(), "{output:?}");
    assert!(fs::read(strip).expect("written").starts_with(b"\x89PNG"));
}

#[test]
fn a_changed_action_or_world_changes_the_replay() {
    let keep = tempfile::tempdir().expect("a directory");
    let log = read_episode(&one_log(keep.path())).expect("whole");
    assert!(replay_log(&log).is_ok());
    let check = |alter: Alteration, expected: &str| {
        let mut altered = log.clone();
        alter(&mut altered);
        let message = replay_log(&altered).expect_err(expected).to_string();
        assert!(message.starts_with(expected), "{message:?} does not start with {expected:?}");
    };
    check(|log| log.transitions[9].action[2] = 0.77, "step 10: observation[");
    check(|log| log.transitions[9].action[2] = f32::NAN, "action");
    check(|log| log.metadata.seed += 1, "step 0: observation[");
    check(|log| log.metadata.episode += 1, "step 0: observation[");
    check(
        |log| drop(log.metadata.world.insert("substeps".into(), "20".into())),
        "step 1: observation[",
    );
    check(|log| drop(log.metadata.world.remove("substeps")), "metadata entry \"substeps\"");
    check(
        |log| drop(log.metadata.world.insert("substeps".into(), "-1".into())),
        "metadata entry \"substeps\"",
    );
    check(
        |log| drop(log.metadata.world.insert("substeps".into(), "9".into())),
        "world.substeps is 9",
    );
    check(
        |log| drop(log.metadata.world.insert("randomization".into(), "inf".into())),
        "world.randomization is inf",
    );
}
