//! Reads files and messages that earlier versions wrote. `tests/corpus/README.md` lists them.

mod messages;
mod run;

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use tandem_core::{Layout, Task};
use tandem_policy::Policy;
use tandem_report::Run;
use tandem_teacher::budget::{BudgetHalves, Charge};
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

fn read_json(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).expect("readable")).expect("JSON")
}

/// Returns what the files of a version contain.
fn expected(version: &Path) -> Value {
    read_json(&version.join("expected.json"))
}

/// Copies a corpus file that will be opened for writing.
fn copy(file: &Path) -> (TempDir, PathBuf) {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join(file.file_name().expect("a file"));
    fs::copy(file, &path).expect("copied");
    (directory, path)
}

/// The policies of a version, by task and number of arms.
const POLICIES: [(Task, usize); 4] =
    [(Task::Push, 1), (Task::Push, 2), (Task::PickAndPlace, 1), (Task::PickAndPlace, 2)];

#[test]
fn policies_are_read() {
    for version in versions() {
        let actions = &expected(&version)["actions"];
        for (task, n_arms) in POLICIES {
            let path = version.join(format!("policies/{task}-{n_arms}.safetensors"));
            let policy = Policy::load(&path).expect("a policy");
            assert_eq!(policy.task, Layout::new(task, n_arms).into(), "{path:?}");
            assert_eq!((policy.n_hidden, policy.n_hidden_layers), (8, 1), "{path:?}");
            let mut action = vec![f32::NAN; policy.task.n_action()];
            let observation = vec![0.1; policy.task.n_observation()];
            let mut actor = policy.actor().expect("usable");
            actor.act(&observation, &vec![0.2; policy.task.n_goal()], &mut action);
            let expected = actions[format!("{task}-{n_arms}")].clone();
            let expected: Vec<f64> = serde_json::from_value(expected).expect("numbers");
            assert_eq!(action.len(), expected.len(), "{path:?}");
            let mut pairs = action.iter().zip(&expected);
            let agrees = pairs.all(|(x, y)| (f64::from(*x) - y).abs() < 1e-5);
            assert!(agrees, "{path:?} acts {action:?}, not {expected:?}");
        }
    }
}

#[test]
fn a_ledger_keeps_its_accounts_leases_and_verdicts() {
    for version in versions() {
        let accounts = &expected(&version)["accounts"];
        let (_directory, path) = copy(&version.join("ledger.sqlite"));
        let mut ledger = SqliteLedger::open(&path).expect("a ledger");
        for name in ["unleased", "leased"] {
            let balance = ledger.balance(name).expect("an account");
            let strategy = balance.terms.strategy.to_string();
            let (spent, leased, left) = (balance.spent, balance.leased, balance.left);
            let found =
                json!({ "strategy": strategy, "spent": spent, "leased": leased, "left": left });
            assert_eq!(found, accounts[name], "{name}");
        }
        // A charged step is not charged again. The next step is charged to the open lease.
        let charge = |step| Charge { episode: 1, step, wanted_in: BudgetHalves::BOTH };
        let charges = vec![charge(4), charge(5)];
        let balance = ledger.balance("leased").expect("an account");
        let request = ChargeRequest {
            account: "leased".to_owned(),
            strategy: balance.terms.strategy,
            episode_steps: 50,
            charges,
        };
        ledger.charge(&[request]).remove(0).expect("charged");
        let balance = ledger.balance("leased").expect("an account");
        let former = |key: &str| accounts["leased"][key].as_u64().expect("units");
        let charged = (former("spent") + 1, former("leased") - 1, former("left"));
        assert_eq!((balance.spent, balance.leased, balance.left), charged);
    }
}

#[test]
fn an_episode_log_is_read() {
    for version in versions() {
        let expected = &expected(&version)["episode"];
        let log = read_episode(&version.join("episode.mcap")).expect("an episode");
        assert_eq!(log.metadata.task, Layout::new(Task::Push, 2).into());
        assert_eq!(log.metadata.parameter_version, expected["parameter_version"]);
        assert_eq!(log.metadata.world["substeps"], expected["substeps"]);
        assert_eq!(log.transitions.len(), expected["n_transitions"]);
        let n_observation = &expected["n_observation"];
        assert!(log.transitions.iter().all(|step| step.observation.len() == *n_observation));
        assert_eq!(log.last_observation.expect("an observation").len(), *n_observation);
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
        let expected = &expected(&version)["trial"];
        let rows = read_trials(&version.join("trials.jsonl")).expect("trials");
        let [row] = rows.as_slice() else { panic!("expected one trial, got {}", rows.len()) };
        assert_eq!(row.trial, 0);
        assert_eq!(row.mode, expected["mode"]);
        assert_eq!(row.success, expected["success"]);
        let directory = tempfile::tempdir().expect("a directory");
        let copy = recover(&version.join("trial.mcap"), &directory.path().join("copy.mcap"));
        let copy = copy.expect("readable");
        assert_eq!(copy.ended_by, None);
        assert_eq!(copy.metadata_records, expected["metadata_records"]);
    }
}

#[test]
fn a_report_is_written_from_a_run_directory() {
    for version in versions() {
        let mut warnings = Vec::new();
        let run = Run::load(&version.join("run"), &mut warnings).expect("a run");
        assert!(warnings.is_empty(), "{warnings:?}");
        let env_steps: Vec<u64> = run.rows.iter().map(|row| row.env_steps).collect();
        assert_eq!(json!(env_steps), expected(&version)["run"]["evaluated_env_steps"]);
        let settings = run.configuration.expect("settings");
        assert!(settings.text().contains("strategy = \"ea\""));
    }
}
