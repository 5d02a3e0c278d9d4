//! A worker with a learner and a teacher on the loopback interface that fail in various ways.

mod environments;
mod support;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use tandem_core::text::error_chain;
use tandem_core::work::{RunTerms, SlotOrder};
use tandem_core::{Episode, EpisodeKind};
use tandem_net::{Backoff, ClientConfig, Pacing};
use tandem_policy::{Actor, actor_digest, symmetrized_actor};
use tandem_telemetry::read_episode;
use tandem_worker::{
    Error, Liveness, RecordedEpisodes, RecordingConfig, Timeouts, WorkerConfig, run_with,
};
use tokio_util::sync::CancellationToken;
use tonic::Status;

use support::learner::{Call, FakeLearner, Fault};
use support::teacher::FakeTeacher;
use support::{LAYOUT, Server, actor, orders, terms};

const TIMEOUTS: Timeouts = Timeouts {
    backoff: Backoff {
        first_pause: Duration::from_millis(1),
        max_pause: Duration::from_millis(10),
    },
    call: Duration::from_secs(20),
    work: Duration::from_secs(20),
    advice: Duration::from_secs(20),
    drain: Duration::from_millis(20),
};

fn config(learner: &Server, teacher: Option<&Server>) -> WorkerConfig {
    WorkerConfig {
        environment: None,
        client: ClientConfig::default(),
        learner: learner.address(),
        teacher: teacher.map(Server::address),
        name: "test".to_owned(),
        recording: None,
        pacing: Pacing::Concurrent,
        liveness: Liveness::default(),
    }
}

/// Runs a worker until all slots of `learner` are delivered; returns the delivered episodes by kind and number.
async fn play_run(
    learner: &Arc<FakeLearner>,
    teacher: &Arc<FakeTeacher>,
) -> BTreeMap<(bool, u64), Episode> {
    let (learner_server, teacher_server) = (Server::learner(learner), Server::teacher(teacher));
    let config = config(&learner_server, Some(&teacher_server));
    run_with(config, TIMEOUTS, CancellationToken::new()).await.expect("the run ends");
    learner.episodes()
}

async fn episodes_without_faults() -> BTreeMap<(bool, u64), Episode> {
    play_run(&Arc::new(FakeLearner::new(orders())), &Arc::new(FakeTeacher::default())).await
}

#[tokio::test]
async fn every_slot_is_played_and_delivered() {
    let teacher = Arc::new(FakeTeacher::default());
    let learner = Arc::new(FakeLearner::new(orders()));
    let episodes = play_run(&learner, &teacher).await;
    let played: Vec<(bool, u64)> = episodes.keys().copied().collect();
    assert_eq!(played, [(false, 0), (false, 1), (false, 2), (false, 3), (true, 0), (true, 1)]);
    for ((is_evaluation, number), episode) in &episodes {
        let advised = !is_evaluation && *number != 3;
        let expected = if advised { teacher.n_charged(*number) } else { 0 };
        assert_eq!(episode.advice_charged, expected, "episode {number}");
        assert_eq!(episode.advised_arms.iter().any(|arms| *arms != 0), advised, "episode {number}");
        assert_eq!(episode.kind == EpisodeKind::Evaluation, *is_evaluation);
    }
    assert_eq!(learner.n_calls(Call::GetParameters), 2, "once a version");
    assert_eq!(learner.n_calls(Call::Join), 1);
}

#[tokio::test]
async fn a_learner_with_failing_calls_gets_the_same_episodes() {
    let expected = episodes_without_faults().await;
    let check = async |call, nth, fault| {
        let learner = Arc::new(FakeLearner::new(orders()).with_fault(call, nth, fault));
        let episodes = play_run(&learner, &Arc::new(FakeTeacher::default())).await;
        assert_eq!(episodes, expected, "{call:?} {nth}");
        learner
    };
    let away = || Fault::Answer(Status::unavailable("starting"));
    for (call, nth) in
        [(Call::Join, 0), (Call::NextWork, 1), (Call::GetParameters, 1), (Call::Submit, 1)]
    {
        check(call, nth, away()).await;
    }
    check(Call::Submit, 0, Fault::AnswerLost).await;
    check(Call::GetParameters, 0, Fault::Answer(Status::not_found("no such version"))).await;
    let learner = check(Call::NextWork, 1, Fault::WorkersForgotten).await;
    assert_eq!(learner.n_calls(Call::Join), 2);
    let learner = check(Call::Submit, 1, Fault::WorkersForgotten).await;
    assert_eq!(learner.n_calls(Call::Join), 2);
    let learner = check(Call::NextWork, 1, Fault::Stopped).await;
    assert_eq!(learner.n_calls(Call::Join), 2);
}

