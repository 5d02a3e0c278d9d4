//! Whole, truncated, altered, foreign and hostile checkpoints.

use std::collections::BTreeMap;

use proptest::prelude::{Strategy, any};
use proptest::test_runner::{Config, TestCaseError, TestRunner};
use tandem_core::{ArmIndex, Episode, Task, TaskSpec};
use tandem_rl::config::Recipe;
use tandem_rl::trainer::RoundStats;
use tandem_telemetry::MetricsRow;
use tempfile::TempDir;

use super::*;

/// Returns an episode in which the object of arm 0 moves by `drift_m` per step along x.
fn drifting_episode(task: &TaskSpec, number: u64, drift_m: f32) -> Episode {
    let mut episode = Episode::zeros(task, number);
    let x = task.achieved_goal_of(ArmIndex(0)).index(0);
    let mut position = 0.0;
    for observation in episode.observations.chunks_exact_mut(task.n_observation()) {
        observation[x] = position;
        position += drift_m;
    }
    episode
}

fn small_config() -> RunConfig {
    let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 1);
    config.ddpg.n_hidden = 3;
    config.ddpg.n_hidden_layers = 1;
    config.ddpg.batch_size = 4;
    config.rounds.slots = 1;
    config.rounds.updates_per_env_step = 0.02;
    config
}

fn train_round(trainer: &mut Trainer) -> RoundStats {
    let round = trainer.counters().round;
    let episodes: Vec<_> = (round * 2..round * 2 + 2)
        .map(|number| drifting_episode(&trainer.task, number, 0.002 * number as f32))
        .collect();
    trainer.ingest(&episodes);
    trainer.learn(|_| ()).expect("finite")
}

/// Returns the state of a run besides its trainer, with a pending evaluation.
fn resumption(trainer: &Trainer) -> Resumption {
    let policy =
        |name: &str| trainer.policy(BTreeMap::from([("name".to_owned(), name.to_owned())]));
    let row = |round, best| MetricsRow {
        round,
        best,
        success: f64::from(u32::try_from(round).expect("small")) / 3.0,
        mean_q: f64::NAN,
        success_per_arm: vec![0.1 + 0.2],
        ..MetricsRow::default()
    };
    Resumption {
        acting: trainer.publish(),
        history: EvaluationHistory {
            rows: vec![row(1, true), row(2, false)],
            best: Some(policy("best")),
            last: Some(policy("last")),
        },
        pending: vec![PendingEvaluation {
            counters: trainer.counters(),
            stats: trainer.stats(),
            wall_s: 11.25,
            policy: policy("pending"),
        }],
        wall_s: 12.5,
        teacher_policy: Some("5f3a".to_owned()),
        had_other_policy: true,
        account: Some(RenamedAccount { name: "toy.from-140".to_owned(), budget: 9860 }),
    }
}

/// A directory with the checkpoints of `n` rounds.
fn saved(n: u64) -> (TempDir, Trainer) {
    let directory = tempfile::tempdir().expect("a directory");
    let mut trainer = Trainer::new(small_config()).expect("valid");
    for _ in 0..n {
        train_round(&mut trainer);
        save(directory.path(), &trainer, &resumption(&trainer), 2).expect("saves");
    }
    (directory, trainer)
}

fn newest(directory: &TempDir) -> PathBuf {
    list(directory.path()).pop().expect("there is one")
}

fn refusal(directory: &TempDir) -> CheckpointError {
    load_newest(directory.path(), &small_config()).expect_err("must be refused")
}

fn restored(directory: &TempDir) -> Restored {
    load_newest(directory.path(), &small_config()).expect("whole").expect("there is one")
}

#[test]
fn a_restored_run_continues_with_the_same_bits() {
    let (directory, mut uninterrupted) = saved(2);
    let Restored { mut trainer, resumption: loaded, path } = restored(&directory);
    assert_eq!(path, newest(&directory));
    assert_eq!(trainer.stats(), uninterrupted.stats());
    // NaN is not itself: rows are compared as they are written.
    let take_rows = |resumption: &mut Resumption| {
        serde_json::to_string(&std::mem::take(&mut resumption.history.rows)).expect("written")
    };
    let (mut got, mut expected) = (loaded, resumption(&uninterrupted));
    assert_eq!(take_rows(&mut got), take_rows(&mut expected));
    assert_eq!(got, expected);
    assert_eq!(trainer.digest(), uninterrupted.digest());
    train_round(&mut uninterrupted);
    train_round(&mut trainer);
    assert_eq!(trainer.digest(), uninterrupted.digest());
}

