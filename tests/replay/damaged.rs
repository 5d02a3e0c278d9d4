//! Logs that are cut or altered.

use std::fs;
use std::path::Path;

use proptest::prelude::{ProptestConfig, any, prop_assert, proptest};
use serde_json::json;
use tandem_core::layout::EPISODE_STEPS;
use tandem_telemetry::{EpisodeLog, read_episode, recover};
use tandem_worker::replay::replay_log;

use crate::recording::{error_line, one_log, summary, tandem};

/// Checks that a damaged log is refused and that its recovery is a prefix of the original. Returns the recovered
/// length.
fn check_damaged(whole: &EpisodeLog, bytes: &[u8], directory: &Path) -> Option<usize> {
    let (damaged, recovered) = (directory.join("damaged.mcap"), directory.join("recovered.mcap"));
    fs::write(&damaged, bytes).expect("written");
    assert!(read_episode(&damaged).is_err(), "{} bytes are accepted as complete", bytes.len());
    let log = recover(&damaged, &recovered).ok().map(|_| read_episode(&recovered))?;
    let Ok(log) = log else { return None };
    assert_eq!(log.metadata, whole.metadata);
    assert!(log.transitions == whole.transitions[..log.transitions.len()]);
    assert!(log.last_observation.is_none() || log.last_observation == whole.last_observation);
    Some(log.transitions.len())
}

#[test]
fn a_log_truncated_anywhere_is_recovered_up_to_the_cut() {
    let keep = tempfile::tempdir().expect("a directory");
    let path = one_log(keep.path());
    let (whole, bytes) = (read_episode(&path).expect("whole"), fs::read(&path).expect("readable"));
    let mut n_before = None;
    for n_bytes in (0..bytes.len()).step_by(37) {
        let n_steps = check_damaged(&whole, &bytes[..n_bytes], keep.path());
        assert!(
            n_steps >= n_before,
            "{n_bytes} bytes give {n_steps:?} steps, fewer gave {n_before:?}"
        );
        if n_steps > n_before && n_steps > Some(0) {
            let log = read_episode(&keep.path().join("recovered.mcap")).expect("whole");
            assert!(replay_log(&log).is_ok(), "{n_bytes} bytes");
            n_before = n_steps;
        }
    }
    assert_eq!(n_before, Some(EPISODE_STEPS));
}

#[test]
fn the_program_refuses_and_recovers_truncated_logs() {
    let keep = tempfile::tempdir().expect("a directory");
    let bytes = fs::read(one_log(keep.path())).expect("readable");
    let (cut, recovered) = (keep.path().join("cut.mcap"), keep.path().join("recovered.mcap"));
    for n_bytes in [0, 7, 8, 100, 3000, bytes.len() / 2, bytes.len() - 1] {
        fs::write(&cut, &bytes[..n_bytes]).expect("written");
        let refused = tandem(&["replay", "--verify"], &[&cut]);
        assert_eq!(refused.status.code(), Some(65), "{n_bytes} bytes");
        assert!(error_line(&refused).contains("cut.mcap"));
        let output = tandem(&["mcap", "recover"], &[&cut, Path::new("--to"), &recovered]);
        // The first message is behind schemas and metadata.
        let has_message = n_bytes > 3000;
        let code = output.status.code();
        assert_eq!(code, Some(if has_message { 0 } else { 65 }), "{n_bytes} bytes");
        assert_eq!(recovered.exists(), has_message);
        if has_message {
            let again = tandem(&["replay", "--json"], &[&recovered]);
            let summary = summary(&again);
            assert_eq!((again.status.code(), &summary["equal"]), (Some(0), &json!(1)), "{summary}");
            fs::remove_file(&recovered).expect("there");
        }
    }
    let left: Vec<_> =
        fs::read_dir(keep.path()).expect("there").flatten().map(|e| e.path()).collect();
    assert!(left.iter().all(|path| path.extension().is_some_and(|e| e == "mcap")), "{left:?}");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 4, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_log_with_altered_bytes_is_refused_and_recovered(
        damages in proptest::collection::vec(
            proptest::collection::vec((any::<usize>(), 1_u8..=255), 1..4), 150,
        ),
    ) {
        let keep = tempfile::tempdir().expect("a directory");
        let path = one_log(keep.path());
        let (whole, bytes) = (read_episode(&path).expect("whole"), fs::read(&path).expect("readable"));
        for damage in damages {
            let mut damaged = bytes.clone();
            for (at, change) in &damage {
                damaged[at % bytes.len()] ^= change;
            }
            prop_assert!(damaged == bytes || check_damaged(&whole, &damaged, keep.path()).is_none_or(|n| n <= EPISODE_STEPS));
        }
    }
}
