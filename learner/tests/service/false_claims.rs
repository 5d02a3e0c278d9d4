//! Workers that claim advice falsely, and workers that crowd out others.

use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use tandem_core::work::SlotOrder;
use tandem_core::{Episode, EpisodeKind};
use tandem_learner::{LearnerConfig, RunOutcome};
use tandem_proto::pb::learner_client::LearnerClient;
use tandem_proto::{encode_episode, pb};
use tokio::task::JoinHandle;
use tonic::transport::Channel;
use tonic::{Code, Status};

use crate::service_tests::advice::{advised, charge, with_teacher};
use crate::service_tests::resume::copies_of;
use crate::service_tests::run::{Left, Served, Toy, VERSION, calm, learner_config};
use crate::service_tests::teacher::FakeTeacher;
use crate::service_tests::toy::{UNITS, claim, config};

/// More than the toy spends.
const BUDGET: u64 = 2000;

/// Follows a run to its end and returns its warnings.
fn follow(mut client: LearnerClient<Channel>) -> JoinHandle<Vec<String>> {
    tokio::spawn(async move {
        let mut warnings: Vec<String> = Vec::new();
        let watched = client.watch(pb::WatchRequest {}).await.expect("a stream");
        let mut stream = watched.into_inner();
        while let Ok(Some(progress)) = stream.message().await {
            if !progress.warning.is_empty() && warnings.last() != Some(&progress.warning) {
                warnings.push(progress.warning);
            }
        }
        warnings
    })
}

/// Changes what a worker claims about an advised episode, regardless of the charges.
type FalseClaim = fn(&mut Episode);

/// Plays a slot with false claims about its advised episodes; charges the teacher if it `asks`.
async fn claim_once(
    toy: &mut Toy,
    teacher: &FakeTeacher,
    asks: bool,
    false_claim: FalseClaim,
) -> bool {
    let Some((order, mut episodes)) = toy.take().await else { return false };
    if asks {
        charge(teacher, &order, &mut episodes).await;
    }
    for (ordered, episode) in order.episodes.iter().zip(&mut episodes) {
        if ordered.advised && order.kind == EpisodeKind::Training {
            false_claim(episode);
        }
    }
    toy.deliver(order.slot, &episodes).await.is_ok()
}

/// Runs a run whose only worker claims falsely; returns its outcome and its warnings.
async fn run_with_false_claims(
    config: LearnerConfig,
    teacher: &FakeTeacher,
    asks: bool,
    false_claim: FalseClaim,
) -> (RunOutcome, Vec<String>) {
    let served = Served::start(config).await;
    let mut toy = served.join("claimant").await;
    let warnings = follow(served.client().await);
    while claim_once(&mut toy, teacher, asks, false_claim).await {}
    let ended = served.end().await.expect("a run");
    (ended, warnings.await.expect("followed"))
}

