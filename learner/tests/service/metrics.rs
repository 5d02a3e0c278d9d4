//! The run's figures over HTTP, beside what the service itself says.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::Duration;

use tandem_core::Episode;
use tandem_learner::{LingerPolicy, ServeOptions, serve_with};
use tandem_proto::{encode_episode, pb};
use tandem_telemetry::RunView;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::service_tests::run::{DEADLINE, Served, Toy, client_of, learner_config};
use crate::service_tests::toy;

/// Returns the values at `/metrics` by name and labels.
async fn scrape(address: SocketAddr) -> BTreeMap<String, f64> {
    let mut caller = TcpStream::connect(address).await.expect("it listens");
    let question = b"GET /metrics HTTP/1.1\r\nhost: learner\r\n\r\n";
    caller.write_all(question).await.expect("sent");
    let mut answer = String::new();
    caller.read_to_string(&mut answer).await.expect("answered");
    let (head, page) = answer.split_once("\r\n\r\n").expect("a page");
    assert!(head.starts_with("HTTP/1.1 200 OK\r\n"), "{head}");
    assert!(head.contains("content-type: application/openmetrics-text"), "{head}");
    assert!(page.ends_with("\n# EOF\n"), "{page}");
    values(page)
}

fn values(page: &str) -> BTreeMap<String, f64> {
    let samples = page.lines().filter(|line| !line.starts_with('#'));
    let sample = |line: &str| {
        let (name, value) = line.rsplit_once(' ').expect("a name and a value");
        (name.to_owned(), value.parse().expect("a number"))
    };
    samples.map(sample).collect()
}

