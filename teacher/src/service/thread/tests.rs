//! Tests of the thread without sockets.

use std::collections::BTreeMap;

use tandem_core::{StepAdvice, TaskSpec};
use tandem_net::Metrics;
use tokio::task::JoinHandle as Task;

use super::*;
use crate::budget::{AccountTerms, Balance};
use crate::fake::{FakePolicy, query};
use crate::ledger::MemoryLedger;
use crate::policy::TeacherPolicy;
use crate::service::gated_ledger::{GateControl, GatedLedger, Mode, eventually};

/// A timeout that no test reaches.
const LONG: Duration = Duration::from_secs(60);

/// A thread with an open account, and the control of its ledger.
struct Fixture {
    thread: AdvisorThread,
    handle: AdvisorHandle,
    gate: GateControl,
    stop: CancellationToken,
}

impl Fixture {
    async fn start(budget: u64) -> Self {
        let (gate, stop) = (GateControl::new(), CancellationToken::new());
        let ledger = Box::new(GatedLedger::new(gate.clone()));
        let advisor = Advisor::new(Box::new(FakePolicy), ledger).unwrap();
        let metrics = TeacherMetrics::register(&Metrics::default());
        let (thread, handle) =
            AdvisorThread::spawn(advisor, LONG, stop.clone(), Pacing::Concurrent, metrics).unwrap();
        let terms = AccountTerms { budget, strategy: "ea".parse().unwrap() };
        handle.run(move |advisor| advisor.open_account("run", terms)).await.unwrap();
        Self { thread, handle, gate, stop }
    }

    /// Starts a thread that blocks in its ledger while it charges step 0 of episode 1.
    async fn start_blocked(budget: u64) -> (Self, Task<Answer<Advice>>) {
        let fixture = Self::start(budget).await;
        // The strategy is cached now, so only the charge blocks.
        fixture
            .handle
            .advise(AdviceRequest { queries: Vec::new(), ..request(1, 0) })
            .await
            .unwrap();
        fixture.gate.set(Mode::Block);
        let first = fixture.spawn(request(1, 0));
        fixture.gate.charge_called(1).await;
        (fixture, first)
    }

    fn spawn(&self, request: AdviceRequest) -> Task<Answer<Advice>> {
        let handle = self.handle.clone();
        tokio::spawn(async move { handle.advise(request).await })
    }

    /// Sends `request` and waits until `n` jobs are in the queue.
    async fn spawn_as(&self, n: usize, request: AdviceRequest) -> Task<Answer<Advice>> {
        let task = self.spawn(request);
        self.waiting(n).await;
        task
    }

    async fn waiting(&self, n: usize) {
        eventually(|| QUEUE_CAPACITY - self.handle.jobs.capacity() >= n).await;
    }

    async fn balance(&self) -> Balance {
        self.handle.run(|advisor| advisor.balance("run")).await.unwrap()
    }

    async fn stop(self) {
        drop(self.handle);
        self.thread.join(LONG).await.unwrap();
        assert!(self.stop.is_cancelled());
    }
}

fn request(episode: u64, step: u32) -> AdviceRequest {
    AdviceRequest { account: "run".to_owned(), queries: vec![query(episode, step, 0.5, 0.25)] }
}

/// Returns the advice on the only step of a request.
async fn advice(pending: Task<Answer<Advice>>) -> StepAdvice {
    pending.await.unwrap().unwrap().steps.remove(0)
}

