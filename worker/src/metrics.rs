//! Metrics of a worker, and ports that record them.

use std::time::Duration;

use tandem_core::scene::Scene;
use tandem_core::work::EpisodeStart;
use tandem_core::{Contacts, Episode, StepAdvice, StepQuery};
use tandem_net::Metrics;
use tandem_net::metrics::{Counter, DURATION_BUCKETS_S, Gauge, Histogram, LATENCY_BUCKETS_S};

use crate::liveness::Liveness;
use crate::ports::{Advisor, AdvisorGone, EnvironmentError, VectorEnv};

/// The metrics of slots, and the liveness of the rollout that plays them.
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
    liveness: Liveness,
}

impl WorkerMetrics {
    /// Registers the metrics.
    pub(crate) fn register(metrics: &Metrics, liveness: Liveness) -> Self {
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
            liveness,
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

    /// Calls `play`, which computes except while it [waits](Self::waiting).
    pub(crate) fn computing<T>(&self, play: impl FnOnce() -> T) -> T {
        self.liveness.compute(self.now());
        let played = play();
        self.liveness.rest();
        played
    }

    /// Calls `wait`, which waits for a peer.
    pub(crate) fn waiting<T>(&self, wait: impl FnOnce() -> T) -> T {
        self.liveness.rest();
        let waited = wait();
        self.liveness.compute(self.now());
        waited
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
        self.metrics.liveness.compute(self.metrics.now());
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
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU64, Ordering};

    use tandem_core::{EpisodeKind, Layout, Task, WorldSettings};
    use tandem_sim::{Env, WorldConfig};

    use super::*;
    use crate::fakes::{FakeEnvironment, LAYOUT};
    use crate::player::{AdviceReply, PeerChannel, PeerRequest};
    use crate::ports::Simulator;

    #[test]
    fn a_rollout_computes_from_step_to_step_except_while_it_waits_for_the_teacher() {
        let seconds = Arc::new(AtomicU64::new(3));
        let clock = seconds.clone();
        let now = move || Duration::from_secs(clock.load(Ordering::SeqCst));
        let liveness = Liveness::default();
        let metrics = WorkerMetrics::register(&Metrics::new(Arc::new(now)), liveness.clone());
        let since = || liveness.computing_since().map(|since| since.as_secs());
        assert_eq!(since(), None);

        let (peers, mut requests) = PeerChannel::new();
        let mut peers = peers.with_metrics(metrics.clone());
        let during_advice = liveness.clone();
        let answering = std::thread::spawn(move || {
            let asked = requests.blocking_recv();
            let Some(PeerRequest::Advice(_, response)) = asked else { panic!("{asked:?}") };
            assert_eq!(during_advice.computing_since(), None);
            response.send(AdviceReply { steps: Vec::new(), budget_left: 0 }).expect("waits");
        });
        metrics.computing(|| {
            assert_eq!(since(), Some(3));
            seconds.store(5, Ordering::SeqCst);
            assert_eq!(since(), Some(3));
            peers.advise(Vec::new()).expect("answered");
            assert_eq!(since(), Some(5));
            seconds.store(8, Ordering::SeqCst);
            let mut port = FakeEnvironment::new();
            let mut measured = Measured { port: &mut port, metrics: &metrics };
            let mut observations = vec![0.0; LAYOUT.n_observation()];
            let actions = vec![0.0; LAYOUT.n_action()];
            measured.step(&actions, &mut observations, &mut []).expect("stepped");
            assert_eq!(since(), Some(8));
        });
        assert_eq!(since(), None);
        answering.join().expect("no panic");
    }

    #[test]
    fn a_measured_simulator_has_the_scenes_of_the_simulator() {
        let layout = Layout::new(Task::Push, 2);
        let env = Env::new(layout, &WorldConfig::default()).unwrap();
        let mut simulator = Simulator::new(env);
        let metrics = WorkerMetrics::register(&Metrics::default(), Liveness::default());
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
