//! Metrics of the bridge.

use tandem_net::Metrics;
use tandem_net::metrics::{ConstGauge, Counter, Family, Gauge, Registry};

use super::reason_codes::of_cause;
use super::thread::ArmsHandle;
use crate::executor::{Phase, Stop};

const PHASES: [(Phase, &str); 5] = [
    (Phase::Stopped, "stopped"),
    (Phase::Idle, "idle"),
    (Phase::Moving, "moving"),
    (Phase::Holding, "holding"),
    (Phase::Settling, "settling"),
];

/// The number of stops by cause.
#[derive(Debug, Clone, Default)]
pub(super) struct StopCounter(Family<[(&'static str, &'static str); 1], Counter>);

impl StopCounter {
    /// Registers the counter.
    pub(super) fn register(metrics: &Metrics) -> Self {
        let counter = Self::default();
        metrics.register("bridge_stops", "Stops of the arms by cause", counter.0.clone());
        counter
    }

    pub(super) fn count(&self, stop: &Stop) {
        let (code, _) = of_cause(&stop.cause);
        self.0.get_or_create(&[("cause", code)]).inc();
    }
}

/// Adds the state of the arms to `metrics`.
pub(super) fn add_state(metrics: &Metrics, arms: ArmsHandle) {
    metrics.add_source(move |registry| {
        let newest = arms.newest();
        let phase: Family<[(&'static str, &'static str); 1], Gauge> = Family::default();
        for (each, name) in PHASES {
            phase.get_or_create(&[("phase", name)]).set(i64::from(each == newest.phase));
        }
        registry.register("bridge_phase", "1 for the present phase of the arms", phase);
        let is_connected = f64::from(u8::from(!newest.exchange_failed));
        let help =
            "1 while commands can be sent and the arms have sent a state within the last second";
        gauge(registry, "bridge_driver_connected", help, is_connected);
        let help = "Calls that wait for the ticking thread";
        gauge(registry, "bridge_queue_depth", help, arms.n_waiting() as f64);
        let age_s = (arms.clock.now_s() - newest.now_s).max(0.0);
        gauge(registry, "bridge_last_tick_age_seconds", "Time since the last tick", age_s);
    });
}

fn gauge(registry: &mut Registry, name: &str, help: &str, value: f64) {
    registry.register(name, help, ConstGauge::new(value));
}