#[test]
fn a_checkpoint_without_the_teachers_policy_and_account_can_be_resumed() {
    let directory = tempfile::tempdir().expect("a directory");
    let mut trainer = Trainer::new(small_config()).expect("valid");
    train_round(&mut trainer);
    let without = Resumption {
        teacher_policy: None,
        had_other_policy: false,
        account: None,
        ..resumption(&trainer)
    };
    let path = save(directory.path(), &trainer, &without, 1).expect("saves").path;
    let bytes = fs::read(path).expect("readable");
    for key in ["teacher_policy", "advice_account"] {
        let is_there = bytes.windows(key.len()).any(|window| window == key.as_bytes());
        assert!(!is_there, "{key}: earlier versions did not write it");
    }
    let Resumption { teacher_policy, had_other_policy, account, .. } =
        restored(&directory).resumption;
    assert_eq!((teacher_policy, had_other_policy, account), (None, false, None));
}

#[test]
fn a_restored_ensemble_of_critics_continues_with_the_same_bits() {
    let mut config = small_config();
    "ts2c:0.5".clone_into(&mut config.advice.strategy);
    let mut uninterrupted = Trainer::new(config.clone()).expect("valid");
    train_round(&mut uninterrupted);
    let directory = tempfile::tempdir().expect("a directory");
    save(directory.path(), &uninterrupted, &resumption(&uninterrupted), 1).expect("saved");
    let restored = load_newest(directory.path(), &config).expect("readable").expect("a checkpoint");
    let Restored { mut trainer, resumption, .. } = restored;
    assert!(resumption.acting.gate.is_some());
    assert_eq!(resumption.acting, uninterrupted.publish());
    train_round(&mut uninterrupted);
    train_round(&mut trainer);
    assert_eq!(trainer.digest(), uninterrupted.digest());
    assert_eq!(trainer.publish(), uninterrupted.publish());
    assert_ne!(trainer.publish().gate, resumption.acting.gate, "the critics learn");
}

#[test]
fn a_resumed_run_orders_the_round_with_the_horizon_that_it_had() {
    let mut config = small_config();
    "jsrl:20".clone_into(&mut config.advice.strategy);
    config.rounds.slots = 32;
    let mut trainer = Trainer::new(config.clone()).expect("valid");
    let play = |trainer: &mut Trainer, goal_m: f32| {
        let episode = |number| {
            let mut episode = drifting_episode(&trainer.task, number, 0.0);
            episode.goal.fill(if number % 10 == 0 { goal_m } else { 9.0 });
            Episode { queried_steps: Some(3), ..episode }
        };
        let episodes: Vec<_> = (0..64).map(episode).collect();
        trainer.ingest(&episodes);
        trainer.learn(|_| ()).expect("finite");
    };
    play(&mut trainer, 0.0);
    // With a lag of 1 the next round is ordered before this one is learned.
    let ordered = trainer.training_orders(2, 1);
    assert_eq!(ordered[0].episodes[0].advised_steps, Some(14), "ceil(20 * (1 - 7 / 32 / 0.7))");
    assert_eq!(trainer.training_orders(1, 1)[0].episodes[0].advised_steps, Some(20));
    play(&mut trainer, 9.0);
    let directory = tempfile::tempdir().expect("a directory");
    save(directory.path(), &trainer, &resumption(&trainer), 1).expect("saved");
    let restored = load_newest(directory.path(), &config).expect("readable").expect("a checkpoint");
    assert_eq!(restored.trainer.training_orders(2, 1), ordered);
    assert_eq!(restored.trainer.digest(), trainer.digest());
    assert_eq!(restored.trainer.counters(), trainer.counters());
    assert_eq!(trainer.counters().advice_queries, 2 * 64 * 3);
}

#[test]
fn the_newest_checkpoints_stay_including_the_one_just_written() {
    let (directory, mut trainer) = saved(3);
    let rounds = || -> Vec<String> {
        let name = |path: &PathBuf| Some(path.file_stem()?.to_str()?.to_owned());
        list(directory.path()).iter().filter_map(name).collect()
    };
    assert_eq!(rounds(), ["00000002", "00000003"]);
    let mut earlier = Trainer::new(small_config()).expect("valid");
    train_round(&mut earlier);
    save(directory.path(), &earlier, &resumption(&earlier), 1).expect("saves");
    assert_eq!(rounds(), ["00000001"], "even when others have higher numbers");
    train_round(&mut trainer);
    save(directory.path(), &trainer, &resumption(&trainer), 1).expect("saves");
    assert_eq!(rounds(), ["00000004"]);
}

