//! Reads files and messages that earlier versions wrote. `tests/corpus/README.md` lists them.

mod messages;
mod run;

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;
use tandem_core::{Layout, Task};
use tandem_policy::Policy;
use tandem_report::Run;
use tandem_teacher::budget::Charge;
use tandem_teacher::ledger::{ChargeRequest, Ledger as _, SqliteLedger};
use tandem_telemetry::{read_episode, read_trials, recover};
use tempfile::TempDir;

/// Returns the directories of the corpus, one per version.
fn versions() -> Vec<PathBuf> {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus");
    let entries = fs::read_dir(corpus).expect("the corpus exists");
    let mut versions: Vec<PathBuf> = entries.map(|entry| entry.expect("readable").path()).collect();
    versions.retain(|path| path.is_dir());
    versions.sort();
    assert!(versions.iter().any(|version| version.ends_with("v0.1")), "no corpus of version 0.1");
    versions
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).expect("readable")).expect("JSON")
}

/// Copies a corpus file that will be opened for writing.
fn copy(file: &Path) -> (TempDir, PathBuf) {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join(file.file_name().expect("a file"));
    fs::copy(file, &path).expect("copied");
    (directory, path)
}

/// The actions of the corpus's policies, observation 0.1 and goal 0.2 throughout, by `scripts/check_policy.py` in double
/// precision.
const ACTIONS: [(Task, usize, &[f32]); 4] = [
    (Task::Push, 1, &[-0.978_658, 1.0, -0.997_690]),
    (Task::Push, 2, &[0.999_971, 0.999_992, 0.960_273, 0.950_561, -0.999_918, -0.995_930]),
    (Task::PickAndPlace, 1, &[-0.878_635, 0.999_974, -0.948_191, 0.976_435]),
    (
        Task::PickAndPlace,
        2,
        &[
            0.999_996, 0.999_996, 0.015_032, 0.999_542, -0.999_414, -0.998_682, -0.999_683,
            -0.981_547,
        ],
    ),
];

#[test]
fn policies_are_read() {
    for version in versions() {
        for (task, n_arms, expected) in ACTIONS {
            let path = version.join(format!("policies/{task}-{n_arms}.safetensors"));
            let policy = Policy::load(&path).expect("a policy");
            assert_eq!(policy.layout, Layout::new(task, n_arms).into(), "{path:?}");
            assert_eq!((policy.n_hidden, policy.n_hidden_layers), (8, 1), "{path:?}");
            let mut action = vec![f32::NAN; policy.layout.n_action()];
            let observation = vec![0.1; policy.layout.n_observation()];
            let mut actor = policy.actor().expect("usable");
            actor.act(&observation, &vec![0.2; policy.layout.n_goal()], &mut action);
            assert_eq!(action.len(), expected.len(), "{path:?}");
            let agrees = action.iter().zip(expected).all(|(x, y)| (x - y).abs() < 1e-5);
            assert!(agrees, "{path:?} acts {action:?}, not {expected:?}");
        }
    }
}

#[test]
fn a_ledger_keeps_its_accounts_leases_and_verdicts() {
    for version in versions() {
        let (_directory, path) = copy(&version.join("ledger.sqlite"));
        let mut ledger = SqliteLedger::open(&path).expect("a ledger");
        let mut balance = |name: &str| {
            let balance = ledger.balance(name).expect("an account");
            (balance.terms.strategy.to_string(), balance.spent, balance.leased, balance.left)
        };
        assert_eq!(balance("unleased"), ("mc-q:0.1".to_owned(), 10, 0, 0));
        assert_eq!(balance("leased"), ("eamc:0.25".to_owned(), 25, 45, 930));
        // A charged step is not charged again. The next step is charged to the open lease.
        let charge = |step| Charge {
            episode: 1,
            step,
            wanted_in_first_half: true,
            wanted_in_second_half: true,
        };
        let charges = vec![charge(4), charge(5)];
        let request = ChargeRequest { account: "leased".to_owned(), episode_steps: 50, charges };
        ledger.charge(&[request]).remove(0).expect("charged");
        let balance = ledger.balance("leased").expect("an account");
        assert_eq!((balance.spent, balance.leased, balance.left), (26, 44, 930));
    }
}

#[test]
fn an_episode_log_is_read() {
    for version in versions() {
        let log = read_episode(&version.join("episode.mcap")).expect("an episode");
        let layout = Layout::new(Task::Push, 2);
        assert_eq!((&log.metadata.layout, log.metadata.parameter_version), (&layout.into(), 6));
        assert_eq!(log.metadata.world.get("substeps").map(String::as_str), Some("10"));
        assert_eq!(log.transitions.len(), 50);
        assert!(log.transitions.iter().all(|step| step.observation.len() == 56));
        assert_eq!(log.last_observation.map(|observation| observation.len()), Some(56));
    }
}

#[test]
fn a_truncated_log_is_recovered() {
    for version in versions() {
        let directory = tempfile::tempdir().expect("a directory");
        let recovered = directory.path().join("recovered.mcap");
        let counts = recover(&version.join("cut-short.mcap"), &recovered).expect("recovered");
        assert!(counts.ended_by.is_some() && counts.messages > 0, "{counts:?}");
        let log = read_episode(&recovered).expect("an episode");
        let whole = read_episode(&version.join("episode.mcap")).expect("an episode");
        assert_eq!(log.metadata, whole.metadata);
        assert_eq!(log.transitions, whole.transitions[..log.transitions.len()]);
    }
}

#[test]
fn trials_are_read() {
    for version in versions() {
        let rows = read_trials(&version.join("trials.jsonl")).expect("trials");
        let [row] = rows.as_slice() else { panic!("expected one trial, got {}", rows.len()) };
        assert_eq!((row.mode.as_str(), row.trial, row.success), ("closed-loop", 0, true));
        let directory = tempfile::tempdir().expect("a directory");
        let copy = recover(&version.join("trial.mcap"), &directory.path().join("copy.mcap"));
        let copy = copy.expect("readable");
        assert_eq!((copy.ended_by.as_deref(), copy.metadata_records), (None, 2));
    }
}

#[test]
fn a_report_is_written_from_a_run_directory() {
    for version in versions() {
        let mut warnings = Vec::new();
        let run = Run::load(&version.join("run"), &mut warnings).expect("a run");
        assert!(warnings.is_empty(), "{warnings:?}");
        let env_steps: Vec<u64> = run.rows.iter().map(|row| row.env_steps).collect();
        assert_eq!(env_steps, [200, 400, 600]);
        let settings = run.configuration.expect("settings");
        assert!(settings.text().contains("strategy = \"ea\""));
    }
}
