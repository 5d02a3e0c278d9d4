//! A worker that plays on a server of environments, which fails in various ways.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use tandem_core::task::TaskDescription;
use tandem_core::text::error_chain;
use tandem_core::work::RunTerms;
use tandem_core::{Episode, TaskSpec};
use tandem_proto::pb;
use tandem_telemetry::read_episode;
use tandem_worker::record::RecordError;
use tandem_worker::replay::{replay_log, replay_log_on};
use tandem_worker::{
    EnvironmentConfig, Error, RecordedEpisodes, RecordingConfig, WorkerConfig,
    describe_environments, run_with,
};
use tokio_util::sync::CancellationToken;
use tonic::Status;

use crate::services::support::environment::{FakeEnvironments, Fault, played_on};
use crate::services::support::learner::{Call, FakeLearner};
use crate::services::support::teacher::FakeTeacher;
use crate::services::support::{LAYOUT, Server, orders, terms};
use crate::services::{TIMEOUTS, config, episodes_without_faults};

/// Plays all slots on `environments`; returns the delivered episodes and the fake learner.
async fn play_on(
    environments: &Arc<FakeEnvironments>,
    configure: impl FnOnce(EnvironmentConfig) -> EnvironmentConfig,
) -> (Result<(), Error>, BTreeMap<(bool, u64), Episode>, Arc<FakeLearner>) {
    let learner = Arc::new(FakeLearner::new(orders()));
    let teacher = Arc::new(FakeTeacher::default());
    let (learner_server, teacher_server) = (Server::learner(&learner), Server::teacher(&teacher));
    let server = Server::environments(environments);
    let environment = Some(configure(played_on(&server)));
    let config = WorkerConfig { environment, ..config(&learner_server, Some(&teacher_server)) };
    let ended = run_with(config, TIMEOUTS, CancellationToken::new()).await;
    (ended, learner.episodes(), learner)
}

/// Returns the episodes that a worker simulates itself, without the steps of link avoidance, which servers do not count.
async fn simulated_episodes() -> BTreeMap<(bool, u64), Episode> {
    let mut episodes = episodes_without_faults().await;
    episodes.values_mut().for_each(|episode| episode.avoidance_steps = None);
    episodes
}

/// Plays on a server with a fault that a worker survives.
async fn check_survived(environments: FakeEnvironments, reply_timeout: Duration) {
    let environments = Arc::new(environments);
    let configure = |config| EnvironmentConfig { reply_timeout, ..config };
    let (ended, episodes, learner) = play_on(&environments, configure).await;
    ended.expect("the run ends");
    assert_eq!(episodes, simulated_episodes().await);
    assert_eq!(learner.n_calls(Call::Join), 1);
}

/// Plays on a server with a fault that ends the worker; returns the error's line.
async fn line_of_end(environments: FakeEnvironments) -> String {
    let environments = Arc::new(environments);
    let (ended, _, _) = play_on(&environments, |config| config).await;
    let line = error_chain(&ended.expect_err("the worker gives up"));
    assert!(line.contains("environment server http://127.0.0.1:"), "{line}");
    assert!(!line.contains('\n'), "{line}");
    line
}

fn ending(message: &str) -> Fault {
    Fault::End(Status::unavailable(message))
}

#[tokio::test]
async fn episodes_on_a_server_are_the_same_as_in_the_worker() {
    let environments = Arc::new(FakeEnvironments::default());
    let (ended, episodes, learner) = play_on(&environments, |config| config).await;
    ended.expect("the run ends");
    assert_eq!(episodes, simulated_episodes().await);
    assert_eq!(environments.n_requests(), 4 * 51, "three slots, and the first a second time");
    assert_eq!(learner.checks(), [(2, String::new())]);
}

#[tokio::test]
async fn a_server_that_dies_within_an_episode_changes_nothing() {
    for nth in [0, 1, 30, 51, 120] {
        check_survived(
            FakeEnvironments::default().with_fault(nth, ending("restarting")),
            Duration::from_secs(10),
        )
        .await;
    }
    let hanging = FakeEnvironments::default().with_fault(70, Fault::Hang);
    check_survived(hanging, Duration::from_millis(300)).await;
}

#[tokio::test]
async fn a_server_that_dies_in_every_episode_is_given_up() {
    let environments = FakeEnvironments::default().with_fault(20, ending("out of memory"));
    let line = line_of_end(environments.repeating(21)).await;
    let expected = "(fake 1.0) after 3 failures in a row: ";
    assert!(line.contains(expected) && line.ends_with("out of memory"), "{line}");
}

