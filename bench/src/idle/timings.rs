//! Timings of the calls of idle workers. Pure.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use tonic::Status;

/// Latencies of calls, and counts of failures.
#[derive(Debug, Clone, Default)]
pub struct Calls {
    /// From the moment at which a slot was available and requested until it was assigned.
    pub assignment: Percentiles,
    /// Of fetches of parameters.
    pub parameters: Percentiles,
    /// Of deliveries of episodes.
    pub delivery: Percentiles,
    /// Failed calls, which were repeated.
    pub n_failed: u64,
    /// Slots that were assigned to a second worker.
    pub n_reassigned: u64,
}

/// The median and the 99th percentile of time spans.
#[derive(Debug, Clone, Copy, Default)]
pub struct Percentiles {
    /// The median.
    pub p50: Duration,
    /// The 99th percentile.
    pub p99: Duration,
}

/// Timings by round.
#[derive(Debug, Default)]
pub struct LoadTimings {
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
    pub fn record_assignment(&mut self, round: u64, slot: u64, times: (Duration, Duration)) {
        let round = self.rounds.entry(round).or_default();
        if round.slots.insert(slot) {
            round.assignments.push(times);
        } else {
            round.n_reassigned += 1;
        }
    }

    /// Records how long a fetch of parameters took.
    pub fn record_fetch(&mut self, round: u64, took: Duration) {
        self.rounds.entry(round).or_default().fetches.push(took);
    }

    /// Records when a slot was `(sent, acknowledged)`.
    pub fn record_delivery(&mut self, round: u64, (sent, acknowledged): (Duration, Duration)) {
        let round = self.rounds.entry(round).or_default();
        round.deliveries.push(acknowledged.saturating_sub(sent));
        round.last_delivered = Some(acknowledged);
    }

    /// Records a failed call.
    pub fn record_failure(&mut self, status: &Status) {
        self.n_failed += 1;
        self.first_failure.get_or_insert_with(|| status.message().to_owned());
    }

    /// Returns the message of the first failed call.
    pub fn first_failure(&self) -> Option<&str> {
        self.first_failure.as_deref()
    }

    /// Returns the number of failed calls.
    pub const fn n_failed(&self) -> u64 {
        self.n_failed
    }

    /// Returns when the first slot of each round from `first` to `last` was assigned.
    pub fn round_starts(&self, first: u64, last: u64) -> Vec<Duration> {
        self.rounds.range(first..=last).filter_map(|(_, round)| round.start()).collect()
    }

    /// Summarizes the calls of the rounds from `first` to before `end`.
    pub fn calls(&self, first: u64, end: u64) -> Calls {
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

/// Returns the quantile `share` of `times`; 0 if there are none.
pub fn quantile(times: &mut [Duration], share: f64) -> Duration {
    times.sort_unstable();
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "an index below the number of times"
    )]
    let rank = (times.len() as f64 * share).ceil() as usize;
    times.get(rank.saturating_sub(1)).copied().unwrap_or_default()
}
