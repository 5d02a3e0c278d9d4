//! Runs and teachers on a disk that tears writes, returns errors and loses power.

mod device;
mod run;
mod teacher;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};

use device::{ENOSPC, Fault, Mode};
use run::{UNDISTURBED, check, check_unsaved};

/// Returns a fault for each pattern of `hits`, at the given percentage of the calls that match it.
fn faults(mode: Mode, hits: &[(&str, usize)]) -> Vec<Fault> {
    let fault = |(pattern, percent): &(&str, usize)| {
        let n_calls = UNDISTURBED.1.iter().filter(|call| call.contains(pattern)).count();
        assert!(n_calls > 0, "no call matches {pattern:?}");
        Fault::new(mode, (n_calls * percent).div_ceil(100).max(1), pattern)
    };
    hits.iter().map(fault).collect()
}

#[test]
fn a_run_survives_calls_that_fail_once() {
    let hits = [
        ("fsync run/checkpoint/#.safetensors.tmp", 50),
        ("pwrite run/ledger.sqlite-wal", 60),
        ("write run/metrics.jsonl", 50),
    ];
    faults(Mode::Once, &hits).iter().for_each(check);
}

#[test]
fn a_run_reports_a_dead_disk_and_resumes_on_another() {
    let hits =
        [("write run/checkpoint/#.safetensors.tmp", 50), ("pwrite run/ledger.sqlite-wal", 30)];
    faults(Mode::Dead, &hits).iter().for_each(check);
    let full = faults(Mode::Dead, &[("write run/policy/last", 50)]).remove(0);
    check(&Fault { errno: ENOSPC, ..full });
}

#[test]
fn an_interrupted_run_that_cannot_save_says_so() {
    let hits = [("write run/checkpoint/#.safetensors.tmp", 50)];
    faults(Mode::Dead, &hits).iter().for_each(check_unsaved);
}

#[test]
fn a_run_survives_processes_killed_during_a_write() {
    let hits =
        [("write run/checkpoint/#.safetensors.tmp", 70), ("pwrite run/ledger.sqlite-wal", 40)];
    faults(Mode::Kill, &hits).iter().for_each(check);
}

#[test]
fn a_run_is_resumed_after_a_power_cut() {
    let hits = [
        ("rename run/run.toml", 100),
        ("pwrite run/ledger.sqlite-wal", 50),
        ("rename run/checkpoint/", 60),
    ];
    faults(Mode::Cut, &hits).iter().for_each(check);
}

/// Faults at calls of every kind in every mode. `TANDEM_DISK_SWEEP` lists the modes and the number of calls of each
/// kind. 0 means every call, which takes a day:
///
/// ```text
/// TANDEM_DISK_SWEEP=once,dead,kill,cut:0 cargo test --release --test disk -- --ignored --nocapture
/// ```
#[test]
#[ignore = "takes minutes to hours"]
fn every_call_of_a_run_may_fail() {
    #[expect(clippy::disallowed_methods, reason = "configures this test")]
    let part = std::env::var("TANDEM_DISK_SWEEP").unwrap_or("once,dead,kill,cut:1".to_owned());
    let (modes, n_hits) = part.split_once(':').expect("MODES:COUNT");
    let n_hits = n_hits.parse().expect("a number");
    let modes = [Mode::Once, Mode::Dead, Mode::Kill, Mode::Cut]
        .into_iter()
        .filter(|mode| modes.split(',').any(|name| name == mode.name()));
    let faults: Vec<Fault> = modes.flat_map(|mode| sweep(mode, n_hits)).collect();
    let next = AtomicUsize::new(0);
    let failed = AtomicUsize::new(0);
    let work = || {
        while let Some(fault) = faults.get(next.fetch_add(1, Ordering::Relaxed)) {
            match std::panic::catch_unwind(|| check(fault)) {
                Ok(()) => println!("survived: {fault}"),
                Err(_) => {
                    println!("FAILED: {fault}");
                    failed.fetch_add(1, Ordering::Relaxed);
                }
            }
        }
    };
    std::thread::scope(|scope| (0..3).for_each(|_| drop(scope.spawn(work))));
    assert_eq!(failed.into_inner(), 0, "of {} faults", faults.len());
}

/// Returns faults at `n_hits` evenly spaced calls of every kind, or at every call if `n_hits` is 0.
fn sweep(mode: Mode, n_hits: usize) -> Vec<Fault> {
    let mut kinds: BTreeMap<&str, usize> = BTreeMap::new();
    UNDISTURBED.1.iter().for_each(|call| *kinds.entry(call).or_default() += 1);
    let hits = |(kind, n_calls): (&&str, &usize)| {
        let n_hits = if n_hits == 0 { *n_calls } else { n_hits.min(*n_calls) };
        let at = |hit: usize| (hit * 2 + 1) * n_calls / (n_hits * 2) + 1;
        (0..n_hits).map(|hit| Fault::new(mode, at(hit), kind)).collect::<Vec<_>>()
    };
    kinds.iter().flat_map(hits).collect()
}