#[test]
fn a_file_with_another_name_is_no_checkpoint() {
    let (directory, mut trainer) = saved(2);
    let copy = directory.path().join("keep-1.safetensors");
    fs::copy(directory.path().join("00000001.safetensors"), &copy).expect("copies");
    assert_eq!(restored(&directory).path, directory.path().join("00000002.safetensors"));
    train_round(&mut trainer);
    save(directory.path(), &trainer, &resumption(&trainer), 2).expect("saves");
    let rounds: Vec<_> = list(directory.path()).iter().map(|path| round_of(path)).collect();
    assert_eq!(rounds, [Some(2), Some(3)]);
    assert!(copy.exists(), "the user's file stays and does not count");
}

#[test]
fn a_missing_checkpoint_is_no_error() {
    let directory = tempfile::tempdir().expect("a directory");
    let load = || load_newest(&directory.path().join("checkpoint"), &small_config());
    assert!(load().expect("no error").is_none(), "no directory");
    fs::create_dir(directory.path().join("checkpoint")).expect("creates");
    assert!(load().expect("no error").is_none(), "an empty one");
    fs::write(directory.path().join("checkpoint/00000001.safetensors.tmp"), "half")
        .expect("writes");
    assert!(load().expect("no error").is_none(), "an unfinished one");
    fs::remove_dir(directory.path().join("checkpoint")).expect("the unfinished one is removed");
    fs::write(directory.path().join("checkpoint"), "").expect("writes");
    assert!(matches!(load(), Err(CheckpointError::Io { .. })), "what cannot be read is not empty");
}

#[test]
fn a_writer_killed_at_any_byte_leaves_the_former_checkpoint_in_use() {
    let (directory, _) = saved(2);
    let whole = fs::read(newest(&directory)).expect("readable");
    let unfinished = newest(&directory).with_extension("safetensors.tmp");
    fs::remove_file(newest(&directory)).expect("removes");
    let former = newest(&directory);
    for n_bytes in (0..whole.len()).step_by(1009).chain([whole.len()]) {
        fs::write(&unfinished, &whole[..n_bytes]).expect("writes");
        assert_eq!(restored(&directory).path, former, "{n_bytes} bytes");
        assert!(!unfinished.exists());
    }
}

#[test]
fn a_checkpoint_cut_at_any_byte_is_refused_by_name_and_the_former_offered() {
    let (directory, _) = saved(2);
    let newest = newest(&directory);
    let whole = fs::read(&newest).expect("readable");
    let header = 8 + usize::from(u16::from_le_bytes([whole[0], whole[1]]));
    let in_header = (0..header).step_by(13);
    let in_tensors = (header..whole.len()).step_by(509);
    for n_bytes in in_header.chain(in_tensors).chain([header, whole.len() - 1]) {
        fs::write(&newest, &whole[..n_bytes]).expect("writes");
        let refusal = refusal(&directory);
        assert!(matches!(refusal, CheckpointError::Damaged { .. }), "{n_bytes} bytes: {refusal}");
        let message = refusal.to_string();
        assert!(message.contains("00000002.safetensors\" is damaged"), "{message}");
        assert!(message.contains("00000001.safetensors"), "{message}");
    }
    fs::write(&newest, [whole.as_slice(), b"x"].concat()).expect("writes");
    assert!(matches!(refusal(&directory), CheckpointError::Damaged { .. }), "a byte too many");
}

#[test]
fn a_flipped_bit_anywhere_is_detected() {
    let (directory, _) = saved(1);
    let path = newest(&directory);
    let mut bytes = fs::read(&path).expect("readable");
    let header = 8 + usize::from(u16::from_le_bytes([bytes[0], bytes[1]]));
    let config = small_config();
    let anywhere = (0..header).chain((header..bytes.len()).step_by(97));
    for (n, at) in anywhere.enumerate() {
        bytes[at] ^= 1 << (n % 8);
        assert!(sealed::open(&bytes).is_err(), "bit {} of byte {at}", n % 8);
        bytes[at] ^= 1 << (n % 8);
    }
    fs::write(&path, &bytes).expect("writes");
    assert!(load(&path, &config).is_ok(), "whole again");
}