#[tokio::test]
async fn a_server_that_refuses_is_not_asked_again() {
    let refusal = Fault::End(Status::invalid_argument("reset.environments[0].seed: too large"));
    let environments = FakeEnvironments::default().with_fault(0, refusal);
    let line = line_of_end(environments).await;
    assert!(line.contains("refused a request"), "{line}");
    assert!(line.ends_with("reset.environments[0].seed: too large"), "{line}");
}

#[tokio::test]
async fn an_episode_that_a_server_ends_for_good_is_named_like_an_invalid_reply() {
    let reason = "environment 1: observation[0] is nan, beyond its bound 10";
    for (nth, reply) in [(0, "the reset of episodes [0, 1]"), (7, "step 7 of episodes [0, 1]")] {
        let lost = Fault::End(Status::data_loss(reason));
        let line = line_of_end(FakeEnvironments::default().with_fault(nth, lost)).await;
        let expected = format!("(fake 1.0) sent an invalid reply to {reply}: {reason}");
        assert!(line.ends_with(&expected), "{line}");
    }
}

#[tokio::test]
async fn a_failure_of_a_server_is_reported_once_with_the_slot_that_is_played_after_it() {
    let environments = FakeEnvironments::default()
        .with_fault(20, ending("boom\nsecond line"))
        .with_fault(40, ending("boom again, before a slot was played"));
    let (ended, _, learner) = play_on(&Arc::new(environments), |config| config).await;
    ended.expect("the run ends");
    let failures = learner.failures();
    let [(1, first)] = &failures[..] else { panic!("{failures:?}") };
    assert!(first.ends_with(" (fake 1.0): boom second line"), "{first}");
}

#[tokio::test]
async fn an_invalid_reply_ends_the_worker_with_server_environment_field_and_value() {
    let check = async |nth, spoil, reply: &str, reason: &str| {
        let environments = FakeEnvironments::default().with_fault(nth, Fault::Spoil(spoil));
        let line = line_of_end(environments).await;
        let expected = format!("(fake 1.0) sent an invalid reply to {reply}: {reason}");
        assert!(line.ends_with(&expected), "{line}");
    };
    check(
        7,
        |reply| reply.observations[4 * 61..4 * 62].fill(0xff),
        "step 7 of episodes [0, 1]",
        "environment 1: observations[5]: expected a number in [-25, 25], got NaN",
    )
    .await;
    check(
        0,
        |reply| reply.goals[..4].copy_from_slice(&8.5_f32.to_le_bytes()),
        "the reset of episodes [0, 1]",
        "environment 0: goals[0]: expected a number in [-2, 2], got 8.5",
    )
    .await;
    check(
        1,
        |reply| reply.observations.truncate(4 * 56),
        "step 1 of episodes [0, 1]",
        "observations: expected 112 numbers, got 56 numbers",
    )
    .await;
    check(
        50,
        |reply| reply.contacts.push(0),
        "step 50 of episodes [0, 1]",
        "contacts: expected 2 bytes, one per environment, got 3 bytes",
    )
    .await;
}

#[tokio::test]
async fn another_task_is_refused_and_its_field_named() {
    let line = line_of_end(FakeEnvironments::default().serving(lab_push())).await;
    let expected = "serves another task than the run's: name is \"push\" in the run and \"lab/push\" at the server";
    assert!(line.ends_with(expected), "{line}");
}

/// Returns the push task under a name that is not built-in.
fn lab_push() -> TaskSpec {
    let description = TaskDescription { name: "lab/push".to_owned(), ..LAYOUT.description() };
    TaskSpec::new(description).expect("valid")
}

/// Records the evaluation of a run of [`lab_push`] and returns the log's path.
async fn recorded_on(environments: &Arc<FakeEnvironments>, log_dir: &Path) -> PathBuf {
    let terms = RunTerms { task: lab_push(), account: None, ..terms() };
    let learner = Arc::new(FakeLearner::new(orders().split_off(2)).with_terms(terms));
    let (learner_server, server) = (Server::learner(&learner), Server::environments(environments));
    let config = WorkerConfig {
        environment: Some(played_on(&server)),
        recording: Some(RecordingConfig {
            directory: log_dir.to_owned(),
            episodes: RecordedEpisodes::Evaluation,
            budget_bytes: u64::MAX,
        }),
        ..config(&learner_server, None)
    };
    run_with(config, TIMEOUTS, CancellationToken::new()).await.expect("the run ends");
    let path = log_dir.join("eval-000002-001.mcap");
    let log = read_episode(&path).expect("a whole log");
    let episode = learner.episodes().into_values().find(|episode| episode.number == 1);
    let episode = episode.expect("delivered");
    assert_eq!((&log.metadata.task, log.metadata.seed), (&lab_push(), 21));
    for (step_idx, step) in log.transitions.iter().enumerate() {
        assert_eq!(step.observation, episode.observation(step_idx));
        assert_eq!((&step.goal, step.action.as_slice()), (&episode.goal, episode.action(step_idx)));
        assert_eq!((step.reward, step.advised_arms), (episode.joint_reward(step_idx), 0));
    }
    assert_eq!(log.transitions.len(), episode.n_steps());
    assert_eq!(log.last_observation.as_deref(), Some(episode.last_observation()));
    path
}

