//! The metrics of a process, for Prometheus.
//!
//! A process has one [`Metrics`], whose clones share their values. Services and clients record calls in it, and each
//! service registers metrics of its own. Nothing reads the values before the process serves [`Metrics::endpoint`], so a
//! default [`Metrics`] is the metrics of a process without that page.

mod rpc;

use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use prometheus_client::encoding::text::{encode, encode_registry};
pub use prometheus_client::metrics::counter::{ConstCounter, Counter};
pub use prometheus_client::metrics::family::Family;
pub use prometheus_client::metrics::gauge::{ConstGauge, Gauge};
pub use prometheus_client::metrics::histogram::Histogram;
pub use prometheus_client::metrics::info::Info;
pub use prometheus_client::registry::{Metric, Registry};

use crate::text_endpoint::TextEndpoint;

pub(crate) use rpc::{MeasuredCall, Methods, RpcMetrics, Side, labels_of};
pub use rpc::{RpcLayer, RpcService};

/// The path of the page.
const PATH: &str = "/metrics";
const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
/// The prefix of all metrics but those that every Prometheus client library has.
const PREFIX: &str = "tandem";

/// Upper bounds of histogram buckets for time spans from 0.1 ms to 10 s, seconds.
pub const LATENCY_BUCKETS_S: [f64; 16] = [
    0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5,
    5.0, 10.0,
];
/// Upper bounds of histogram buckets for time spans from 50 ms to 10 min, seconds.
pub const DURATION_BUCKETS_S: [f64; 13] =
    [0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0];
/// Upper bounds of histogram buckets for counts from 1 to 1024.
pub const COUNT_BUCKETS: [f64; 11] =
    [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0, 512.0, 1024.0];

/// Returns the time since a fixed start.
pub type Clock = Arc<dyn Fn() -> Duration + Send + Sync>;

/// Adds metrics whose values are determined when the page is read. The registry has no prefix.
type Source = Box<dyn Fn(&mut Registry) + Send>;

/// The metrics of a process. The default has a clock that does not advance.
#[derive(Clone)]
pub struct Metrics(Arc<Inner>);

struct Inner {
    clock: Clock,
    rpc: RpcMetrics,
    page: Mutex<Page>,
}

/// The contents of the page.
struct Page {
    registry: Registry,
    sources: Vec<Source>,
}

impl Default for Metrics {
    fn default() -> Self {
        Self::new(Arc::new(|| Duration::ZERO))
    }
}

impl Metrics {
    /// Creates the metrics of a process, whose time spans `clock` measures.
    #[must_use]
    pub fn new(clock: Clock) -> Self {
        let mut registry = Registry::default();
        let rpc = RpcMetrics::new(registry.sub_registry_with_prefix(PREFIX));
        let page = Mutex::new(Page { registry, sources: Vec::new() });
        Self(Arc::new(Inner { clock, rpc, page }))
    }

    /// Returns the time since the clock's start.
    #[must_use]
    pub fn now(&self) -> Duration {
        (self.0.clock)()
    }

    /// Adds the seconds since `start` to `histogram`.
    pub fn observe_since(&self, histogram: &Histogram, start: Duration) {
        histogram.observe(self.now().saturating_sub(start).as_secs_f64());
    }

    /// Registers a metric as `tandem_{name}`. A counter's name is given without `_total`.
    pub fn register(&self, name: &str, help: &str, metric: impl Metric) {
        self.lock().registry.sub_registry_with_prefix(PREFIX).register(name, help, metric);
    }

    /// Registers a counter as `tandem_{name}_total`.
    #[must_use]
    pub fn counter(&self, name: &str, help: &str) -> Counter {
        let counter = Counter::default();
        self.register(name, help, counter.clone());
        counter
    }

    /// Registers a gauge as `tandem_{name}`.
    #[must_use]
    pub fn gauge(&self, name: &str, help: &str) -> Gauge {
        let gauge = Gauge::default();
        self.register(name, help, gauge.clone());
        gauge
    }

    /// Registers a histogram with these upper bounds of its buckets as `tandem_{name}`.
    #[must_use]
    pub fn histogram(&self, name: &str, help: &str, buckets: &[f64]) -> Histogram {
        let histogram = Histogram::new(buckets.iter().copied());
        self.register(name, help, histogram.clone());
        histogram
    }

    /// Adds metrics that `source` registers with their values whenever the page is read. Their names get the prefix
    /// `tandem_`.
    pub fn add_source(&self, source: impl Fn(&mut Registry) + Send + 'static) {
        self.add_foreign_source(move |registry| {
            source(registry.sub_registry_with_prefix(PREFIX));
        });
    }

    /// Adds metrics as [`Self::add_source`], without the prefix: those that all programs have, such as
    /// `process_cpu_seconds_total`.
    pub fn add_foreign_source(&self, source: impl Fn(&mut Registry) + Send + 'static) {
        self.lock().sources.push(Box::new(source));
    }

    /// Returns the page: all metrics as OpenMetrics text.
    ///
    /// # Panics
    /// Never: writing to a string succeeds.
    #[must_use]
    pub fn page(&self) -> String {
        let page = self.lock();
        let mut at_once = Registry::default();
        for source in &page.sources {
            source(&mut at_once);
        }
        let mut text = String::new();
        encode_registry(&mut text, &at_once)
            .and_then(|()| encode(&mut text, &page.registry))
            .expect("writing to a string succeeds");
        text
    }

    /// Returns the page as an endpoint at `/metrics`.
    #[must_use]
    pub fn endpoint(&self) -> TextEndpoint {
        let metrics = self.clone();
        let write = Arc::new(move || metrics.page());
        TextEndpoint { path: PATH, content_type: CONTENT_TYPE, write }
    }

    pub(crate) fn rpc(&self) -> &RpcMetrics {
        &self.0.rpc
    }

    fn lock(&self) -> MutexGuard<'_, Page> {
        // A registry is valid even if a source has panicked.
        self.0.page.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl fmt::Debug for Metrics {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Metrics(..)")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_has_registered_metrics_and_those_of_sources_and_ends_once() {
        let metrics = Metrics::default();
        metrics.counter("slots", "Slots").inc_by(3);
        metrics.histogram("slot_seconds", "Time", &[0.5, 1.0]).observe(0.75);
        metrics.add_source(|registry| {
            registry.register("depth", "Depth", ConstGauge::new(2.5));
        });
        metrics.add_foreign_source(|registry| {
            registry.register("process_cpu_seconds", "Time", ConstCounter::new(1.25));
        });
        let page = metrics.page();
        for line in [
            "# TYPE tandem_slots counter\n",
            "\ntandem_slots_total 3\n",
            "\ntandem_slot_seconds_bucket{le=\"0.5\"} 0\n",
            "\ntandem_slot_seconds_bucket{le=\"1.0\"} 1\n",
            "\ntandem_slot_seconds_sum 0.75\n",
            "\ntandem_depth 2.5\n",
            "\nprocess_cpu_seconds_total 1.25\n",
        ] {
            assert!(page.contains(line), "{page}");
        }
        assert_eq!(page.matches("# EOF\n").count(), 1, "{page}");
        assert!(page.ends_with("# EOF\n"), "{page}");
    }
}