/// 64 clients in pairs that request the same steps: each step is charged once, and the budget is spent exactly.
#[tokio::test]
async fn a_budget_is_never_overspent_and_no_step_is_charged_twice() {
    let fixture = Fixture::start(10_000).await;
    let charged_steps_of = async |handle: AdvisorHandle, client: u64| {
        let mut charged = BTreeMap::new();
        for step in 0..400 {
            let answer = handle.advise(request(client / 2, step)).await.unwrap();
            charged.insert((client / 2, step), answer.steps[0].charged);
        }
        charged
    };
    let clients: Vec<_> = (0..64)
        .map(|client| tokio::spawn(charged_steps_of(fixture.handle.clone(), client)))
        .collect();
    let mut by_client = Vec::new();
    for client in clients {
        by_client.push(client.await.unwrap());
    }
    for pair in by_client.chunks_exact(2) {
        assert_eq!(pair[0], pair[1], "two clients with the same steps");
    }
    let charged = by_client.iter().step_by(2).flat_map(BTreeMap::values);
    assert_eq!(charged.filter(|charged| **charged).count(), 10_000);
    let balance = fixture.balance().await;
    assert_eq!((balance.spent, balance.left), (10_000, 0));
    let n_visits = fixture.gate.charge_calls().len();
    assert!(n_visits < 64 * 400, "some of them were answered together, {n_visits} visits");
    fixture.stop().await;
}

#[tokio::test]
async fn requests_that_wait_together_are_one_call_to_the_ledger() {
    let (fixture, first) = Fixture::start_blocked(100).await;
    let two = AdviceRequest {
        queries: vec![query(2, 0, 0.0, 0.0), query(2, 1, 0.0, 0.0)],
        ..request(2, 0)
    };
    let second = fixture.spawn_as(1, two).await;
    let unknown = AdviceRequest { account: "walk".to_owned(), ..request(3, 0) };
    let third = fixture.spawn_as(2, unknown).await;
    let fourth = fixture.spawn_as(3, request(4, 0)).await;
    fixture.gate.set(Mode::Answer);
    assert!(advice(first).await.charged);
    assert_eq!(second.await.unwrap().unwrap().steps.len(), 2);
    assert!(matches!(third.await.unwrap(), Err(Error::Ledger(_))));
    assert!(advice(fourth).await.charged);
    assert_eq!(fixture.gate.charge_calls(), [vec![1], vec![2, 1]]);
    fixture.stop().await;
}

#[tokio::test]
async fn a_batch_ends_with_its_last_step() {
    let (fixture, _first) = Fixture::start_blocked(10_000).await;
    let many = |episode, n_steps: u32| AdviceRequest {
        queries: (0..n_steps).map(|step| query(episode, step, 0.0, 0.0)).collect(),
        ..request(0, 0)
    };
    let max = u32::try_from(MAX_BATCH_STEPS).unwrap();
    let mut pending = Vec::new();
    for (episode, n_steps) in [(2, max - 1), (3, 1), (4, 1), (5, 3 * max), (6, 1)] {
        pending.push(fixture.spawn_as(pending.len() + 1, many(episode, n_steps)).await);
    }
    fixture.gate.set(Mode::Answer);
    for task in pending {
        assert!(task.await.unwrap().unwrap().steps.iter().all(|step| step.charged));
    }
    let expected = [vec![1], vec![MAX_BATCH_STEPS - 1, 1], vec![1, 3 * MAX_BATCH_STEPS], vec![1]];
    assert_eq!(fixture.gate.charge_calls(), expected);
    fixture.stop().await;
}

#[tokio::test]
async fn other_jobs_keep_their_place_between_requests() {
    let (fixture, _first) = Fixture::start_blocked(10).await;
    let before = fixture.spawn_as(1, request(1, 1)).await;
    let handle = fixture.handle.clone();
    let lease = tokio::spawn(async move {
        handle.run(|advisor| advisor.open_leases("run", &[2], 50)).await.unwrap()
    });
    fixture.waiting(2).await;
    let after = fixture.spawn_as(3, request(3, 0)).await;
    fixture.gate.set(Mode::Answer);
    assert!(advice(before).await.charged);
    let (leases, balance) = lease.await.unwrap();
    assert_eq!((leases[0].units, balance.spent, balance.left), (8, 2, 0));
    assert!(!advice(after).await.charged, "the lease took what was left");
    fixture.stop().await;
}

