//! Metrics of the environment service.

use std::time::Duration;

use tandem_net::Metrics;
use tandem_net::metrics::{Counter, Gauge, Histogram, LATENCY_BUCKETS_S};
use tandem_proto::environment::PlayCommand;

/// The metrics of streams and their requests.
#[derive(Debug, Clone)]
pub(crate) struct EnvironmentMetrics {
    metrics: Metrics,
    pub(crate) streams: Gauge,
    step_seconds: Histogram,
    steps: Counter,
    resets: Counter,
}

/// The part of a request that its metrics need.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Work {
    /// Resets of this many environments.
    Reset(u64),
    /// One step of this many environments.
    Step(u64),
}

impl Work {
    /// Returns the work of `command` for a stream of `n` environments.
    pub(crate) fn of(command: &PlayCommand, n: Option<usize>) -> Self {
        match command {
            PlayCommand::Reset(resets) => Self::Reset(resets.len() as u64),
            PlayCommand::Step(_) => Self::Step(n.unwrap_or_default() as u64),
        }
    }
}

impl EnvironmentMetrics {
    /// Registers the metrics.
    pub(crate) fn register(metrics: &Metrics) -> Self {
        let help = "Time in which all environments of a stream execute one step";
        Self {
            streams: metrics.gauge("environment_streams", "Streams that are open"),
            step_seconds: metrics.histogram("environment_step_seconds", help, &LATENCY_BUCKETS_S),
            steps: metrics.counter("environment_steps", "Steps of single environments"),
            resets: metrics.counter("environment_resets", "Episodes that were started"),
            metrics: metrics.clone(),
        }
    }

    pub(crate) fn now(&self) -> Duration {
        self.metrics.now()
    }

    /// Records work that was begun at `start` and has succeeded.
    pub(crate) fn record(&self, work: Work, start: Duration) {
        match work {
            Work::Reset(n) => drop(self.resets.inc_by(n)),
            Work::Step(n) => {
                self.metrics.observe_since(&self.step_seconds, start);
                self.steps.inc_by(n);
            }
        }
    }
}

/// Counts a stream as open until it is dropped.
pub(crate) struct OpenStream(Gauge);

impl OpenStream {
    pub(crate) fn new(streams: &Gauge) -> Self {
        streams.inc();
        Self(streams.clone())
    }
}

impl Drop for OpenStream {
    fn drop(&mut self) {
        self.0.dec();
    }
}
