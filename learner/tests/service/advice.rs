//! Teachers that are away, refuse or forget.

use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use tandem_core::layout::EPISODE_STEPS;
use tandem_core::work::SlotOrder;
use tandem_core::{Episode, Task, TaskSpec};
use tandem_learner::checkpoint;
use tandem_learner::{Error, LearnerConfig};
use tandem_proto::pb;
use tandem_rl::RunConfig;
use tokio::net::TcpListener;
use tonic::Status;

use crate::service_tests::run::{DEADLINE, Left, Served, Toy, learner_config};
use crate::service_tests::teacher::FakeTeacher;
use crate::service_tests::toy::{UNITS, claim, config};

/// More than the toy spends.
const AMPLE: u64 = 10_000;
/// So few units that they run out on the way.
const SCARCE: u64 = 180;

pub(crate) fn advised(lag: u32, budget: u64) -> RunConfig {
    let mut config = config(lag);
    config.advice.strategy = "ea".to_owned();
    config.advice.share = 0.5;
    config.advice.budget = budget;
    config
}

pub(crate) fn with_teacher(
    run: RunConfig,
    out: &Path,
    resume: bool,
    address: SocketAddr,
) -> LearnerConfig {
    LearnerConfig { teacher: Some(address.to_string()), ..learner_config(run, out, resume) }
}

/// Charges the advised episodes of a slot, waiting for a teacher that does not know the account.
pub(crate) async fn charge(teacher: &FakeTeacher, order: &SlotOrder, episodes: &mut [Episode]) {
    charge_to("toy", teacher, order, episodes).await;
}

/// Charges the advised episodes of a slot to `account`.
async fn charge_to(
    account: &str,
    teacher: &FakeTeacher,
    order: &SlotOrder,
    episodes: &mut [Episode],
) {
    for (ordered, episode) in order.episodes.iter().zip(episodes) {
        if !ordered.advised {
            continue;
        }
        let charged = loop {
            let charged = teacher.books().charge(account, ordered.number, u64::from(UNITS));
            match charged {
                Some(charged) => break charged,
                None => tokio::time::sleep(Duration::from_millis(10)).await,
            }
        };
        claim(episode, u32::try_from(charged).expect("few"));
    }
}

async fn play_one(toy: &mut Toy, teacher: &FakeTeacher) -> bool {
    let Some((order, mut episodes)) = toy.take().await else { return false };
    charge(teacher, &order, &mut episodes).await;
    toy.deliver(order.slot, &episodes).await.is_ok()
}

/// Returns the warning that the progress shows, empty if there is none.
async fn warning(toy: &mut Toy) -> String {
    let progress = toy.client.status(pb::StatusRequest {}).await.expect("answers");
    progress.into_inner().warning
}

/// An advised run that nothing happens to, and its teacher.
async fn calm(run: RunConfig) -> (Left, FakeTeacher) {
    let directory = tempfile::tempdir().expect("a directory");
    let teacher = FakeTeacher::default();
    let address = teacher.serve().await;
    let served = Served::start(with_teacher(run, directory.path(), false, address)).await;
    let mut toy = served.join("toy").await;
    while play_one(&mut toy, &teacher).await {}
    let ended = served.end().await.expect("a run");
    (Left::behind(&ended, directory.path()), teacher)
}

/// 9 rounds of 8 episodes, half of them advised.
const N_ADVISED: u64 = 36;
/// The advised episodes of a round.
const N_OPEN: u64 = 4;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_lost_account_is_reopened_with_the_remaining_budget() {
    for lag in [0, 1] {
        for lost_after in [1, 6, 13, 30] {
            check_a_lost_account(lag, lost_after, SCARCE).await;
            check_a_lost_account(lag, lost_after, AMPLE).await;
        }
    }
}

