//! Timings of the calls of idle workers. Pure.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use tonic::Status;

use crate::bench::scale::measures::quantile;
use crate::bench::scale::row::{Calls, Percentiles};

/// Timings by round.
#[derive(Debug, Default)]
pub(in crate::bench::scale) struct LoadTimings {
    rounds: BTreeMap<u64, Round>,
    n_failed: u64,
    first_failure: Option<String>,
}

#[derive(Debug, Default)]
struct Round {
    slots: BTreeSet<u64>,
    /// When each slot was requested and assigned for the first time.
    assignments: Vec<(Duration, Duration)>,
    n_reassigned: u64,
    fetches: Vec<Duration>,
    deliveries: Vec<Duration>,
    last_delivered: Option<Duration>,
}

impl LoadTimings {
    /// Records when a slot was `(requested, assigned)`.
    pub(super) fn record_assignment(&mut self, round: u64, slot: u64, times: (Duration, Duration)) {
        let round = self.rounds.entry(round).or_default();
        if round.slots.insert(slot) {
            round.assignments.push(times);
        } else {
            round.n_reassigned += 1;
        }
    }

    /// Records how long a fetch of parameters took.
    pub(super) fn record_fetch(&mut self, round: u64, took: Duration) {
        self.rounds.entry(round).or_default().fetches.push(took);
    }

    /// Records when a slot was `(sent, acknowledged)`.
    pub(super) fn record_delivery(
        &mut self,
        round: u64,
        (sent, acknowledged): (Duration, Duration),
    ) {
        let round = self.rounds.entry(round).or_default();
        round.deliveries.push(acknowledged.saturating_sub(sent));
        round.last_delivered = Some(acknowledged);
    }

    /// Records a failed call.
    pub(super) fn record_failure(&mut self, status: &Status) {
        self.n_failed += 1;
        self.first_failure.get_or_insert_with(|| status.message().to_owned());
    }

    /// Returns the message of the first failed call.
    pub(in crate::bench::scale) fn first_failure(&self) -> Option<&str> {
        self.first_failure.as_deref()
    }

    /// Returns the number of failed calls.
    pub(in crate::bench::scale) const fn n_failed(&self) -> u64 {
        self.n_failed
    }

    /// Returns when the first slot of each round from `first` to `last` was assigned.
    pub(in crate::bench::scale) fn round_starts(&self, first: u64, last: u64) -> Vec<Duration> {
        self.rounds.range(first..=last).filter_map(|(_, round)| round.start()).collect()
    }

    /// Summarizes the calls of the rounds from `first` to before `end`.
    pub(in crate::bench::scale) fn calls(&self, first: u64, end: u64) -> Calls {
        let (mut assignments, mut fetches, mut deliveries) = (Vec::new(), Vec::new(), Vec::new());
        let mut n_reassigned = 0;
        for (number, round) in self.rounds.range(first..end) {
            let available = self.available(*number);
            let latency = |(requested, answered): &(Duration, Duration)| {
                answered.saturating_sub((*requested).max(available))
            };
            assignments.extend(round.assignments.iter().map(latency));
            fetches.extend_from_slice(&round.fetches);
            deliveries.extend_from_slice(&round.deliveries);
            n_reassigned += round.n_reassigned;
        }
        Calls {
            assignment: percentiles(&mut assignments),
            parameters: percentiles(&mut fetches),
            delivery: percentiles(&mut deliveries),
            n_failed: self.n_failed,
            n_reassigned,
        }
    }

    /// Returns when the slots of a round became available: at the last delivery of the previous round, after which the
    /// learner opens the next one, or at the latest when the first slot was assigned.
    fn available(&self, number: u64) -> Duration {
        let start = self.rounds.get(&number).and_then(Round::start).unwrap_or_default();
        let before = number.checked_sub(1).and_then(|before| self.rounds.get(&before));
        let was_in = before.and_then(|round| round.last_delivered);
        was_in.map_or(start, |was_in| was_in.min(start))
    }
}

impl Round {
    fn start(&self) -> Option<Duration> {
        self.assignments.iter().map(|(_, answered)| *answered).min()
    }
}

fn percentiles(times: &mut [Duration]) -> Percentiles {
    Percentiles { p50: quantile(times, 0.5), p99: quantile(times, 0.99) }
}

#[cfg(test)]
mod tests {
    use super::*;

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
}