#[test]
fn every_tensor_is_under_the_seal() {
    let (directory, _) = saved(1);
    let bytes = fs::read(newest(&directory)).expect("readable");
    let (n_header, header) = safetensors::SafeTensors::read_metadata(&bytes).expect("whole");
    let tensors: BTreeMap<_, _> = header.tensors().into_iter().collect();
    for name in
        ["acting.actor", "pending.0.policy.critic", "pending.0.counters", "metrics", "figures"]
    {
        assert!(tensors.contains_key(name), "{name}");
    }
    for (name, info) in tensors {
        let mut flipped = bytes.clone();
        flipped[8 + n_header + info.data_offsets.0] ^= 0x10;
        assert!(matches!(sealed::open(&flipped), Err(Refused::Damaged(_))), "{name}");
    }
}

#[test]
fn another_format_is_refused_by_name() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("00000050.safetensors");
    let write = |header: &str| {
        let bytes = [&(header.len() as u64).to_le_bytes(), header.as_bytes()].concat();
        fs::write(&path, bytes).expect("writes");
        refusal(&directory).to_string()
    };
    let message = write(r#"{"__metadata__":{"round":"50","format":"1"}}"#);
    assert!(message.ends_with(r#"is of format "1", this program reads "3""#), "{message}");
    let message = write(r#"{"__metadata__":{"round":"50","format":"3"}}"#);
    assert!(message.contains("it has no seal"), "{message}");
    let message = write(r#"{"__metadata__":{"round":"50","format":"3","seal":"0"}}"#);
    assert!(message.contains("its seal is misplaced"), "{message}");
    let message = write("{}");
    assert!(message.contains("is damaged"), "{message}");
}

#[test]
fn a_checkpoint_of_another_run_is_refused() {
    let (directory, _) = saved(1);
    let check = |change: fn(&mut RunConfig), what: &str| {
        let mut config = small_config();
        change(&mut config);
        let refusal = load_newest(directory.path(), &config).expect_err("must be refused");
        assert!(matches!(refusal, CheckpointError::OtherRun { .. }), "{refusal}");
        assert!(refusal.to_string().contains(what), "{refusal}");
        assert!(!refusal.to_string().contains("Some("), "{refusal}");
    };
    without_settings(&newest(&directory));
    assert!(!check_settings(directory.path(), &small_config()).expect("no settings"));
    check(|config| config.seed = 2, "seed");
    check(|config| config.arms = 2, "arms");
    check(|config| config.task = "pick-and-place".to_owned(), "task");
    check(|config| config.ddpg.n_hidden = 4, "actor.online");
    check(|config| config.ddpg.n_hidden = 4, "ddpg.n_hidden");
    check(|config| config.replay.capacity_transitions = 50, "replay.capacity_transitions");
    assert_eq!(restored(&directory).trainer.config(), &small_config());
}

/// Makes of a checkpoint one of a program that did not keep the settings in it.
fn without_settings(path: &Path) {
    let mut bytes = fs::read(path).expect("readable");
    let key = b"\"settings\"";
    let at = bytes.windows(key.len()).position(|window| window == key).expect("they are kept");
    bytes[at + 1] = b'x';
    fs::write(path, sealed::reseal(bytes)).expect("writes");
}

#[test]
fn settings_that_affect_learning_must_stay() {
    let (directory, _) = saved(1);
    let check = |change: fn(&mut RunConfig), message: &str| {
        let mut config = small_config();
        change(&mut config);
        let whole = load_newest(directory.path(), &config).expect_err("must be refused");
        let by_header = check_settings(directory.path(), &config).expect_err("must be refused");
        for refusal in [whole, by_header] {
            assert!(matches!(refusal, CheckpointError::OtherSettings { .. }), "{refusal}");
            assert!(refusal.to_string().starts_with(message), "{refusal}");
        }
    };
    check(|c| c.ddpg.n_hidden = 4, "ddpg.n_hidden is 4 here and 3 in the run's checkpoint \"");
    check(|c| c.seed = 2, "seed is 2 here and 1 in the run's checkpoint \"");
    check(|c| c.arms = 2, "arms is 2 here and 1 in");
    check(
        |c| c.task = "pick-and-place".to_owned(),
        "task is \"pick-and-place\" here and \"push\" in",
    );
    check(|c| c.ddpg.discount = 0.5, "ddpg.discount is 0.5 here and 0.95 in");
    let mut longer = small_config();
    longer.stop.max_env_steps += 1;
    longer.checkpoint.keep += 1;
    assert!(check_settings(directory.path(), &longer).expect("fits"));
    assert!(load_newest(directory.path(), &longer).expect("fits").is_some());
}

/// Changes of a file's bytes: each puts a byte somewhere, or cuts.
fn spoiled(whole: Vec<u8>) -> impl Strategy<Value = Vec<u8>> {
    let header = 8 + usize::from(u16::from_le_bytes([whole[0], whole[1]]));
    let change = (any::<bool>(), any::<usize>(), any::<u8>());
    let changes = proptest::collection::vec(change, 1..6);
    (changes, any::<u8>(), any::<usize>()).prop_map(move |(changes, cut, at)| {
        let mut bytes = whole.clone();
        for (in_header, at, byte) in changes {
            let end = if in_header { header } else { bytes.len() };
            bytes[at % end] = byte;
        }
        if cut < 20 {
            bytes.truncate(at % bytes.len());
        }
        bytes
    })
}

/// Loads what is hostile; to be refused or taken, never to panic.
fn load_hostile(name: &str, n_cases: u32, hostile: impl Strategy<Value = Vec<u8>>) {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("00000001.safetensors");
    let config = Config { failure_persistence: None, ..Config::with_cases(n_cases) };
    let outcome = TestRunner::new(config).run(&hostile, |bytes| {
        fs::write(&path, bytes).map_err(|error| TestCaseError::fail(error.to_string()))?;
        if let Ok(Restored { mut trainer, resumption, .. }) = load(&path, &small_config()) {
            // A state that loads can be trained.
            train_with_whatever(&mut trainer);
            drop(save(&directory.path().join("again"), &trainer, &resumption, 1));
        }
        Ok(())
    });
    if let Err(error) = outcome {
        panic!("{name}: {error}");
    }
}

fn train_with_whatever(trainer: &mut Trainer) {
    let round = trainer.counters().round;
    assert!(!trainer.training_orders(round, round).is_empty());
    let episodes = [drifting_episode(&trainer.task, round * 2, 0.01)];
    trainer.ingest(&episodes);
    // Numbers that are not finite make learning diverge, which is an error and not a panic.
    drop(trainer.learn(|_| ()));
}

#[test]
fn no_bytes_make_loading_panic() {
    load_hostile("random", 200, proptest::collection::vec(any::<u8>(), 0..400));
    let lengths = any::<u64>().prop_map(|n| [n.to_le_bytes().as_slice(), b"{\"a\":{}}"].concat());
    load_hostile("header lengths", 100, lengths);
    let (directory, _) = saved(1);
    let whole = fs::read(newest(&directory)).expect("readable");
    load_hostile("altered", 200, spoiled(whole.clone()));
    load_hostile("altered and sealed", 600, spoiled(whole).prop_map(sealed::reseal));
}

#[test]
fn no_number_in_the_metadata_makes_loading_panic() {
    let (directory, _) = saved(1);
    let whole = fs::read(newest(&directory)).expect("readable");
    let (n_header, header) = safetensors::SafeTensors::read_metadata(&whole).expect("whole");
    let text = String::from_utf8(whole[8..8 + n_header].to_vec()).expect("a header");
    for (key, value) in header.metadata().iter().flatten() {
        for hostile in
            ["", "-1", "18446744073709551615", "281474976710656", "1e999", "NaN", "0", "64"]
        {
            let (old, new) = (format!("\"{key}\":\"{value}\""), format!("\"{key}\":\"{hostile}\""));
            let header = text.replace(&old, &new).into_bytes();
            let length = (header.len() as u64).to_le_bytes();
            let bytes = [length.as_slice(), &header, &whole[8 + n_header..]].concat();
            load_hostile_once(&sealed::reseal(bytes));
        }
    }
}

fn load_hostile_once(bytes: &[u8]) {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("00000001.safetensors");
    fs::write(&path, bytes).expect("writes");
    if let Ok(Restored { mut trainer, .. }) = load(&path, &small_config()) {
        train_with_whatever(&mut trainer);
    }
}

#[test]
fn a_failed_write_leaves_the_former_checkpoint() {
    let (directory, mut trainer) = saved(1);
    train_round(&mut trainer);
    // A directory where the unfinished file would go: it can be neither written nor renamed.
    let in_the_way = directory.path().join("00000002.safetensors.tmp");
    fs::create_dir(&in_the_way).expect("creates");
    let refusal = save(directory.path(), &trainer, &resumption(&trainer), 1);
    assert!(matches!(refusal, Err(CheckpointError::Io { action: "write", .. })));
    fs::remove_dir(&in_the_way).expect("removes");
    assert_eq!(restored(&directory).trainer.counters().round, 1);
    save(directory.path(), &trainer, &resumption(&trainer), 1).expect("there is room again");
    assert_eq!(restored(&directory).trainer.counters().round, 2);
}