/// Loses the account of a run with `budget` once `lost_after` slots are delivered.
async fn check_a_lost_account(lag: u32, lost_after: usize, budget: u64) {
    let directory = tempfile::tempdir().expect("a directory");
    let teacher = FakeTeacher::default();
    let address = teacher.serve().await;
    let run = advised(lag, budget);
    let served = Served::start(with_teacher(run, directory.path(), false, address)).await;
    let mut toy = served.join("toy").await;
    let (mut n_delivered, mut charged) = (0, 0);
    while play_one(&mut toy, &teacher).await {
        n_delivered += 1;
        if n_delivered == lost_after {
            let mut books = teacher.books();
            charged = books.charged_ever;
            books.accounts.clear();
        }
    }
    let ended = served.end().await.expect("the run ends");
    assert!(!ended.interrupted);
    let books = teacher.books();
    let [(first, _), (second, left)] = books.opened.as_slice() else {
        panic!("{:?}", books.opened);
    };
    assert_eq!((first.as_str(), second.as_str()), ("toy", "toy"), "workers ask as before");
    assert!(*left < budget && books.charged_ever <= budget, "{}", books.charged_ever);
    let written_off = N_OPEN * (1 + u64::from(lag)) * EPISODE_STEPS as u64;
    assert!(*left + charged + written_off >= budget, "{left} of {budget} after {charged}");
    let rows = Left::behind(&ended, directory.path()).rows;
    let last = rows.last().expect("rows");
    assert_eq!(last.advice_spent, books.charged_ever, "what was learned from");
    assert_eq!(last.budget_left, budget - last.advice_spent);
    if budget == AMPLE {
        assert_eq!(last.advice_spent, N_ADVISED * u64::from(UNITS), "advised to the end");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_account_lost_several_times_in_a_row_is_reopened_each_time() {
    for lag in [0, 1] {
        for n_losses in [2, 3] {
            let directory = tempfile::tempdir().expect("a directory");
            let teacher = FakeTeacher::default();
            let address = teacher.serve().await;
            let run = advised(lag, AMPLE);
            let served = Served::start(with_teacher(run, directory.path(), false, address)).await;
            let mut toy = served.join("toy").await;
            for _ in 0..5 {
                assert!(play_one(&mut toy, &teacher).await);
            }
            teacher.books().n_losses = n_losses;
            while play_one(&mut toy, &teacher).await {}
            let ended = served.end().await.expect("the run ends");
            assert!(!ended.interrupted);
            let books = teacher.books();
            assert_eq!((books.n_losses, books.opened.len()), (0, 1 + n_losses));
            let rows = Left::behind(&ended, directory.path()).rows;
            assert_eq!(rows.last().expect("rows").advice_spent, books.charged_ever);
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_waits_for_its_teacher_and_can_be_stopped_meanwhile() {
    for lag in [0, 1] {
        let (expected, teacher) = calm(advised(lag, AMPLE)).await;
        assert_eq!(teacher.books().charged_ever, N_ADVISED * u64::from(UNITS));
        for away_after in [2, 4, 9, 12] {
            let directory = tempfile::tempdir().expect("a directory");
            let teacher = FakeTeacher::default();
            let address = teacher.serve().await;
            let run = advised(lag, AMPLE);
            let served =
                Served::start(with_teacher(run.clone(), directory.path(), false, address)).await;
            let mut toy = served.join("toy").await;
            for _ in 0..away_after {
                assert!(play_one(&mut toy, &teacher).await);
            }
            teacher.books().refusal = Some(Status::unavailable("away"));
            let stops = async {
                tokio::time::sleep(Duration::from_millis(150)).await;
                served.shutdown.cancel();
            };
            let plays = async { while play_one(&mut toy, &teacher).await {} };
            tokio::join!(stops, plays);
            let ended = served.end().await.expect("saved");
            assert!(ended.interrupted && ended.digest.len() == 64, "{ended:?}");
            teacher.books().refusal = None;
            let again = Served::start(with_teacher(run, directory.path(), true, address)).await;
            let mut toy = again.join("toy").await;
            while play_one(&mut toy, &teacher).await {}
            let ended = again.end().await.expect("continues");
            let left = Left::behind(&ended, directory.path());
            assert_eq!(left, expected, "lag {lag}, away after {away_after}");
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_refusal_of_the_teacher_ends_the_run_after_saving() {
    let (expected, _) = calm(advised(1, AMPLE)).await;
    let other_terms = "account \"toy\" is open with budget 1";
    for (status, reason) in [
        (Status::unauthenticated("no"), "requires a token: name its file in --token-file"),
        (Status::already_exists(other_terms), other_terms),
    ] {
        let directory = tempfile::tempdir().expect("a directory");
        let teacher = FakeTeacher::default();
        let address = teacher.serve().await;
        let run = advised(1, AMPLE);
        let served =
            Served::start(with_teacher(run.clone(), directory.path(), false, address)).await;
        let mut toy = served.join("toy").await;
        for _ in 0..10 {
            assert!(play_one(&mut toy, &teacher).await);
        }
        teacher.books().refusal = Some(status);
        while play_one(&mut toy, &teacher).await {}
        let error = served.end().await.expect_err("the run ends");
        assert!(matches!(error, Error::Teacher(_)), "{error}");
        let message = error.to_string();
        assert!(message.starts_with("the teacher refuses to "), "{message}");
        assert!(message.ends_with(reason), "{message}");
        assert!(!checkpoint::list(&directory.path().join("checkpoint")).is_empty());
        teacher.books().refusal = None;
        let again = Served::start(with_teacher(run, directory.path(), true, address)).await;
        let mut toy = again.join("toy").await;
        while play_one(&mut toy, &teacher).await {}
        let ended = again.end().await.expect("continues");
        assert_eq!(Left::behind(&ended, directory.path()), expected);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_resumed_run_finds_its_account_in_every_state_of_the_ledger() {
    let half = config(0).stop.max_env_steps / 2;
    // Changes of the ledger between two runs, and the accounts after them.
    type Change = fn(&mut FakeTeacher);
    let kept: Change = |_| ();
    let lost: Change = |teacher| teacher.books().accounts.clear();
    let put_back: Change = |teacher| {
        if let Some(account) = teacher.books().accounts.get_mut("toy") {
            account.spent = 0;
        }
    };
    // After 5 rounds 20 episodes were charged 7 units.
    let spent = 20 * u64::from(UNITS);
    let renamed = format!("toy.from-{spent}");
    for (change, expected) in [
        (kept, vec![("toy".to_owned(), AMPLE)]),
        (lost, vec![("toy".to_owned(), AMPLE), ("toy".to_owned(), AMPLE - spent)]),
        (put_back, vec![("toy".to_owned(), AMPLE), (renamed, AMPLE - spent)]),
    ] {
        let directory = tempfile::tempdir().expect("a directory");
        let mut teacher = FakeTeacher::default();
        let address = teacher.serve().await;
        let mut run = advised(0, AMPLE);
        run.stop.max_env_steps = half;
        let served =
            Served::start(with_teacher(run.clone(), directory.path(), false, address)).await;
        let mut toy = served.join("toy").await;
        while play_one(&mut toy, &teacher).await {}
        served.end().await.expect("the first half");
        change(&mut teacher);
        run.stop.max_env_steps = 2 * half;
        let again = Served::start(with_teacher(run, directory.path(), true, address)).await;
        again.join("toy").await;
        again.shutdown.cancel();
        again.end().await.expect("resumed");
        assert_eq!(teacher.books().opened, expected);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_keeps_the_account_that_it_opened_after_a_loss_of_charges() {
    let directory = tempfile::tempdir().expect("a directory");
    let teacher = FakeTeacher::default();
    let address = teacher.serve().await;
    let mut run = advised(0, AMPLE);
    let whole = run.stop.max_env_steps;
    run.stop.max_env_steps = whole / 2;
    let served = Served::start(with_teacher(run.clone(), directory.path(), false, address)).await;
    let mut toy = served.join("toy").await;
    while play_one(&mut toy, &teacher).await {}
    served.end().await.expect("the first half");
    if let Some(account) = teacher.books().accounts.get_mut("toy") {
        account.spent = 0;
    }
    let spent = 20 * u64::from(UNITS);
    let renamed = format!("toy.from-{spent}");
    let expected = [("toy".to_owned(), AMPLE), (renamed.clone(), AMPLE - spent)];
    run.stop.max_env_steps = whole;
    // Each resumed part plays more than a round, so it ends with other charges than it began with.
    for _ in 0..2 {
        let config = with_teacher(run.clone(), directory.path(), true, address);
        let served = Served::start(config).await;
        let mut toy = served.join("toy").await;
        for _ in 0..6 {
            let (order, mut episodes) = toy.take().await.expect("a slot");
            charge_to(&renamed, &teacher, &order, &mut episodes).await;
            toy.deliver(order.slot, &episodes).await.expect("taken");
        }
        assert_eq!(warning(&mut toy).await, "");
        served.shutdown.cancel();
        served.end().await.expect("interrupted");
        assert_eq!(teacher.books().opened, expected);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_new_run_warns_of_an_account_that_a_run_of_the_same_name_has_used() {
    let (_, teacher) = calm(advised(0, AMPLE)).await;
    let address = teacher.serve().await;
    let directory = tempfile::tempdir().expect("a directory");
    let used = "the teacher's account \"toy\" was used before, 252 units are spent: ";
    for (resume, run_file, expected) in [
        (false, None, used),
        // A run that ended before its first checkpoint has used the account itself.
        (true, None, ""),
        // A supervisor's command starts a run and, the second time, continues it.
        (true, Some("name = \"toy\""), used),
        (true, Some("name = \"toy\""), ""),
    ] {
        let run = advised(0, AMPLE);
        let config = with_teacher(run, directory.path(), resume, address);
        let run_file = run_file.map(str::to_owned);
        let served = Served::start(LearnerConfig { run_file, ..config }).await;
        let mut toy = served.join("toy").await;
        let warning = warning(&mut toy).await;
        assert_eq!(warning.is_empty(), expected.is_empty(), "{warning}");
        assert!(warning.starts_with(expected), "{warning}");
        served.shutdown.cancel();
        served.end().await.expect("stopped");
        std::fs::remove_dir_all(directory.path().join("checkpoint")).expect("saved");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_teacher_restarted_with_another_policy_is_warned_of() {
    let directory = tempfile::tempdir().expect("a directory");
    let teacher = FakeTeacher::default();
    teacher.books().policy_digest = "5f3a".repeat(16);
    let address = teacher.serve().await;
    let run = advised(0, AMPLE);
    let served = Served::start(with_teacher(run, directory.path(), false, address)).await;
    let mut toy = served.join("toy").await;
    tokio::time::sleep(Duration::from_millis(1500)).await;
    assert_eq!(warning(&mut toy).await, "", "the same policy");
    teacher.books().policy_digest = "0b1c".repeat(16);
    let warned = async {
        loop {
            match warning(&mut toy).await {
                text if text.is_empty() => tokio::time::sleep(Duration::from_millis(20)).await,
                text => break text,
            }
        }
    };
    let text = tokio::time::timeout(DEADLINE, warned).await.expect("there is a warning");
    let expected =
        "the teacher was restarted with another policy, 0b1c0b1c0b1c instead of 5f3a5f3a5f3a, ";
    assert!(text.starts_with(expected), "{text}");
    served.shutdown.cancel();
    served.end().await.expect("stopped");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_resumed_with_another_policy_of_its_teacher_is_warned_of() {
    let directory = tempfile::tempdir().expect("a directory");
    let teacher = FakeTeacher::default();
    teacher.books().policy_digest = "5f3a".repeat(16);
    let address = teacher.serve().await;
    let mut run = advised(0, AMPLE);
    run.stop.max_env_steps /= 2;
    let served = Served::start(with_teacher(run.clone(), directory.path(), false, address)).await;
    let mut toy = served.join("toy").await;
    while play_one(&mut toy, &teacher).await {}
    served.end().await.expect("the first half");
    run.stop.max_env_steps *= 2;
    let other =
        "the teacher was restarted with another policy, 0b1c0b1c0b1c instead of 5f3a5f3a5f3a, ";
    let both = "the teacher advised by another policy for a while and has its first one, 5f3a5f3a5f3a, again: ";
    // However often the run is resumed, the policy counts with which it began, and the run has learned from both.
    for (policy, expected) in
        [("5f3a", ""), ("0b1c", other), ("0b1c", other), ("5f3a", both), ("5f3a", both)]
    {
        teacher.books().policy_digest = policy.repeat(16);
        let config = with_teacher(run.clone(), directory.path(), true, address);
        let served = Served::start(config).await;
        let mut toy = served.join("toy").await;
        let warning = warning(&mut toy).await;
        assert_eq!(warning.is_empty(), expected.is_empty(), "{warning}");
        assert!(warning.starts_with(expected), "{warning}");
        served.shutdown.cancel();
        served.end().await.expect("stopped");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_short_horizon_reserves_only_the_units_of_its_steps() {
    let directory = tempfile::tempdir().expect("a directory");
    let teacher = FakeTeacher::default();
    let address = teacher.serve().await;
    // In the last round 76 units are left for four episodes of 20 guided steps each, of which each uses 7.
    let spent = N_ADVISED * u64::from(UNITS);
    let mut run = advised(0, spent + 48);
    run.advice.strategy = "jsrl:20".to_owned();
    let served = Served::start(with_teacher(run, directory.path(), false, address)).await;
    let mut toy = served.join("toy").await;
    while play_one(&mut toy, &teacher).await {}
    let ended = served.end().await.expect("a run");
    let rows = Left::behind(&ended, directory.path()).rows;
    let last = rows.last().expect("rows");
    assert_eq!((last.advice_spent, last.budget_left), (spent, 48));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_teacher_for_another_task_is_refused_and_the_field_named() {
    let directory = tempfile::tempdir().expect("a directory");
    let teacher = FakeTeacher::default();
    teacher.books().task = Some(TaskSpec::built_in(Task::PickAndPlace, 1));
    let address = teacher.serve().await;
    let run = advised(0, AMPLE);
    let served = Served::start(with_teacher(run, directory.path(), false, address)).await;
    let error = served.end().await.expect_err("another task").to_string();
    let expected = "the teacher is for another task than one arm of the run's: name is \"push\" in the run and \
                    \"pick-and-place\" at the teacher";
    assert_eq!(error, expected);
    assert!(teacher.books().opened.is_empty());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_stopped_before_its_teacher_answers_reports_its_digest() {
    let directory = tempfile::tempdir().expect("a directory");
    // Nobody answers there: connections are accepted and nothing is said.
    let silent = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = silent.local_addr().expect("bound");
    let run = advised(0, AMPLE);
    let served = Served::start(with_teacher(run, directory.path(), false, address)).await;
    tokio::time::sleep(Duration::from_millis(100)).await;
    served.shutdown.cancel();
    let ended = served.end().await.expect("stopped");
    assert!(ended.interrupted && ended.digest.len() == 64, "{ended:?}");
}