fn spent(out: &Path, ended: &RunOutcome) -> (u64, u64) {
    let rows = Left::behind(ended, out).rows;
    rows.last().map(|row| (row.advice_spent, row.budget_left)).expect("rows")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_claim_that_the_teachers_account_contradicts_is_reported_and_the_account_counts() {
    // 9 rounds of 4 advised episodes.
    let charged_in_all = 36 * u64::from(UNITS);
    let all_advised: FalseClaim = |episode| claim(episode, 50);
    let none_advised: FalseClaim = |episode| claim(episode, 0);
    let one_less: FalseClaim = |episode| claim(episode, UNITS - 1);
    for (asks, false_claim, charged, claimed_in_round) in [
        (false, all_advised, 0, 200),
        (true, none_advised, charged_in_all, 0),
        (true, one_less, charged_in_all, 4 * u64::from(UNITS - 1)),
    ] {
        for lag in [0, 1] {
            let directory = tempfile::tempdir().expect("a directory");
            let (out, teacher) = (directory.path(), FakeTeacher::default());
            let address = teacher.serve().await;
            let config = with_teacher(advised(lag, BUDGET), out, false, address);
            let (ended, warnings) =
                run_with_false_claims(config, &teacher, asks, false_claim).await;
            let charged_in_round = charged / 9;
            let expected = format!(
                "the episodes of round 0 claim {claimed_in_round} units of advice, the teacher's account \"toy\" was \
                 charged {charged_in_round}: the account counts"
            );
            assert_eq!(warnings, [expected]);
            assert_eq!(spent(out, &ended), (charged, BUDGET - charged));
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn false_claims_are_reported_next_to_an_account_that_was_used_before() {
    let teacher = FakeTeacher::default();
    let address = teacher.serve().await;
    let first = tempfile::tempdir().expect("a directory");
    let config = with_teacher(advised(0, BUDGET), first.path(), false, address);
    run_with_false_claims(config, &teacher, true, |_| ()).await;
    let second = tempfile::tempdir().expect("a directory");
    let config = with_teacher(advised(0, BUDGET), second.path(), false, address);
    let all_advised: FalseClaim = |episode| claim(episode, 50);
    let (_, warnings) = run_with_false_claims(config, &teacher, false, all_advised).await;
    let last = warnings.last().expect("warnings");
    assert!(last.starts_with("the teacher's account \"toy\" was used before, "), "{last}");
    // The earlier run was charged 252 units, which the episodes of round 0 may claim.
    let claims = "; the episodes of round 1 claim 200 units of advice, the teacher's account \"toy\" was charged 52";
    assert!(last.contains(claims), "{last}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_resumed_after_false_claims_continues_with_its_account() {
    let directory = tempfile::tempdir().expect("a directory");
    let (out, teacher) = (directory.path(), FakeTeacher::default());
    let address = teacher.serve().await;
    let whole = advised(0, BUDGET);
    let mut half = whole.clone();
    half.stop.max_env_steps /= 2;
    let config = with_teacher(half, out, false, address);
    run_with_false_claims(config, &teacher, false, |episode| claim(episode, 50)).await;
    let served = Served::start(with_teacher(whole, out, true, address)).await;
    let mut toy = served.join("honest").await;
    let warnings = follow(served.client().await);
    while claim_once(&mut toy, &teacher, true, |_| ()).await {}
    let ended = served.end().await.expect("a run");
    assert_eq!(warnings.await.expect("followed"), [""; 0]);
    let charged = 16 * u64::from(UNITS);
    assert_eq!(teacher.books().opened, [("toy".to_owned(), BUDGET)]);
    assert_eq!(spent(out, &ended), (charged, BUDGET - charged));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn contradictory_claims_are_refused_and_true_ones_accepted() {
    let teacher = FakeTeacher::default();
    let directory = tempfile::tempdir().expect("a directory");
    // Enough for the first episode of a round and a part of the second.
    let run = advised(0, 60);
    let address = teacher.serve().await;
    let served = Served::start(with_teacher(run, directory.path(), false, address)).await;
    let mut toys = [served.join("a").await, served.join("b").await];
    let mut slots: Vec<(SlotOrder, Vec<Episode>)> = Vec::new();
    for toy in &mut toys {
        slots.push(toy.take().await.expect("a slot"));
    }
    slots.sort_by_key(|(order, _)| order.slot);
    let mut refused = async |slot: usize, spoil: fn(&mut Episode), refusal: &str| {
        let (order, mut episodes) = slots[slot].clone();
        let at = order.episodes.iter().position(|ordered| ordered.advised).expect("one is");
        spoil(&mut episodes[at]);
        let status = toys[0].deliver(order.slot, &episodes).await.expect_err("must be refused");
        assert_eq!(status.code(), Code::InvalidArgument);
        let number = episodes[at].number;
        let refusal = format!("episode {number}: advice_charged: {refusal}");
        assert!(status.message().ends_with(&refusal), "{}", status.message());
    };
    let claims_without_arms: fn(&mut Episode) = |episode| {
        claim(episode, 0);
        episode.advice_charged = 50;
    };
    refused(0, claims_without_arms, "expected 0, the steps with an advised arm, got 50").await;
    let hides_arms: fn(&mut Episode) = |episode| {
        claim(episode, 7);
        episode.advice_charged = 0;
    };
    refused(0, hides_arms, "expected 7, the steps with an advised arm, got 0").await;
    let beyond = "expected at most 10, the units reserved for it, got 11";
    refused(1, |episode| claim(episode, 11), beyond).await;
    served.shutdown.cancel();
    served.end().await.expect("interrupted");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn advice_without_an_order_and_implausible_numbers_are_refused() {
    let expected = calm(config(0)).await;
    let directory = tempfile::tempdir().expect("a directory");
    let served = Served::start(learner_config(config(0), directory.path(), false)).await;
    let mut toy = served.join("claimant").await;
    let put = |bytes: &mut [u8], at: usize, value: f32| {
        bytes[4 * at..4 * at + 4].copy_from_slice(&value.to_le_bytes());
    };
    type Spoil<'a> = &'a dyn Fn(&mut pb::Episode);
    let arm: Spoil<'_> = &|episode| episode.advised_arms[3] = 1;
    let far: Spoil<'_> = &|episode| put(&mut episode.observations, 28 + 3, 1e29);
    let goal: Spoil<'_> = &|episode| put(&mut episode.goal, 2, -3e38);
    let turned: Spoil<'_> = &|episode| put(&mut episode.observations, 12, 1.5);
    let all = [
        (
            arm,
            "advised_arms: expected no advised arm, as no advice was ordered, got 0b00000001 on step 3",
        ),
        (far, "observations[31]: expected a number in [-25, 25], got 1e29"),
        (goal, "goal[2]: expected a number in [-2, 2], got -3e38"),
        (turned, "observations[12]: expected a number in [-1.01, 1.01], got 1.5e0"),
    ];
    // Training slots and, after the second round, evaluations.
    let mut kinds = Vec::new();
    while let Some((order, episodes)) = toy.take().await {
        kinds.push(order.kind);
        for (spoil, refusal) in &all {
            let mut messages: Vec<pb::Episode> = episodes.iter().map(encode_episode).collect();
            spoil(&mut messages[0]);
            let request = pb::SubmitEpisodesRequest {
                worker_id: toy.id,
                slot: order.slot,
                episodes: messages,
                environment_check: None,
            };
            let refused = toy.client.submit_episodes(request).await.expect_err("must be refused");
            assert_eq!(refused.code(), Code::InvalidArgument);
            let refusal = format!("episode {}: {refusal}", episodes[0].number);
            assert!(refused.message().ends_with(&refusal), "{}", refused.message());
        }
        toy.deliver(order.slot, &episodes).await.expect("the right ones are taken");
    }
    assert!(kinds.contains(&EpisodeKind::Training) && kinds.contains(&EpisodeKind::Evaluation));
    let ended = served.end().await.expect("a run");
    assert_eq!(Left::behind(&ended, directory.path()), expected, "nothing of it was used");
}

async fn join_by(client: &mut LearnerClient<Channel>) -> Result<u64, Status> {
    let request = pb::JoinRequest { worker: "flood".to_owned(), version: VERSION.to_owned() };
    Ok(client.join(request).await?.into_inner().worker_id)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn ten_thousand_joins_do_not_keep_other_workers_out() {
    let expected = calm(config(0)).await;
    let directory = tempfile::tempdir().expect("a directory");
    let served = Served::start(learner_config(config(0), directory.path(), false)).await;
    // Waits until the run has begun.
    served.join("early").await;
    let mut flood = served.client().await;
    for _ in 0..10_000 {
        join_by(&mut flood).await.expect("taken in");
    }
    let mut honest = served.join("honest").await;
    while honest.play_one().await {
        join_by(&mut flood).await.ok();
    }
    let ended = served.end().await.expect("a run");
    assert_eq!(Left::behind(&ended, directory.path()), expected);
}

/// Plays slots until the progress, which is published between rounds, shows workers of these names.
async fn play_until_shown(toy: &mut Toy, names: &[&str]) {
    loop {
        let progress = toy.client.status(pb::StatusRequest {}).await.expect("it serves");
        let workers = progress.into_inner().workers;
        if workers.iter().map(|worker| worker.name.as_str()).eq(names.iter().copied()) {
            return;
        }
        assert!(toy.play_one().await, "the run has ended");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn joins_end_with_their_connection() {
    let directory = tempfile::tempdir().expect("a directory");
    let served = Served::start(learner_config(config(0), directory.path(), false)).await;
    let mut honest = served.join("honest").await;
    let mut flood = served.client().await;
    join_by(&mut flood).await.expect("taken in");
    play_until_shown(&mut honest, &["honest", "flood"]).await;
    drop(flood);
    play_until_shown(&mut honest, &["honest"]).await;
    served.shutdown.cancel();
    served.end().await.expect("interrupted");
}

/// Resumes a run from `out` with an honest worker: what it leaves, and every warning.
async fn resume(
    lag: u32,
    budget: u64,
    out: &Path,
    teacher: &FakeTeacher,
    address: SocketAddr,
) -> (Left, Vec<String>) {
    let served = Served::start(with_teacher(advised(lag, budget), out, true, address)).await;
    let mut toy = served.join("honest").await;
    let warnings = follow(served.client().await);
    while claim_once(&mut toy, teacher, true, |_| ()).await {}
    let ended = served.end().await.expect("a run");
    (Left::behind(&ended, out), warnings.await.expect("followed"))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_honest_run_raises_no_warning_wherever_it_is_resumed() {
    // With a budget that runs out, and with one that does not.
    for (lag, budget) in [(0, 150), (1, 150), (0, BUDGET), (1, BUDGET)] {
        let keep = tempfile::tempdir().expect("a directory");
        let (out, teacher) = (keep.path().join("run"), FakeTeacher::default());
        let address = teacher.serve().await;
        let served = Served::start(with_teacher(advised(lag, budget), &out, false, address)).await;
        let mut toy = served.join("honest").await;
        let warnings = follow(served.client().await);
        let mut moments = copies_of(&out, keep.path());
        while claim_once(&mut toy, &teacher, true, |_| ()).await {
            moments.copy();
        }
        let ended = served.end().await.expect("a run");
        let expected = Left::behind(&ended, &out);
        assert_eq!(warnings.await.expect("followed"), [""; 0]);
        // The teacher has been charged for the whole run, whatever the copy knows of it.
        for (n, copy) in moments.copies.iter().enumerate().step_by(6) {
            let (left, warnings) = resume(lag, budget, copy, &teacher, address).await;
            assert_eq!(warnings, [""; 0], "lag {lag}, budget {budget}, moment {n}");
            assert_eq!(left, expected, "lag {lag}, budget {budget}, moment {n}");
        }
    }
}
