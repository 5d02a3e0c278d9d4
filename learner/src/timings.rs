//! Durations of the learning thread's work.

use std::time::Duration;

use tandem_net::Metrics;
use tandem_net::metrics::{Counter, DURATION_BUCKETS_S, Histogram, LATENCY_BUCKETS_S};

/// The durations of rounds and their parts.
#[derive(Debug, Clone)]
pub(crate) struct Timings {
    metrics: Metrics,
    pub(crate) round_seconds: Histogram,
    pub(crate) collect_seconds: Histogram,
    pub(crate) update_seconds: Histogram,
    pub(crate) checkpoint_seconds: Histogram,
    pub(crate) checkpoint_failures: Counter,
}

impl Timings {
    /// Registers the metrics.
    pub(crate) fn register(metrics: &Metrics) -> Self {
        let histogram = |name, help, buckets: &[f64]| metrics.histogram(name, help, buckets);
        let round = "Time from the start of the wait for a round's episodes until the next round is ordered";
        let collect = "Time for which a round waited for its episodes";
        let update = "Time of one update of the networks";
        let checkpoint = "Time in which a checkpoint was written";
        let failures = "Checkpoints that could not be written";
        Self {
            round_seconds: histogram("round_seconds", round, &DURATION_BUCKETS_S),
            collect_seconds: histogram("collect_seconds", collect, &DURATION_BUCKETS_S),
            update_seconds: histogram("update_seconds", update, &LATENCY_BUCKETS_S),
            checkpoint_seconds: histogram("checkpoint_seconds", checkpoint, &DURATION_BUCKETS_S),
            checkpoint_failures: metrics.counter("checkpoint_failures", failures),
            metrics: metrics.clone(),
        }
    }

    pub(crate) fn now(&self) -> Duration {
        self.metrics.now()
    }

    /// Adds the time since `start` to a histogram of this struct.
    pub(crate) fn record(&self, histogram: &Histogram, start: Duration) {
        self.metrics.observe_since(histogram, start);
    }
}
