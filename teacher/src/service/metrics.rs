//! Metrics of the teacher.

use std::time::Duration;

use tandem_net::Metrics;
use tandem_net::metrics::{COUNT_BUCKETS, Counter, Histogram, LATENCY_BUCKETS_S};

use crate::advisor::Advice;
use crate::error::Error;

/// The metrics of requests for advice.
#[derive(Debug, Clone)]
pub(super) struct TeacherMetrics {
    pub(super) registry: Metrics,
    request_seconds: Histogram,
    batch_seconds: Histogram,
    batch_steps: Histogram,
    steps: Counter,
    overridden_steps: Counter,
    charged_steps: Counter,
}

impl TeacherMetrics {
    /// Registers the metrics.
    pub(super) fn register(metrics: &Metrics) -> Self {
        let request_seconds = metrics.histogram(
            "advice_request_seconds",
            "Time from a request for advice to its answer",
            &LATENCY_BUCKETS_S,
        );
        let batch_seconds = metrics.histogram(
            "advice_batch_seconds",
            "Time in which the networks and the ledger answer one batch",
            &LATENCY_BUCKETS_S,
        );
        let batch_steps =
            metrics.histogram("advice_batch_steps", "Steps that one batch answers", &COUNT_BUCKETS);
        Self {
            registry: metrics.clone(),
            request_seconds,
            batch_seconds,
            batch_steps,
            steps: metrics.counter("advice_steps", "Steps that were answered"),
            overridden_steps: metrics
                .counter("advice_overridden_steps", "Steps on which the teacher replaced actions"),
            charged_steps: metrics
                .counter("advice_charged_steps", "Steps that cost a unit, alone or with others"),
        }
    }

    /// Returns the time since the start.
    pub(super) fn now(&self) -> Duration {
        self.registry.now()
    }

    /// Records a request that arrived at `start`.
    pub(super) fn record_request(&self, start: Duration) {
        self.registry.observe_since(&self.request_seconds, start);
    }

    /// Records the answers to a batch of `n_steps` that was begun at `start`.
    pub(super) fn record_batch(
        &self,
        start: Duration,
        n_steps: usize,
        answers: &[Result<Advice, Error>],
    ) {
        self.registry.observe_since(&self.batch_seconds, start);
        self.batch_steps.observe(n_steps as f64);
        let (mut n_answered, mut n_overridden, mut n_charged) = (0, 0, 0);
        for step in answers.iter().flatten().flat_map(|advice| &advice.steps) {
            n_answered += 1;
            n_overridden += u64::from(step.arms.iter().any(|arm| arm.overridden));
            n_charged += u64::from(step.charged);
        }
        self.steps.inc_by(n_answered);
        self.overridden_steps.inc_by(n_overridden);
        self.charged_steps.inc_by(n_charged);
    }
}
