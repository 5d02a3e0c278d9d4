//! The time of a charge. Run with
//! `cargo test --release --workspace --test services ledger_tests::speed -- --ignored --nocapture`.

use std::time::Instant;

use tandem_teacher::ledger::{ChargeRequest, Ledger, SqliteLedger};

use crate::ledger_tests::fixture::{BOTH, TestLedger, charge, request, terms};

/// Requests of one call, as of sixteen workers.
const N_REQUESTS: u64 = 16;

#[expect(clippy::disallowed_methods, reason = "a measurement")]
fn now() -> Instant {
    Instant::now()
}

/// 50 steps of 10,000 leased episodes, or fewer.
fn measure(name: &str, ledger: &mut dyn Ledger, n_episodes: u64) {
    ledger.open("run", terms(1_000_000)).expect("an account");
    let (mut charging, mut leasing, mut slowest_us, mut n_requests) = (0.0, 0.0, 0, 0_u32);
    let mut calls_us = Vec::new();
    for round in 0..n_episodes / (2 * N_REQUESTS) {
        let episodes: Vec<u64> =
            (0..2 * N_REQUESTS).map(|idx| round * 2 * N_REQUESTS + idx).collect();
        let start = now();
        ledger.open_leases("run", &episodes, 50).expect("leases");
        leasing += start.elapsed().as_secs_f64();
        for step in 0..50 {
            let pair = |pair: &[u64]| {
                let charges: Vec<_> = pair.iter().map(|e| charge(*e, step, BOTH)).collect();
                request("run", &charges)
            };
            let requests: Vec<ChargeRequest> = episodes.chunks(2).map(pair).collect();
            let start = now();
            let outcomes = ledger.charge(&requests);
            let took = start.elapsed();
            assert!(outcomes.iter().all(Result::is_ok));
            charging += took.as_secs_f64();
            calls_us.push(took.as_micros());
            slowest_us = slowest_us.max(took.as_micros());
            n_requests += 16;
        }
        let start = now();
        ledger.settle("run", &episodes).expect("settled");
        leasing += start.elapsed().as_secs_f64();
    }
    calls_us.sort_unstable();
    let at = |share: usize| calls_us[calls_us.len() * share / 100];
    println!(
        "{name}: {:.1} us a request of 2 steps, a call of 16 p50 {} p99 {} max {slowest_us} us; a round's leases and settlement {:.0} us",
        charging * 1e6 / f64::from(n_requests),
        at(50),
        at(99),
        leasing * 1e6 / f64::from(n_requests) * 16.0 * 50.0,
    );
}

#[test]
#[ignore = "a measurement"]
fn a_request() {
    measure("memory", TestLedger::memory().ledger(), 10_016);
    measure("sqlite", TestLedger::sqlite().ledger(), 10_016);
    if let Some(mut fixture) = TestLedger::redis() {
        measure("redis", fixture.ledger(), 1_600);
    }
}

/// One request in each call: a single client, which waits for every answer.
fn measure_alone(name: &str, ledger: &mut dyn Ledger) {
    ledger.open("alone", terms(1_000_000)).expect("an account");
    let mut calls_us = Vec::new();
    for first in (0..4_000).step_by(2) {
        ledger.open_leases("alone", &[first, first + 1], 5).expect("leases");
        for step in 0..5 {
            let requests =
                [request("alone", &[charge(first, step, BOTH), charge(first + 1, step, BOTH)])];
            let start = now();
            let outcomes = ledger.charge(&requests);
            calls_us.push(start.elapsed().as_micros());
            assert!(outcomes.iter().all(Result::is_ok));
        }
    }
    calls_us.sort_unstable();
    let at = |share: usize| calls_us[calls_us.len() * share / 100];
    println!("{name}: a call with 1 request of 2 steps p50 {} p99 {} us", at(50), at(99));
}

#[test]
#[ignore = "a measurement"]
fn a_request_alone() {
    measure_alone("memory", TestLedger::memory().ledger());
    measure_alone("sqlite", TestLedger::sqlite().ledger());
    if let Some(mut fixture) = TestLedger::redis() {
        measure_alone("redis", fixture.ledger());
    }
}

#[test]
#[ignore = "a measurement"]
fn a_file_with_100_000_episodes() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("ledger.sqlite");
    let size = || std::fs::metadata(&path).expect("a file").len() / 1024;
    let mut ledger = SqliteLedger::open(&path).expect("a ledger");
    measure("sqlite", &mut ledger, 10_016);
    drop(ledger);
    println!("10,016 episodes, 500,800 charges: {} KiB", size());
    let mut ledger = SqliteLedger::open(&path).expect("a ledger");
    for first in (20_000..120_000).step_by(1_000) {
        let charges: Vec<_> = (first..first + 1_000).map(|e| charge(e, 1, BOTH)).collect();
        let episodes: Vec<u64> = charges.iter().map(|charge| charge.episode).collect();
        ledger.open_leases("run", &episodes, 3).expect("leases");
        ledger.charge(&[request("run", &charges)]).remove(0).expect("paid");
    }
    drop(ledger);
    let start = now();
    drop(SqliteLedger::open(&path).expect("a ledger"));
    println!(
        "110,016 episodes, {} KiB: opened in {:.0} ms",
        size(),
        start.elapsed().as_secs_f64() * 1e3
    );
}
