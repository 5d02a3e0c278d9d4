//! What idle workers note: when slots were taken and delivered, and how long calls took. Pure.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use tonic::Status;

use crate::bench::scale::measures::quantile;
use crate::bench::scale::row::{Calls, Percentiles};

/// What is known of the rounds so far.
#[derive(Debug, Default)]
pub(in crate::bench::scale) struct Book {
    rounds: BTreeMap<u64, Round>,
    n_failed: u64,
    first_failure: Option<String>,
}

#[derive(Debug, Default)]
struct Round {
    slots: BTreeSet<u64>,
    /// When each slot was asked for and had, the first time that it was given.
    taken: Vec<(Duration, Duration)>,
    n_covered: u64,
    fetches: Vec<Duration>,
    deliveries: Vec<Duration>,
    last_delivered: Option<Duration>,
}

impl Book {
    /// Notes that a slot was `(asked for, had)`.
    pub(super) fn take(&mut self, round: u64, slot: u64, times: (Duration, Duration)) {
        let round = self.rounds.entry(round).or_default();
        if round.slots.insert(slot) {
            round.taken.push(times);
        } else {
            round.n_covered += 1;
        }
    }

    pub(super) fn fetched(&mut self, round: u64, took: Duration) {
        self.rounds.entry(round).or_default().fetches.push(took);
    }

    /// Notes that a slot was `(sent, acknowledged)`.
    pub(super) fn deliver(&mut self, round: u64, (sent, acknowledged): (Duration, Duration)) {
        let round = self.rounds.entry(round).or_default();
        round.deliveries.push(acknowledged.saturating_sub(sent));
        round.last_delivered = Some(acknowledged);
    }

    pub(super) fn fail(&mut self, status: &Status) {
        self.n_failed += 1;
        self.first_failure.get_or_insert_with(|| status.message().to_owned());
    }

    /// What the first call that failed was told.
    pub(in crate::bench::scale) fn first_failure(&self) -> Option<&str> {
        self.first_failure.as_deref()
    }

    /// Calls that failed so far.
    pub(in crate::bench::scale) const fn n_failed(&self) -> u64 {
        self.n_failed
    }

    /// When the first slot of each round from `first` to `last` was had.
    pub(in crate::bench::scale) fn began(&self, first: u64, last: u64) -> Vec<Duration> {
        self.rounds.range(first..=last).filter_map(|(_, round)| round.began()).collect()
    }

    /// The calls of the rounds from `first` to before `end`.
    pub(in crate::bench::scale) fn calls(&self, first: u64, end: u64) -> Calls {
        let (mut assignments, mut fetches, mut deliveries) = (Vec::new(), Vec::new(), Vec::new());
        let mut n_covered = 0;
        for (number, round) in self.rounds.range(first..end) {
            let available = self.available(*number);
            let had = |(asked, answered): &(Duration, Duration)| {
                answered.saturating_sub((*asked).max(available))
            };
            assignments.extend(round.taken.iter().map(had));
            fetches.extend_from_slice(&round.fetches);
            deliveries.extend_from_slice(&round.deliveries);
            n_covered += round.n_covered;
        }
        Calls {
            assignment: percentiles(&mut assignments),
            parameters: percentiles(&mut fetches),
            delivery: percentiles(&mut deliveries),
            n_failed: self.n_failed,
            n_covered,
        }
    }

    /// Since when the slots of a round can be had: since the round before is in, as the learner then opens the next,
    /// and in any case since the first one was had.
    fn available(&self, number: u64) -> Duration {
        let began = self.rounds.get(&number).and_then(Round::began).unwrap_or_default();
        let before = number.checked_sub(1).and_then(|before| self.rounds.get(&before));
        let was_in = before.and_then(|round| round.last_delivered);
        was_in.map_or(began, |was_in| was_in.min(began))
    }
}

impl Round {
    fn began(&self) -> Option<Duration> {
        self.taken.iter().map(|(_, answered)| *answered).min()
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
    fn two_rounds() -> Book {
        let mut book = Book::default();
        book.take(0, 0, (ms(0), ms(10)));
        book.take(0, 1, (ms(0), ms(12)));
        book.deliver(0, (ms(100), ms(104)));
        book.deliver(0, (ms(100), ms(110)));
        book.take(1, 2, (ms(104), ms(115)));
        book.take(1, 3, (ms(112), ms(130)));
        book
    }

    #[test]
    fn an_assignment_counts_from_when_a_slot_was_there_and_asked_for() {
        let calls = two_rounds().calls(1, 2);
        // The first had asked before the slot was there, the second after.
        assert_eq!((calls.assignment.p50, calls.assignment.p99), (ms(5), ms(18)));
    }

    #[test]
    fn a_round_begins_when_its_first_slot_is_had() {
        assert_eq!(two_rounds().began(0, 1), [ms(10), ms(115)]);
        assert_eq!(two_rounds().began(1, 7), [ms(115)]);
    }

    #[test]
    fn a_slot_that_is_given_again_counts_as_covered_and_not_as_slow() {
        let mut book = two_rounds();
        book.take(1, 3, (ms(200), ms(3000)));
        let calls = book.calls(1, 2);
        assert_eq!((calls.n_covered, calls.assignment.p99), (1, ms(18)));
    }

    #[test]
    fn deliveries_of_other_rounds_do_not_count() {
        let calls = two_rounds().calls(0, 1);
        assert_eq!((calls.delivery.p50, calls.delivery.p99), (ms(4), ms(10)));
        assert_eq!(two_rounds().calls(1, 2).delivery.p99, ms(0));
    }
}