#[tokio::test]
async fn a_restarted_learner_gets_the_same_episodes() {
    let expected = episodes_without_faults().await;
    let (learner, mut at_fault) = FakeLearner::new(orders()).hanging_at(Call::Submit, 1);
    let (learner, teacher) = (Arc::new(learner), Arc::new(FakeTeacher::default()));
    let (first_life, teacher_server) = (Server::learner(&learner), Server::teacher(&teacher));
    let config = config(&first_life, Some(&teacher_server));
    let worker = tokio::spawn(run_with(config, TIMEOUTS, CancellationToken::new()));
    at_fault.recv().await.expect("the learner gets there");
    let listener = first_life.kill();
    learner.forget_workers();
    let _second_life = Server::learner_on(listener, &learner);
    worker.await.expect("no panic").expect("the run ends");
    assert_eq!(learner.episodes(), expected);
}

#[tokio::test]
async fn a_stream_that_breaks_within_an_episode_changes_nothing() {
    let expected = episodes_without_faults().await;
    for fault in [
        Status::unavailable("restarting"),
        Status::not_found("no account yet"),
        Status::ok("closing"),
    ] {
        let teacher = Arc::new(FakeTeacher::default().failing_at([0, 7, 8, 60], &fault));
        let learner = Arc::new(FakeLearner::new(orders()));
        assert_eq!(play_run(&learner, &teacher).await, expected, "{fault:?}");
        assert_eq!(learner.n_calls(Call::Join), 1);
    }
}

#[tokio::test]
async fn a_recorded_episode_gets_a_log_with_its_run_and_policy() {
    let logs = tempfile::tempdir().expect("a directory");
    let (learner, teacher) =
        (Arc::new(FakeLearner::new(orders())), Arc::new(FakeTeacher::default()));
    let (learner_server, teacher_server) = (Server::learner(&learner), Server::teacher(&teacher));
    let recording = Some(RecordingConfig {
        directory: logs.path().join("mcap"),
        episodes: RecordedEpisodes::Evaluation,
        budget_bytes: u64::MAX,
    });
    let config = WorkerConfig { recording, ..config(&learner_server, Some(&teacher_server)) };
    run_with(config, TIMEOUTS, CancellationToken::new()).await.expect("the run ends");
    let names: Vec<_> = std::fs::read_dir(logs.path().join("mcap"))
        .expect("made by the worker")
        .map(|entry| entry.expect("readable").file_name())
        .collect();
    assert_eq!(names, ["eval-000002-001.mcap"]);
    let log = read_episode(&logs.path().join("mcap").join("eval-000002-001.mcap"));
    let metadata = log.expect("a whole log").metadata;
    assert_eq!(metadata.run, "run-7", "the run's name, not the account's");
    assert_eq!(metadata.policy_digest, actor_digest(&LAYOUT.into(), &actor(2)));
    assert_ne!(metadata.policy_digest, actor_digest(&LAYOUT.into(), &actor(1)));
}

#[tokio::test]
async fn evaluation_episodes_alone_are_played_with_the_symmetrised_actor_of_terms_that_say_so() {
    let expected = episodes_without_faults().await;
    // A training slot after the evaluation, with the same parameters.
    let mut orders = orders();
    orders[1] = SlotOrder { slot: 3, parameter_version: 2, ..orders[1].clone() };
    orders.swap(1, 2);
    let terms = RunTerms { symmetrized_evaluation: true, ..terms() };
    let play = async |terms| {
        let learner = Arc::new(FakeLearner::new(orders.clone()).with_terms(terms));
        play_run(&learner, &Arc::new(FakeTeacher::default())).await
    };
    let (plain, symmetrised) = (play(support::terms()).await, play(terms).await);
    assert_eq!(symmetrised[&(false, 2)], plain[&(false, 2)]);
    assert_eq!(plain[&(true, 0)], expected[&(true, 0)]);
    let actions = &symmetrised[&(true, 0)].actions;
    assert_ne!(*actions, expected[&(true, 0)].actions);
    let published = symmetrized_actor(&LAYOUT.into(), &actor(2));
    let mut actor = Actor::new(LAYOUT, published).expect("as valid as the actor");
    let mut first = vec![0.0; LAYOUT.n_action()];
    let episode = &symmetrised[&(true, 0)];
    actor.act(&episode.observations[..LAYOUT.n_observation()], &episode.goal, &mut first);
    assert_eq!(actions[..LAYOUT.n_action()], first);
}

