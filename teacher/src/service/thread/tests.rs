//! The thread without sockets.

use std::collections::BTreeMap;

use tandem_core::StepAdvice;
use tokio::task::JoinHandle as Task;

use super::*;
use crate::budget::{AccountTerms, Balance};
use crate::fake::{FakePolicy, query};
use crate::service::gated_ledger::{GateControl, GatedLedger, Mode, eventually};

/// More than any answer takes.
const LONG: Duration = Duration::from_secs(60);

/// A thread, its ledger's gate, and an open account.
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
        let (thread, handle) =
            AdvisorThread::spawn(advisor, LONG, stop.clone(), Pacing::Concurrent).unwrap();
        let terms = AccountTerms { budget, strategy: "ea".parse().unwrap() };
        handle.run(move |advisor| advisor.open_account("run", terms)).await.unwrap();
        Self { thread, handle, gate, stop }
    }

    /// The same, its thread held up in the ledger with step 0 of episode 1.
    async fn start_held_up(budget: u64) -> (Self, Task<Answer<Advice>>) {
        let fixture = Self::start(budget).await;
        // The account's terms are known from here on; to charge is what blocks.
        fixture
            .handle
            .advise(AdviceRequest { queries: Vec::new(), ..question(1, 0) })
            .await
            .unwrap();
        fixture.gate.set(Mode::Block);
        let first = fixture.spawn(question(1, 0));
        fixture.gate.charge_called(1).await;
        (fixture, first)
    }

    fn spawn(&self, question: AdviceRequest) -> Task<Answer<Advice>> {
        let handle = self.handle.clone();
        tokio::spawn(async move { handle.advise(question).await })
    }

    /// Hands in `question` and waits until `n` jobs wait in the queue.
    async fn spawn_as(&self, n: usize, question: AdviceRequest) -> Task<Answer<Advice>> {
        let task = self.spawn(question);
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

fn question(episode: u64, step: u32) -> AdviceRequest {
    AdviceRequest { account: "run".to_owned(), queries: vec![query(episode, step, 0.5, 0.25)] }
}

/// The advice on the only step of an answered question.
async fn advice(asked: Task<Answer<Advice>>) -> StepAdvice {
    asked.await.unwrap().unwrap().steps.remove(0)
}

/// 64 clients, every step asked about by two of them: what the budget pays for is charged once, and no more.
#[tokio::test]
async fn a_budget_is_never_overspent_and_no_step_is_charged_twice() {
    let fixture = Fixture::start(10_000).await;
    let charged_steps_of = async |handle: AdvisorHandle, client: u64| {
        let mut charged = BTreeMap::new();
        for step in 0..400 {
            let answer = handle.advise(question(client / 2, step)).await.unwrap();
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
        assert_eq!(pair[0], pair[1], "the two clients that asked about the same steps");
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
async fn questions_that_wait_together_are_one_visit_to_the_ledger() {
    let (fixture, first) = Fixture::start_held_up(100).await;
    let two = AdviceRequest {
        queries: vec![query(2, 0, 0.0, 0.0), query(2, 1, 0.0, 0.0)],
        ..question(2, 0)
    };
    let second = fixture.spawn_as(1, two).await;
    let unknown = AdviceRequest { account: "walk".to_owned(), ..question(3, 0) };
    let third = fixture.spawn_as(2, unknown).await;
    let fourth = fixture.spawn_as(3, question(4, 0)).await;
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
    let (fixture, _first) = Fixture::start_held_up(10_000).await;
    let many = |episode, n_steps: u32| AdviceRequest {
        queries: (0..n_steps).map(|step| query(episode, step, 0.0, 0.0)).collect(),
        ..question(0, 0)
    };
    let max = u32::try_from(MAX_BATCH_STEPS).unwrap();
    let mut asked = Vec::new();
    for (episode, n_steps) in [(2, max - 1), (3, 1), (4, 1), (5, 3 * max), (6, 1)] {
        asked.push(fixture.spawn_as(asked.len() + 1, many(episode, n_steps)).await);
    }
    fixture.gate.set(Mode::Answer);
    for asked in asked {
        assert!(asked.await.unwrap().unwrap().steps.iter().all(|step| step.charged));
    }
    let expected = [vec![1], vec![MAX_BATCH_STEPS - 1, 1], vec![1, 3 * MAX_BATCH_STEPS], vec![1]];
    assert_eq!(fixture.gate.charge_calls(), expected);
    fixture.stop().await;
}

#[tokio::test]
async fn whatever_else_is_asked_is_done_in_its_turn() {
    let (fixture, _first) = Fixture::start_held_up(10).await;
    let before = fixture.spawn_as(1, question(1, 1)).await;
    let handle = fixture.handle.clone();
    let lease = tokio::spawn(async move {
        handle.run(|advisor| advisor.open_leases("run", &[2], 50)).await.unwrap()
    });
    fixture.waiting(2).await;
    let after = fixture.spawn_as(3, question(3, 0)).await;
    fixture.gate.set(Mode::Answer);
    assert!(advice(before).await.charged);
    let (leases, balance) = lease.await.unwrap();
    assert_eq!((leases[0].units, balance.spent, balance.left), (8, 2, 0));
    assert!(!advice(after).await.charged, "the lease took what was left");
    fixture.stop().await;
}

#[tokio::test]
async fn a_caller_that_has_gone_is_not_charged() {
    let (fixture, first) = Fixture::start_held_up(10).await;
    let gone = fixture.spawn_as(1, question(1, 1)).await;
    let handle = fixture.handle.clone();
    let gone_too =
        tokio::spawn(
            async move { handle.run(|advisor| advisor.open_leases("run", &[2], 5)).await },
        );
    fixture.waiting(2).await;
    let stays = fixture.spawn_as(3, question(1, 2)).await;
    for task in [&gone.abort_handle(), &gone_too.abort_handle(), &first.abort_handle()] {
        task.abort();
    }
    assert!(gone.await.unwrap_err().is_cancelled() && gone_too.await.unwrap_err().is_cancelled());
    assert!(first.await.unwrap_err().is_cancelled());
    fixture.gate.set(Mode::Answer);
    assert!(advice(stays).await.charged);
    let balance = fixture.balance().await;
    assert_eq!((balance.spent, balance.leased), (2, 0), "steps 0, already under way, and 2");
    let again = fixture.handle.advise(question(1, 0)).await.unwrap();
    assert!(again.steps[0].charged, "the answer that was lost");
    assert_eq!(again.budget_left, 8);
    fixture.stop().await;
}

#[tokio::test]
async fn a_call_fails_after_its_timeout() {
    let (fixture, first) = Fixture::start_held_up(10).await;
    let hasty = AdvisorHandle { timeout: Duration::from_millis(50), ..fixture.handle.clone() };
    let overdue = hasty.advise(question(1, 1)).await.unwrap_err();
    assert_eq!(overdue.to_string(), "no answer within 50ms: ask again");
    let overdue = hasty.run(|advisor| advisor.balance("run")).await;
    assert!(matches!(overdue, Err(Error::Timeout(_))));
    drop(hasty);
    fixture.gate.set(Mode::Answer);
    assert!(advice(first).await.charged);
    assert_eq!(fixture.balance().await.spent, 1);
    fixture.stop().await;
}

#[tokio::test]
async fn more_callers_than_the_queue_has_room_for_wait_and_are_answered() {
    let (fixture, first) = Fixture::start_held_up(100_000).await;
    let n_callers = 3 * u32::try_from(QUEUE_CAPACITY).unwrap();
    let asked: Vec<_> = (0..n_callers).map(|step| fixture.spawn(question(2, step))).collect();
    fixture.waiting(QUEUE_CAPACITY).await;
    fixture.gate.set(Mode::Answer);
    assert!(advice(first).await.charged);
    for asked in asked {
        assert!(advice(asked).await.charged);
    }
    assert_eq!(fixture.balance().await.spent, u64::from(n_callers) + 1);
    fixture.stop().await;
}

#[tokio::test]
async fn a_ledger_that_is_away_is_asked_again() {
    let fixture = Fixture::start(10).await;
    fixture.gate.set(Mode::Refuse);
    for _ in 0..2 {
        let refused = fixture.handle.advise(question(1, 0)).await.unwrap_err().to_string();
        assert_eq!(refused, "the ledger cannot be used now: the disk is full");
    }
    fixture.gate.set(Mode::Answer);
    assert_eq!(fixture.handle.advise(question(1, 0)).await.unwrap().budget_left, 9);
    fixture.stop().await;
}

#[tokio::test]
async fn a_panic_fails_every_call_and_is_told() {
    let (fixture, first) = Fixture::start_held_up(10).await;
    let second = fixture.spawn_as(1, question(1, 1)).await;
    fixture.gate.set(Mode::Panic);
    assert!(matches!(first.await.unwrap(), Err(Error::Panicked)));
    assert!(matches!(second.await.unwrap(), Err(Error::Panicked)));
    fixture.stop.cancelled().await;
    assert!(matches!(fixture.handle.advise(question(1, 2)).await, Err(Error::Panicked)));
    assert!(matches!(fixture.thread.join(LONG).await, Err(Error::Panicked)));
}

#[tokio::test]
async fn a_thread_that_is_stuck_is_left_behind() {
    let (Fixture { thread, handle, gate, stop }, first) = Fixture::start_held_up(10).await;
    drop(handle);
    thread.join(Duration::from_millis(20)).await.unwrap();
    assert!(!stop.is_cancelled());
    gate.set(Mode::Answer);
    assert!(advice(first).await.charged);
    stop.cancelled().await;
}