#[tokio::test]
async fn a_dropped_request_is_not_charged() {
    let (fixture, first) = Fixture::start_blocked(10).await;
    let gone = fixture.spawn_as(1, request(1, 1)).await;
    let handle = fixture.handle.clone();
    let gone_too =
        tokio::spawn(
            async move { handle.run(|advisor| advisor.open_leases("run", &[2], 5)).await },
        );
    fixture.waiting(2).await;
    let stays = fixture.spawn_as(3, request(1, 2)).await;
    for task in [&gone.abort_handle(), &gone_too.abort_handle(), &first.abort_handle()] {
        task.abort();
    }
    assert!(gone.await.unwrap_err().is_cancelled() && gone_too.await.unwrap_err().is_cancelled());
    assert!(first.await.unwrap_err().is_cancelled());
    fixture.gate.set(Mode::Answer);
    assert!(advice(stays).await.charged);
    let balance = fixture.balance().await;
    assert_eq!((balance.spent, balance.leased), (2, 0), "steps 0, already under way, and 2");
    let again = fixture.handle.advise(request(1, 0)).await.unwrap();
    assert!(again.steps[0].charged, "the answer that was lost");
    assert_eq!(again.budget_left, 8);
    fixture.stop().await;
}

#[tokio::test]
async fn a_call_fails_after_its_timeout() {
    let (fixture, first) = Fixture::start_blocked(10).await;
    let hasty = AdvisorHandle { timeout: Duration::from_millis(50), ..fixture.handle.clone() };
    let timed_out = hasty.advise(request(1, 1)).await.unwrap_err();
    assert_eq!(timed_out.to_string(), "no answer within 50ms: ask again");
    let timed_out = hasty.run(|advisor| advisor.balance("run")).await;
    assert!(matches!(timed_out, Err(Error::Timeout(_))));
    drop(hasty);
    fixture.gate.set(Mode::Answer);
    assert!(advice(first).await.charged);
    assert_eq!(fixture.balance().await.spent, 1);
    fixture.stop().await;
}

#[tokio::test]
async fn calls_beyond_the_capacity_of_the_queue_wait_and_are_answered() {
    let (fixture, first) = Fixture::start_blocked(100_000).await;
    let n_callers = 3 * u32::try_from(QUEUE_CAPACITY).unwrap();
    let pending: Vec<_> = (0..n_callers).map(|step| fixture.spawn(request(2, step))).collect();
    fixture.waiting(QUEUE_CAPACITY).await;
    fixture.gate.set(Mode::Answer);
    assert!(advice(first).await.charged);
    for task in pending {
        assert!(advice(task).await.charged);
    }
    assert_eq!(fixture.balance().await.spent, u64::from(n_callers) + 1);
    fixture.stop().await;
}

#[tokio::test]
async fn a_request_can_be_repeated_after_the_ledger_was_unavailable() {
    let fixture = Fixture::start(10).await;
    fixture.gate.set(Mode::Refuse);
    for _ in 0..2 {
        let refused = fixture.handle.advise(request(1, 0)).await.unwrap_err().to_string();
        assert_eq!(refused, "the ledger cannot be used now: the disk is full");
    }
    fixture.gate.set(Mode::Answer);
    assert_eq!(fixture.handle.advise(request(1, 0)).await.unwrap().budget_left, 9);
    fixture.stop().await;
}

#[tokio::test]
async fn a_panic_fails_every_call_and_is_returned() {
    let (fixture, first) = Fixture::start_blocked(10).await;
    let second = fixture.spawn_as(1, request(1, 1)).await;
    fixture.gate.set(Mode::Panic);
    assert!(matches!(first.await.unwrap(), Err(Error::Panicked)));
    assert!(matches!(second.await.unwrap(), Err(Error::Panicked)));
    fixture.stop.cancelled().await;
    assert!(matches!(fixture.handle.advise(request(1, 2)).await, Err(Error::Panicked)));
    assert!(matches!(fixture.thread.join(LONG).await, Err(Error::Panicked)));
}

