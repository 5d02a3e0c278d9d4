//! Statistics of the calls of idle workers, and what is measured.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tandem_bench::rates::{sim, thread_counts};
use tandem_bench::{Clock, LoadTimings, quantile};

fn ms(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

/// Two workers, two rounds; the second round's slots can be had from 110 ms on.
fn two_rounds() -> LoadTimings {
    let mut timings = LoadTimings::default();
    timings.record_assignment(0, 0, (ms(0), ms(10)));
    timings.record_assignment(0, 1, (ms(0), ms(12)));
    timings.record_delivery(0, (ms(100), ms(104)));
    timings.record_delivery(0, (ms(100), ms(110)));
    timings.record_assignment(1, 2, (ms(104), ms(115)));
    timings.record_assignment(1, 3, (ms(112), ms(130)));
    timings
}

#[test]
fn an_assignment_counts_from_when_a_slot_was_there_and_asked_for() {
    let calls = two_rounds().calls(1, 2);
    // The first had asked before the slot was there, the second after.
    assert_eq!((calls.assignment.p50, calls.assignment.p99), (ms(5), ms(18)));
}

#[test]
fn a_round_begins_when_its_first_slot_is_had() {
    assert_eq!(two_rounds().round_starts(0, 1), [ms(10), ms(115)]);
    assert_eq!(two_rounds().round_starts(1, 7), [ms(115)]);
}

#[test]
fn a_slot_that_is_given_again_counts_as_covered_and_not_as_slow() {
    let mut timings = two_rounds();
    timings.record_assignment(1, 3, (ms(200), ms(3000)));
    let calls = timings.calls(1, 2);
    assert_eq!((calls.n_reassigned, calls.assignment.p99), (1, ms(18)));
}

#[test]
fn deliveries_of_other_rounds_do_not_count() {
    let calls = two_rounds().calls(0, 1);
    assert_eq!((calls.delivery.p50, calls.delivery.p99), (ms(4), ms(10)));
    assert_eq!(two_rounds().calls(1, 2).delivery.p99, ms(0));
}

#[test]
fn a_quantile_is_one_of_the_times() {
    let check = |times: &[u64], share, expected| {
        let mut durations: Vec<Duration> = times.iter().copied().map(ms).collect();
        assert_eq!(quantile(&mut durations, share), ms(expected), "{share} of {times:?}");
    };
    check(&[], 0.5, 0);
    check(&[7], 0.5, 7);
    check(&[7], 0.99, 7);
    check(&[30, 10, 20], 0.5, 20);
    check(&[40, 10, 30, 20], 0.5, 20);
    check(&(1..=100).rev().collect::<Vec<_>>(), 0.99, 99);
    check(&(1..=100).collect::<Vec<_>>(), 1.0, 100);
}

#[test]
fn thread_counts_double_up_to_the_number_of_cores() {
    let counts = |n_cores| thread_counts(n_cores).collect::<Vec<_>>();
    assert!(counts(1).is_empty());
    assert_eq!(counts(2), [2]);
    assert_eq!(counts(6), [2, 4, 6]);
    assert_eq!(counts(16), [2, 4, 8, 16]);
}

#[test]
fn every_task_is_simulated_with_every_number_of_arms_it_takes() {
    let seconds = AtomicU64::new(0);
    let clock: Clock =
        Arc::new(move || Duration::from_secs(seconds.fetch_add(1, Ordering::Relaxed)));
    let names: Vec<String> = sim(&clock).unwrap().into_iter().map(|figure| figure.name).collect();
    for name in ["push/1-arm", "push/2-arm", "shared-push/2-arm", "carry-bar/2-arm"] {
        assert!(names.contains(&format!("sim/{name}")), "{names:?}");
    }
    assert!(!names.contains(&"sim/carry-bar/1-arm".to_owned()), "a bar takes two arms");
}