/// Looks again and again until `name` is `expected`.
async fn comes_true(address: SocketAddr, name: &str, expected: f64) -> BTreeMap<String, f64> {
    let looking = async {
        loop {
            let figures = scrape(address).await;
            if figures.get(name) == Some(&expected) {
                return figures;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(DEADLINE, looking).await.expect("it comes true in time")
}

/// Checks that the snapshots for displays arrive at the end that `status` reports.
async fn shows_the_end(mut view: watch::Receiver<RunView>, status: &pb::Progress) {
    let ended = view.wait_for(|view| view.end.is_some() && !view.evaluations.is_empty());
    let view = tokio::time::timeout(DEADLINE, ended).await.expect("in time").expect("it serves");
    assert_eq!((view.round, view.env_steps), (status.round, status.env_steps));
    assert_eq!((view.task.as_str(), view.phase.as_str()), ("push", "ended"));
    let names: Vec<&str> = view.workers.iter().map(|worker| worker.name.as_str()).collect();
    assert_eq!(names, ["toy"]);
    let latest = view.evaluations.last().expect("evaluations");
    assert_eq!(Some(latest.success), status.evaluation.as_ref().map(|it| it.success));
    assert!(view.evaluated.iter().all(|it| it.parameter_version == latest.round));
    assert!(!view.evaluated.is_empty());
    let n_acted: u64 = view.acted.iter().map(|arm| arm.student + arm.teacher).sum();
    assert_eq!(n_acted, status.env_steps);
}

#[tokio::test]
async fn failures_of_environments_are_counted_and_warned_of_once() {
    let directory = tempfile::tempdir().expect("a directory");
    let served = Served::start(learner_config(toy::config(0), directory.path(), false)).await;
    let mut toy = served.join("toy").await;
    let first = "the environments fail repeatedly, their episodes are played again: one failure, of the server \
                 http://x:1 (fake): boom 1";
    for (failures, total, warning) in [(2, 2, ""), (1, 3, first), (5, 8, first)] {
        let (order, episodes) = toy.take().await.expect("a slot");
        let (sender, slot) = (toy.id, order.slot);
        deliver_with_failures(&mut toy, sender, slot, &episodes, failures).await;
        let progress = toy.client.status(pb::StatusRequest {}).await.expect("it lives");
        let progress = progress.into_inner();
        assert_eq!((progress.environment_failures, progress.warning.as_str()), (total, warning));
        assert_eq!(progress.environment, "", "nothing was played twice");
    }
    while toy.play_one().await {}
    served.end().await.expect("the run ends");
}

/// Delivers a slot in the name of the worker `sender`, with a report of failures of its environments.
async fn deliver_with_failures(
    toy: &mut Toy,
    sender: u64,
    slot: u64,
    episodes: &[Episode],
    failures: u32,
) {
    let check = pb::EnvironmentCheck {
        failures,
        failure: format!("http://x:1 (fake): boom {failures}"),
        ..Default::default()
    };
    let request = pb::SubmitEpisodesRequest {
        worker_id: sender,
        slot,
        episodes: episodes.iter().map(encode_episode).collect(),
        environment_check: Some(check),
    };
    toy.client.submit_episodes(request).await.expect("taken");
}

#[tokio::test]
async fn a_run_without_workers_shows_that_it_waits_for_episodes() {
    let directory = tempfile::tempdir().expect("a directory");
    let served = Served::start(learner_config(toy::config(0), directory.path(), false)).await;
    let mut client = served.client().await;
    let collects = async {
        loop {
            let progress = client.status(pb::StatusRequest {}).await.expect("it lives");
            if progress.into_inner().phase == "collecting" {
                return;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(DEADLINE, collects).await.expect("it collects in time");
    served.shutdown.cancel();
    served.end().await.expect("interrupted");
}

#[tokio::test]
async fn failures_count_once_even_if_another_worker_has_delivered_the_slot() {
    let directory = tempfile::tempdir().expect("a directory");
    let served = Served::start(learner_config(toy::config(0), directory.path(), false)).await;
    let (mut toy, other) = (served.join("toy").await, served.join("other").await);
    let (order, episodes) = toy.take().await.expect("a slot");
    for (sender, failures, total) in [
        (toy.id, 1, 1),
        (toy.id, 1, 1), // The response was lost, and the call is repeated.
        (other.id, 4, 5),
        (other.id, 4, 5),
    ] {
        deliver_with_failures(&mut toy, sender, order.slot, &episodes, failures).await;
        let progress = toy.client.status(pb::StatusRequest {}).await.expect("it lives");
        assert_eq!(progress.into_inner().environment_failures, total);
    }
    served.shutdown.cancel();
    served.end().await.expect("interrupted");
}

#[tokio::test]
async fn metrics_follow_the_run_and_stay_after_its_end() {
    let directory = tempfile::tempdir().expect("a directory");
    let shutdown = CancellationToken::new();
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("bound");
    let metrics = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let metrics_at = metrics.local_addr().expect("bound");
    let linger = LingerPolicy::UntilShutdown;
    let (views, view) = watch::channel(RunView::default());
    let beside = ServeOptions { metrics: Some(metrics), views: Some(views), linger };
    // Without lag no round is opened before the last is learned, so that the counts are what they are.
    let config = learner_config(toy::config(0), directory.path(), false);
    let serving = tokio::spawn(serve_with(config, listener, shutdown.clone(), beside));

    let figures = comes_true(metrics_at, "tandem_assignments_waiting", 4.0).await;
    assert_eq!(figures["tandem_workers"], 0.0);
    assert_eq!(figures["tandem_assignments_playing"], 0.0);
    assert_eq!(figures["tandem_rounds_total"], 0.0);
    assert_eq!(figures["tandem_run_info{task=\"push\",arms=\"1\",strategy=\"none\"}"], 1.0);
    assert!(!figures.contains_key("tandem_evaluation_success_ratio"), "nothing was judged yet");

    let client = || async { client_of(address) };
    let mut toy = Toy::join(client().await, "toy").await.expect("it lives");
    let (order, episodes) = toy.take().await.expect("a slot");
    let figures = scrape(metrics_at).await;
    assert_eq!(figures["tandem_workers"], 1.0);
    assert_eq!(figures["tandem_assignments_waiting"], 3.0);
    assert_eq!(figures["tandem_assignments_playing"], 1.0);
    toy.deliver(order.slot, &episodes).await.expect("taken");
    let figures = scrape(metrics_at).await;
    assert_eq!(figures["tandem_assignments_playing"], 0.0);

    while toy.play_one().await {}
    let figures = comes_true(metrics_at, "tandem_ended", 1.0).await;
    let mut client = client().await;
    let status = client.status(pb::StatusRequest {}).await.expect("it stays").into_inner();
    assert!(status.ended);
    shows_the_end(view, &status).await;
    for (name, expected) in [
        ("tandem_rounds_total", status.round as f64),
        ("tandem_env_steps_total", status.env_steps as f64),
        ("tandem_episodes_total", status.episodes as f64),
        ("tandem_updates_total", status.updates as f64),
        ("tandem_advice_spent_total", status.advice_spent as f64),
        ("tandem_advice_left", status.budget_left as f64),
        ("tandem_wall_seconds", status.wall_s),
        ("tandem_training_success_ratio", status.training_success),
        ("tandem_evaluation_success_ratio", status.evaluation.expect("judged").success),
        ("tandem_best_evaluation_success_ratio", status.best.expect("judged").success),
        ("tandem_assignments_waiting", 0.0),
        ("tandem_needs_attention", 0.0),
        // 72 episodes were played, the buffer holds 2,000 transitions.
        ("tandem_replay_episodes", 40.0),
    ] {
        assert_eq!(figures[name], expected, "{name}");
    }
    assert!(figures["tandem_rounds_total"] > 8.0 && figures["tandem_updates_total"] > 0.0);

    assert!(!serving.is_finished(), "it stays until shutdown");
    shutdown.cancel();
    let ended = tokio::time::timeout(DEADLINE, serving).await.expect("it ends in time");
    assert!(!ended.expect("no panic").expect("a whole run").interrupted);
    assert!(TcpStream::connect(metrics_at).await.is_err(), "figures end with the service");
}
