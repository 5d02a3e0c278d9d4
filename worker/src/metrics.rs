//! Metrics of a worker, and ports that record them.

use std::time::Duration;

use tandem_core::scene::Scene;
use tandem_core::work::EpisodeStart;
use tandem_core::{Contacts, Episode, StepAdvice, StepQuery};
use tandem_net::Metrics;
use tandem_net::metrics::{Counter, DURATION_BUCKETS_S, Gauge, Histogram, LATENCY_BUCKETS_S};

use crate::ports::{Advisor, AdvisorGone, EnvironmentError, VectorEnv};

/// The metrics of slots.
#[derive(Debug, Clone)]
pub(crate) struct WorkerMetrics {
    metrics: Metrics,
    wait_seconds: Histogram,
    slot_seconds: Histogram,
    step_seconds: Histogram,
    advice_seconds: Histogram,
    slots: Counter,
    episodes: Counter,
    env_steps: Counter,
    parameter_version: Gauge,
}

impl WorkerMetrics {
    /// Registers the metrics.
    pub(crate) fn register(metrics: &Metrics) -> Self {
        let histogram = |name, help, buckets: &[f64]| metrics.histogram(name, help, buckets);
        let wait = "Time for which the worker waited for a slot";
        let slot = "Time in which a slot was played";
        let step = "Time in which all environments of a slot execute one step";
        let advice = "Time for which a rollout waits for advice on one step";
        let version = "Version of the parameters in use";
        Self {
            wait_seconds: histogram("worker_wait_seconds", wait, &DURATION_BUCKETS_S),
            slot_seconds: histogram("worker_slot_seconds", slot, &DURATION_BUCKETS_S),
            step_seconds: histogram("worker_step_seconds", step, &LATENCY_BUCKETS_S),
            advice_seconds: histogram("worker_advice_seconds", advice, &LATENCY_BUCKETS_S),
            slots: metrics.counter("worker_slots", "Slots that were played"),
            episodes: metrics.counter("worker_episodes", "Episodes that were played"),
            env_steps: metrics.counter("worker_env_steps", "Steps of environments"),
            parameter_version: metrics.gauge("worker_parameter_version", version),
            metrics: metrics.clone(),
        }
    }

    pub(crate) fn now(&self) -> Duration {
        self.metrics.now()
    }

    /// Records the wait for a slot since `start`.
    pub(crate) fn record_wait(&self, start: Duration, parameter_version: u64) {
        self.metrics.observe_since(&self.wait_seconds, start);
        self.parameter_version.set(i64::try_from(parameter_version).unwrap_or(i64::MAX));
    }

    /// Records a slot that was begun at `start`.
    pub(crate) fn record_slot(&self, start: Duration, episodes: &[Episode]) {
        self.metrics.observe_since(&self.slot_seconds, start);
        self.slots.inc();
        self.episodes.inc_by(episodes.len() as u64);
        let n_steps: usize = episodes.iter().map(|episode| episode.contacts.len()).sum();
        self.env_steps.inc_by(n_steps as u64);
    }
}

/// A port whose calls are measured.
pub(crate) struct Measured<'a, P> {
    pub(crate) port: P,
    pub(crate) metrics: &'a WorkerMetrics,
}

impl<E: VectorEnv> VectorEnv for Measured<'_, &mut E> {
    fn reset(
        &mut self,
        starts: &[EpisodeStart],
        observations: &mut [f32],
        goals: &mut [f32],
    ) -> Result<(), EnvironmentError> {
        self.port.reset(starts, observations, goals)
    }

    fn step(
        &mut self,
        actions: &[f32],
        observations: &mut [f32],
        contacts: &mut [Contacts],
    ) -> Result<(), EnvironmentError> {
        let start = self.metrics.now();
        let stepped = self.port.step(actions, observations, contacts);
        self.metrics.metrics.observe_since(&self.metrics.step_seconds, start);
        stepped
    }

    fn avoidance_steps(&self, environment: usize) -> Option<u32> {
        self.port.avoidance_steps(environment)
    }

    fn scene(&self, environment: usize) -> Option<Scene> {
        self.port.scene(environment)
    }
}

impl<A: Advisor> Advisor for Measured<'_, &mut A> {
    fn advise(&mut self, queries: Vec<StepQuery>) -> Result<Vec<StepAdvice>, AdvisorGone> {
        let start = self.metrics.now();
        let advice = self.port.advise(queries);
        self.metrics.metrics.observe_since(&self.metrics.advice_seconds, start);
        advice
    }

    fn budget_left(&self) -> Option<u64> {
        self.port.budget_left()
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::{EpisodeKind, Layout, Task, WorldSettings};
    use tandem_sim::{Env, WorldConfig};

    use super::*;
    use crate::ports::Simulator;

    #[test]
    fn a_measured_simulator_has_the_scenes_of_the_simulator() {
        let layout = Layout::new(Task::Push, 2);
        let env = Env::new(layout, &WorldConfig::default()).unwrap();
        let mut simulator = Simulator::new(env);
        let metrics = WorkerMetrics::register(&Metrics::default());
        let mut measured = Measured { port: &mut simulator, metrics: &metrics };
        let start = EpisodeStart {
            seed: 1,
            number: 0,
            kind: EpisodeKind::Training,
            world: WorldSettings::default(),
        };
        let (mut observation, mut goal) = (vec![0.0; 56], vec![0.0; 6]);
        measured.reset(&[start], &mut observation, &mut goal).unwrap();
        let scene = measured.scene(0).unwrap();
        assert_eq!(scene.arms.len(), 2);
        assert_eq!(Some(scene), simulator.scene(0));
    }
}