#[tokio::test]
async fn a_blocked_thread_is_detached() {
    let (Fixture { thread, handle, gate, stop }, first) = Fixture::start_blocked(10).await;
    drop(handle);
    thread.join(Duration::from_millis(20)).await.unwrap();
    assert!(!stop.is_cancelled());
    gate.set(Mode::Answer);
    assert!(advice(first).await.charged);
    stop.cancelled().await;
}

#[test]
fn a_slow_policy_gets_small_batches_and_no_request_whose_caller_would_be_gone() {
    let secs = Duration::from_secs_f64;
    let timeout = secs(4.0);
    let max_steps = |n_steps, time_s| Pace::after(n_steps, secs(time_s), timeout).max_steps;
    assert_eq!(max_steps(2, 0.0), MAX_BATCH_STEPS, "the clock of a simulation");
    assert_eq!(max_steps(2, 0.000_1), MAX_BATCH_STEPS);
    assert_eq!([max_steps(16, 3.0), max_steps(2, 0.8), max_steps(2, 9.0)], [5, 2, 1]);
    let is_too_late = |time_s, waited_s| {
        Pace::after(2, secs(time_s), timeout).is_too_late(secs(waited_s), timeout)
    };
    assert_eq!([is_too_late(0.8, 3.1), is_too_late(0.8, 3.3)], [false, true]);
    assert!(!is_too_late(60.0, 1.9), "the pace is measured again after a disk has hung");
    assert!(!Pace::FAST.is_too_late(timeout, timeout));
}

#[tokio::test]
async fn a_policy_too_slow_for_all_callers_at_once_answers_some_of_them() {
    const N_CALLERS: u64 = 16;
    let (step_time, timeout) = (Duration::from_millis(10), Duration::from_millis(300));
    let start = tokio::time::Instant::now();
    let metrics = TeacherMetrics::register(&Metrics::new(Arc::new(move || start.elapsed())));
    let policy = Box::new(SlowPolicy { step_time });
    let mut advisor = Advisor::new(policy, Box::<MemoryLedger>::default()).unwrap();
    let terms = AccountTerms { budget: 1000, strategy: "ea".parse().unwrap() };
    advisor.open_account("run", terms).unwrap();
    let stop = CancellationToken::new();
    let (thread, handle) =
        AdvisorThread::spawn(advisor, timeout, stop, Pacing::Concurrent, metrics).unwrap();
    let end = start + Duration::from_secs(2);
    let callers: Vec<Task<u32>> = (0..N_CALLERS)
        .map(|episode| {
            let handle = handle.clone();
            tokio::spawn(async move {
                let mut n_answered = 0;
                while tokio::time::Instant::now() < end {
                    match handle.advise(request(episode, n_answered)).await {
                        Ok(_) => n_answered += 1,
                        Err(_) => tokio::time::sleep(Duration::from_millis(5)).await,
                    }
                }
                n_answered
            })
        })
        .collect();
    let mut n_answered = 0;
    for caller in callers {
        n_answered += caller.await.unwrap();
    }
    drop(handle);
    thread.join(LONG).await.unwrap();
    // There is time for 100 answers. A batch of all callers takes longer than they wait.
    assert!(n_answered > 20, "{n_answered}");
}

/// A policy that takes a while for each state.
struct SlowPolicy {
    step_time: Duration,
}

impl TeacherPolicy for SlowPolicy {
    fn task(&self) -> TaskSpec {
        FakePolicy.task()
    }

    fn digest(&self) -> &str {
        "slow"
    }

    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
        let n_states = u32::try_from(goals.len() / 3).unwrap();
        thread::sleep(self.step_time * n_states);
        FakePolicy.act(observations, goals, actions);
    }

    fn q(&mut self, observations: &[f32], goals: &[f32], actions: &[f32], q: &mut [f32]) {
        FakePolicy.q(observations, goals, actions, q);
    }
}