#[tokio::test]
async fn an_episode_of_a_described_task_is_logged_and_replays_in_its_environments_only() {
    let logs = tempfile::tempdir().expect("a directory");
    let environments = Arc::new(FakeEnvironments::default().serving(lab_push()));
    let path = recorded_on(&environments, logs.path()).await;
    let log = read_episode(&path).expect("a whole log");
    let refused = replay_log(&log).expect_err("no simulator");
    assert!(
        matches!(&refused, RecordError::NoSimulator { task } if task == "lab/push"),
        "{refused}"
    );

    let server = Server::environments(&environments);
    replay_log_on(played_on(&server), &log).await.expect("equal");
    let mut altered = log.clone();
    altered.transitions[30].observation[8] += 1e-3;
    let differs = replay_log_on(played_on(&server), &altered).await.expect_err("altered");
    let is_found = matches!(
        differs,
        RecordError::Differs { step: 30, field: "observation", component: 8, .. }
    );
    assert!(is_found, "{differs}");

    // A server that fails within the episode is asked again, up to a limit.
    let failing = |environments: FakeEnvironments| {
        Arc::new(environments.serving(lab_push()).with_fault(20, ending("restarting")))
    };
    let once = Server::environments(&failing(FakeEnvironments::default()));
    replay_log_on(played_on(&once), &log).await.expect("equal at the second attempt");
    let always = Server::environments(&failing(FakeEnvironments::default().repeating(21)));
    let given_up = replay_log_on(played_on(&always), &log).await.expect_err("it always fails");
    assert!(given_up.to_string().contains("after 3 failures in a row"), "{given_up}");
    let other = Server::environments(&Arc::new(FakeEnvironments::default()));
    let other_task = replay_log_on(played_on(&other), &log).await.expect_err("it serves push");
    assert!(other_task.to_string().contains("serves another task"), "{other_task}");
}

#[tokio::test]
async fn a_server_is_asked_for_its_task() {
    let task = lab_push();
    let environments = Arc::new(FakeEnvironments::default().serving(task.clone()));
    let server = Server::environments(&environments);
    let served = describe_environments(played_on(&server)).await.expect("answered");
    let expected = format!("http://{} (fake 1.0)", server.address());
    assert_eq!((served.server, served.task, served.max_environments), (expected, task, 2));
}

#[tokio::test]
async fn a_server_with_too_few_environments_is_refused() {
    let line = line_of_end(FakeEnvironments::default().with_room_for(1)).await;
    let expected =
        "serves 1 environments per stream, a slot has 2 episodes: serve at least 8 (`n` of";
    assert!(line.contains(expected), "{line}");
}

#[tokio::test]
async fn an_environment_that_does_not_repeat_is_reported_with_its_first_difference() {
    // The first slot is played twice: requests 0 to 50, then 51 to 101.
    let nudge: fn(&mut pb::PlayResponse) = |reply| {
        reply.observations[..4].copy_from_slice(&0.125_f32.to_le_bytes());
    };
    let environments = FakeEnvironments::default().with_fault(51 + 9, Fault::Spoil(nudge));
    let (ended, episodes, learner) = play_on(&Arc::new(environments), |config| config).await;
    ended.expect("a warning only");
    assert_eq!(episodes, simulated_episodes().await);
    let checks = learner.checks();
    let [(2, difference)] = &checks[..] else { panic!("{checks:?}") };
    let expected = "episode 0, played twice with the same seed and actions, differs after step 9: observation[0] is ";
    assert!(difference.starts_with(expected), "{difference}");
    assert!(difference.contains(", then 1.25e-1, a difference of "), "{difference}");
}

#[tokio::test]
async fn a_service_of_another_kind_is_named() {
    let learner = Arc::new(FakeLearner::new(orders()));
    let learner_server = Server::learner(&learner);
    let environment = Some(played_on(&learner_server));
    let teacher = Server::teacher(&Arc::new(FakeTeacher::default()));
    let config = WorkerConfig { environment, ..config(&learner_server, Some(&teacher)) };
    let ended = run_with(config, TIMEOUTS, CancellationToken::new()).await;
    let line = error_chain(&ended.expect_err("a learner has no environments"));
    assert!(line.ends_with("is a learner, not an environment: check the address"), "{line}");
}