#[tokio::test]
async fn a_request_without_an_answer_is_repeated() {
    let expected = episodes_without_faults().await;
    let (teacher, _at_fault) = FakeTeacher::default().hanging_at(3);
    let (learner, teacher) = (Arc::new(FakeLearner::new(orders())), Arc::new(teacher));
    let (learner_server, teacher_server) = (Server::learner(&learner), Server::teacher(&teacher));
    let config = config(&learner_server, Some(&teacher_server));
    let timeouts = Timeouts { advice: Duration::from_millis(40), ..TIMEOUTS };
    run_with(config, timeouts, CancellationToken::new()).await.expect("the run ends");
    assert_eq!(learner.episodes(), expected);
}

#[tokio::test]
async fn advice_on_other_steps_ends_the_worker() {
    let learner = Arc::new(FakeLearner::new(orders()));
    let teacher = Arc::new(FakeTeacher::default().forgetful_at(3));
    let (learner_server, teacher_server) = (Server::learner(&learner), Server::teacher(&teacher));
    let config = config(&learner_server, Some(&teacher_server));
    let error =
        run_with(config, TIMEOUTS, CancellationToken::new()).await.expect_err("one answer of two");
    let told = error_chain(&error);
    assert!(told.starts_with("cannot ask the teacher: "), "{told}");
    assert!(told.contains("expected steps 2, got 1"), "{told}");
    assert!(learner.episodes().is_empty());
}

#[tokio::test]
async fn refusals_end_the_worker_with_one_clear_error() {
    let learner = Arc::new(FakeLearner::new(orders()).with_fault(
        Call::Join,
        0,
        Fault::Answer(Status::failed_precondition("this run needs version 9")),
    ));
    let server = Server::learner(&learner);
    let error = run_with(config(&server, None), TIMEOUTS, CancellationToken::new())
        .await
        .expect_err("refused");
    assert!(matches!(error, Error::Protocol { .. }), "{error:?}");
    let told = error_chain(&error);
    assert!(told.starts_with("cannot join the run: "), "{told}");
    assert!(told.contains("this run needs version 9"), "{told}");
    assert_eq!(learner.n_calls(Call::Join), 1, "not asked again");
}

#[tokio::test]
async fn an_advised_run_needs_a_teacher() {
    let server = Server::learner(&Arc::new(FakeLearner::new(orders())));
    let error = run_with(config(&server, None), TIMEOUTS, CancellationToken::new())
        .await
        .expect_err("no teacher");
    assert!(
        matches!(error, Error::NoTeacher { account } if Some(&account) == terms().account.as_ref())
    );
}

#[tokio::test]
async fn a_worker_that_waits_for_its_teacher_can_be_stopped() {
    let (teacher, mut at_fault) = FakeTeacher::default().hanging_at(3);
    let (learner, teacher) = (Arc::new(FakeLearner::new(orders())), Arc::new(teacher));
    let (learner_server, teacher_server) = (Server::learner(&learner), Server::teacher(&teacher));
    let shutdown = CancellationToken::new();
    let config = config(&learner_server, Some(&teacher_server));
    let worker = tokio::spawn(run_with(config, TIMEOUTS, shutdown.clone()));
    at_fault.recv().await.expect("the teacher gets there");
    shutdown.cancel();
    worker.await.expect("no panic").expect("stops without an error");
    assert!(learner.episodes().is_empty(), "what was not advised to the end is not delivered");
}

#[tokio::test]
async fn a_worker_that_is_stopped_delivers_its_slot() {
    let learner = Arc::new(FakeLearner::new(orders()));
    let (teacher, mut at_fault) = FakeTeacher::default().signalling_at(3);
    let teacher = Arc::new(teacher);
    let (learner_server, teacher_server) = (Server::learner(&learner), Server::teacher(&teacher));
    let shutdown = CancellationToken::new();
    let config = config(&learner_server, Some(&teacher_server));
    let timeouts = Timeouts { drain: Duration::from_secs(20), ..TIMEOUTS };
    let worker = tokio::spawn(run_with(config, timeouts, shutdown.clone()));
    at_fault.recv().await.expect("the teacher gets there");
    shutdown.cancel();
    worker.await.expect("no panic").expect("stops without an error");
    assert_eq!(learner.n_calls(Call::NextWork), 1, "no further slot is begun");
    assert_eq!(learner.episodes().len(), 2);
}
