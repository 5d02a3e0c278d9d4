//! A full disk: the ledger refuses what it cannot write, and works again once there is room.

use std::fs;
use std::path::PathBuf;
use std::process::{Command, Stdio};

use tandem_teacher::ledger::{Ledger as _, LedgerError, MemoryLedger, SqliteLedger};
use tempfile::TempDir;

use crate::ledger_tests::fixture::{BOTH, NEITHER, charge, request, terms};
use crate::skipped::skip;

/// A disk of 1 MiB.
struct SmallDisk {
    directory: TempDir,
}

impl SmallDisk {
    /// Returns `None` if the process may not mount a disk.
    fn mount() -> Option<Self> {
        let directory = tempfile::tempdir().expect("a directory");
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", "size=1m", "none"])
            .arg(directory.path())
            .stderr(Stdio::null())
            .status();
        mounted.is_ok_and(|status| status.success()).then_some(Self { directory })
    }

    fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let unmounted = Command::new("umount").arg("-l").arg(self.directory.path()).status();
        assert!(unmounted.is_ok_and(|status| status.success()), "unmounted");
    }
}

#[test]
fn a_full_disk_makes_the_ledger_unavailable_until_there_is_room() {
    let Some(disk) = SmallDisk::mount() else {
        skip("MOUNTS", "a ledger on a full disk: this process may not mount a disk");
        return;
    };
    fs::write(disk.path("filler"), vec![0x5A; 600 << 10]).expect("written");
    let mut ledger = SqliteLedger::open(&disk.path("ledger.sqlite")).expect("a ledger");
    let mut model = MemoryLedger::default();
    for ledger in [&mut ledger as &mut dyn tandem_teacher::ledger::Ledger, &mut model] {
        ledger.open("run", terms(1_000_000)).expect("an account");
        ledger.open_leases("run", &[0, 1], 20).expect("leases");
    }
    let request_for =
        |episode: u64| request("run", &[charge(episode, 1, BOTH), charge(episode, 2, BOTH)]);
    let mut episode = 0;
    let refused = loop {
        match ledger.charge(&[request_for(episode)]).remove(0) {
            Ok(result) => {
                let expected = model.charge(&[request_for(episode)]).remove(0).expect("paid");
                assert_eq!(result, expected);
            }
            Err(error) => break error,
        }
        episode += 1;
        assert!(episode < 10_000, "the disk is never full");
    };
    assert!(matches!(refused, LedgerError::Unavailable { .. }), "{refused}");
    assert!(refused.to_string().contains("full"), "{refused}");
    for attempt in 0..3 {
        let unpaid = ledger.charge(&[request_for(episode), request_for(episode + attempt)]);
        assert!(unpaid.iter().all(Result::is_err), "{unpaid:?}");
        assert_eq!(ledger.balance("run").expect("known"), model.balance("run").expect("known"));
    }
    // Verdicts from before are still returned.
    let known =
        ledger.charge(&[request("run", &[charge(0, 1, NEITHER)])]).remove(0).expect("known");
    assert_eq!(known.verdicts, [crate::ledger_tests::fixture::FIRST]);

    fs::remove_file(disk.path("filler")).expect("room");
    for ledger in [&mut ledger as &mut dyn tandem_teacher::ledger::Ledger, &mut model] {
        ledger.settle("run", &[0]).expect("settled");
        ledger.open_leases("run", &[2_000_000], 20).expect("leases");
        // If the refused request had left a verdict, these steps would not be charged.
        let result = ledger.charge(&[request_for(episode)]).remove(0).expect("paid");
        assert_eq!(result.verdicts, [crate::ledger_tests::fixture::FIRST; 2]);
    }
    let expected = model.balance("run").expect("known");
    assert_eq!(ledger.balance("run").expect("known"), expected);
    drop(ledger);
    let mut again = SqliteLedger::open(&disk.path("ledger.sqlite")).expect("a sound ledger");
    assert_eq!(again.balance("run").expect("known"), expected);
    for episode in 0..=episode {
        let result = again.charge(&[request_for(episode)]).remove(0).expect("known");
        assert_eq!(result, model.charge(&[request_for(episode)]).remove(0).expect("known"));
    }
    assert_eq!(again.balance("run").expect("known"), expected);
}
