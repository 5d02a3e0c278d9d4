//! Malformed input: messages to services, command lines and files.
//!
//! A service answers with an error or closes the connection, continues to serve other clients and charges nothing. The
//! program reports the error in one line and ends with the matching exit code.

#[path = "bad_input/program.rs"]
mod program;
#[path = "bad_input/wire.rs"]
mod wire;

use std::collections::BTreeSet;
use std::fs;
use std::io::Write as _;
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use prost::Message as _;
use tandem_core::rng::{Stream, episode_rng, index};
use tandem_proto::pb;
use tandem_proto::pb::bridge_client::BridgeClient;
use tandem_proto::pb::learner_client::LearnerClient;
use tandem_proto::pb::teacher_client::TeacherClient;
use tonic::Code;
use tonic::transport::Channel;

use program::{Running, shipped};
use wire::{Answer, Rpc, frame, rpcs};

/// Limit of every wait, sufficient for slow machines.
const DEADLINE: Duration = Duration::from_secs(60);
/// Number of connections that are opened and left idle.
const N_IDLE: usize = 200;

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime")
}

/// Waits for `work`, which must complete within [`DEADLINE`].
async fn within_deadline<T>(what: &str, work: impl Future<Output = T>) -> T {
    let ended = tokio::time::timeout(DEADLINE, work).await;
    assert!(ended.is_ok(), "{what}: no end in a minute");
    ended.expect("checked")
}

/// Names of bodies that are complete frames but no valid message of any type.
const UNDECODABLE: [&str; 2] = ["an invalid tag", "an unterminated number"];

/// Returns request bodies with their names, and true where an answer without an error is allowed.
fn hostile_bodies() -> Vec<(String, Vec<u8>, bool)> {
    let mut bodies = vec![
        ("no bytes".to_owned(), Vec::new(), true),
        ("half a frame header".to_owned(), vec![0, 0, 0], false),
        ("a truncated frame".to_owned(), [&frame(0, &[0; 100])[..15], &[]].concat(), false),
        ("compressed without an encoding".to_owned(), frame(1, &[0; 10]), false),
        ("an undefined flag".to_owned(), frame(7, &[0; 10]), false),
        ("4 GB claimed".to_owned(), [&[0, 0xff, 0xff, 0xff, 0xff][..], &[1; 10]].concat(), false),
        ("an invalid tag".to_owned(), frame(0, &[0x07, 1, 2]), false),
        ("an unterminated number".to_owned(), frame(0, &[0xff; 12]), false),
        ("5 MiB of zeros".to_owned(), frame(0, &vec![0; 5 << 20]), false),
        ("two messages".to_owned(), [frame(0, &[]), frame(0, &[])].concat(), true),
    ];
    let mut rng = episode_rng(7, 0, Stream::Reset);
    for seed in 0..12 {
        let bytes: Vec<u8> = (0..1 + index(&mut rng, 120))
            .map(|_| u8::try_from(index(&mut rng, 256)).expect("a byte"))
            .collect();
        bodies.push((format!("random message {seed}"), frame(0, &bytes), true));
        bodies.push((format!("random bytes {seed}"), bytes, true));
    }
    bodies
}

/// Sends every hostile body to every method of `service`, and input that is not a call at all.
async fn attack(address: SocketAddr, service: &str) {
    let calls: Vec<Rpc> = rpcs().into_iter().filter(|rpc| rpc.service == service).collect();
    assert!(calls.len() >= 6, "{calls:?}");
    for rpc in &calls {
        for (name, body, may_succeed) in hostile_bodies() {
            let what = format!("{name} to {}", rpc.path);
            let answer = within_deadline(&what, wire::call(address, &rpc.path, &body)).await;
            let refused = matches!(answer, Answer::Closed)
                || matches!(answer, Answer::Status(code, _) if code != Code::Ok);
            assert!(refused || may_succeed, "{what}: {answer:?}");
            assert!(!matches!(&answer, Answer::Status(Code::Unknown, _)), "{what}: {answer:?}");
            if UNDECODABLE.contains(&name.as_str()) {
                let is_explained = matches!(
                    &answer,
                    Answer::Status(Code::InvalidArgument, message) if message.contains("malformed")
                );
                assert!(is_explained, "{what} is the client's mistake: {answer:?}");
            }
        }
        within_deadline("a call that never ends", wire::send_endlessly(address, &rpc.path)).await;
    }
    let (unknown_path, empty) = (format!("/{service}/NoSuchCall"), frame(0, &[]));
    let unknown = wire::call(address, &unknown_path, &empty);
    let unknown = within_deadline("an unknown method", unknown).await;
    assert!(matches!(unknown, Answer::Status(Code::Unimplemented, _)), "{unknown:?}");
    let opened_and_dropped = wire::reset_storm(address, &calls[0].path, 300);
    within_deadline("calls opened and dropped", opened_and_dropped).await;
    for garbage in wire::not_http2() {
        let what = format!("{:?}", String::from_utf8_lossy(&garbage[..garbage.len().min(24)]));
        let closed = tokio::task::spawn_blocking(move || wire::is_closed_after(address, &garbage));
        assert!(within_deadline(&what, closed).await.expect("no panic"), "{what}: still open");
    }
}

/// Opens connections that send nothing, or only the start of the HTTP/2 preface.
fn idle_connections(address: SocketAddr) -> Vec<TcpStream> {
    let connect = |number: usize| {
        let mut stream = TcpStream::connect(address).expect("connects");
        if number.is_multiple_of(2) {
            stream.write_all(&b"PRI * HTTP/2.0\r\n"[..number % 16]).expect("sent");
        }
        stream
    };
    (0..N_IDLE).map(connect).collect()
}

async fn teacher_client(address: SocketAddr) -> TeacherClient<Channel> {
    TeacherClient::connect(format!("http://{address}")).await.expect("connects")
}

/// Returns a request for advice on one step of a two-arm push.
fn request_for(episode: u64, step: u32) -> pb::AdviseRequest {
    let steps = vec![pb::StepQuery {
        episode,
        step,
        observation: (0_u8..56).map(|i| f32::from(i) / 64.0).collect(),
        goal: vec![0.1; 6],
        proposed_action: vec![0.5; 6],
        ..Default::default()
    }];
    pb::AdviseRequest { account: "attacked".to_owned(), steps, ..Default::default() }
}

/// Returns well-formed requests that cannot be answered, and the status codes that they get.
fn refused_requests() -> Vec<(Code, pb::AdviseRequest)> {
    let altered = |alter: fn(&mut pb::AdviseRequest)| {
        let mut request = request_for(1, 0);
        alter(&mut request);
        request
    };
    let invalid = [
        altered(|r| r.steps[0].observation[3] = f32::NAN),
        altered(|r| r.steps[0].goal[0] = f32::INFINITY),
        altered(|r| r.steps[0].proposed_action[5] = 1.5),
        altered(|r| r.steps[0].observation.truncate(55)),
        altered(|r| r.steps[0].observation.clear()),
        altered(|r| r.steps[0].observation.extend([0.0; 28 * 7])),
        altered(|r| r.steps[0].proposed_action.push(0.0)),
        altered(|r| r.steps = vec![r.steps[0].clone(); 1025]),
        altered(|r| r.account.clear()),
        altered(|r| r.account = "x".repeat(257)),
        altered(|r| r.steps.push(pb::StepQuery::default())),
    ];
    let unknown = altered(|r| r.account = "unknown".to_owned());
    invalid
        .into_iter()
        .map(|request| (Code::InvalidArgument, request))
        .chain([(Code::NotFound, unknown)])
        .collect()
}

/// Sends requests with a few bytes altered and returns the steps that were charged.
async fn altered_requests(address: SocketAddr) -> BTreeSet<(u64, u32)> {
    let mut rng = episode_rng(8, 0, Stream::Reset);
    let mut charged = BTreeSet::new();
    for number in 0..150 {
        let mut bytes = request_for(1000 + number, 7).encode_to_vec();
        for _ in 0..=index(&mut rng, 3) {
            let at = if index(&mut rng, 2) == 0 {
                index(&mut rng, 24)
            } else {
                index(&mut rng, bytes.len())
            };
            bytes[at] = u8::try_from(index(&mut rng, 256)).expect("a byte");
        }
        let body = frame(0, &bytes);
        let answer = wire::call(address, "/tandem.v1.Teacher/Advise", &body);
        match within_deadline("an altered request", answer).await {
            Answer::Message(answer) => {
                let request = pb::AdviseRequest::decode(bytes.as_slice()).expect("it was answered");
                let answer = pb::AdviseResponse::decode(answer.as_slice()).expect("an answer");
                assert_eq!(request.steps.len(), answer.steps.len());
                let steps =
                    request.steps.iter().zip(&answer.steps).filter(|(_, advice)| advice.charged);
                charged.extend(steps.map(|(query, _)| (query.episode, query.step)));
            }
            Answer::Status(code, message) => {
                assert!(!matches!(code, Code::Ok | Code::Unknown), "{code:?}: {message}");
                assert!(message.len() < 2000, "a message of {} bytes", message.len());
            }
            Answer::Closed => {}
        }
    }
    charged
}

#[test]
fn a_teacher_serves_and_charges_nothing_after_malformed_input() {
    let teacher_policy = shipped("teacher-push");
    let mut teacher = Running::service(&["teacher", "--policy", &teacher_policy]);
    let address = teacher.address;
    let idle = idle_connections(address);
    runtime().block_on(async {
        let mut client = teacher_client(address).await;
        let account = pb::OpenAccountRequest {
            name: "attacked".to_owned(),
            budget: 10_000,
            strategy: "ea".to_owned(),
        };
        let opened = client.open_account(account).await.expect("opened").into_inner();
        attack(address, "tandem.v1.Teacher").await;
        for (code, request) in refused_requests() {
            let refused = client.advise(request).await.expect_err("cannot be answered");
            assert_eq!(refused.code(), code, "{refused}");
        }
        for (n_mib, code) in [(3, Code::InvalidArgument), (5, Code::OutOfRange)] {
            let long = pb::OpenAccountRequest {
                name: "long".to_owned(),
                budget: 1,
                strategy: "x".repeat(n_mib << 20),
            };
            let refused = client.open_account(long).await.expect_err("no such strategy");
            assert_eq!(refused.code(), code, "{n_mib} MiB");
        }
        let name = pb::GetAccountRequest { name: "attacked".to_owned() };
        let mut late = teacher_client(address).await;
        let untouched = late.get_account(name.clone()).await.expect("served").into_inner();
        assert_eq!(untouched, opened, "nothing was charged");

        let charged = altered_requests(address).await;
        assert!((5..150).contains(&charged.len()), "{} of 150 were answered", charged.len());
        let advice = late.advise(request_for(1, 0)).await.expect("served").into_inner();
        assert!(advice.steps[0].charged, "a valid request is still answered");
        let account = late.get_account(name).await.expect("served").into_inner();
        assert_eq!(account.spent, charged.len() as u64 + 1, "only answered steps are charged");
        assert_eq!(account.spent + account.leased + account.left, account.budget);
    });
    assert!(teacher.peak_mib() < 256, "{} MiB", teacher.peak_mib());
    assert!(teacher.ends_on_sigterm(), "{N_IDLE} idle connections do not delay the shutdown");
    drop(idle);
}

#[test]
fn a_bridge_keeps_the_arms_at_rest_and_serves_after_malformed_input() {
    let mut bridge = Running::service(&["bridge", "--driver", "sim", "--listen", "127.0.0.1:0"]);
    let address = bridge.address;
    let idle = idle_connections(address);
    runtime().block_on(async {
        let client = BridgeClient::connect(format!("http://{address}")).await;
        let mut client = client.expect("connects");
        attack(address, "tandem.v1.Bridge").await;
        let mut status =
            client.status(pb::BridgeStatusRequest {}).await.expect("served").into_inner();
        for _ in 0..100 {
            if !status.arms.is_empty() {
                break;
            }
            // The simulated pair has sent no state yet.
            tokio::time::sleep(Duration::from_millis(100)).await;
            status = client.status(pb::BridgeStatusRequest {}).await.expect("served").into_inner();
        }
        assert_eq!(status.phase(), pb::BridgePhase::Stopped, "the arms were never reset");
        assert!(status.at_rest && status.arms.len() == 2, "{status:?}");
        for (arm, x_m) in status.arms.iter().zip([-0.12, 0.12]) {
            for (at_m, was_m) in arm.tool_in_world_m.iter().zip([x_m, 0.0, 0.095]) {
                assert!((at_m - was_m).abs() < 0.001, "{arm:?}");
            }
        }
        let stopped = client.stop(pb::StopRequest {}).await;
        assert!(stopped.is_ok(), "{stopped:?}");
    });
    assert!(bridge.peak_mib() < 256, "{} MiB", bridge.peak_mib());
    assert!(bridge.ends_on_sigterm(), "{N_IDLE} idle connections do not delay the shutdown");
    drop(idle);
}

/// A short run with one arm and no teacher.
const SHORT_RUN: &str = r#"
name = "attacked"
task = "push"
arms = 1
seed = 5
[advice]
strategy = "none"
[rounds]
slots = 2
[ddpg]
n_hidden = 16
n_hidden_layers = 1
batch_size = 32
[evaluation]
every_env_steps = 1600
episodes = 4
[checkpoint]
every_rounds = 5
[stop]
max_env_steps = 3200
"#;

/// Starts the run's learner in `directory`.
fn learner(directory: &Path) -> Running {
    let run = directory.join("run.toml");
    fs::write(&run, SHORT_RUN).expect("written");
    let out = directory.join("out");
    let path = |path: &Path| path.to_str().expect("UTF-8").to_owned();
    Running::service(&["learner", "--run", &path(&run), "--out", &path(&out)])
}

/// Follows the run to its end and returns its digest.
async fn follow_to_the_end(client: &mut LearnerClient<Channel>) -> String {
    let mut watched = client.watch(pb::WatchRequest {}).await.expect("watched").into_inner();
    loop {
        let progress =
            within_deadline("progress", watched.message()).await.expect("a message").expect("more");
        if progress.ended {
            return progress.digest;
        }
    }
}

fn start_worker(address: SocketAddr) -> Running {
    Running::start(&["worker", "--connect", &address.to_string()])
}

#[test]
fn malformed_input_does_not_change_what_a_learner_learns() {
    let runtime = runtime();
    let quiet = tempfile::tempdir().expect("a directory");
    let mut undisturbed = learner(quiet.path());
    let _worker = start_worker(undisturbed.address);
    let expected = runtime.block_on(async {
        let address = format!("http://{}", undisturbed.address);
        follow_to_the_end(&mut LearnerClient::connect(address).await.expect("connects")).await
    });
    assert!(undisturbed.ends_well() && expected.len() == 64, "{expected:?}");

    let noisy = tempfile::tempdir().expect("a directory");
    let mut attacked = learner(noisy.path());
    let address = attacked.address;
    let idle = idle_connections(address);
    let digest = runtime.block_on(async {
        let client = LearnerClient::connect(format!("http://{address}")).await;
        let mut client = client.expect("connects");
        attack(address, "tandem.v1.Learner").await;
        assert!(attacked.peak_mib() < 256, "{} MiB", attacked.peak_mib());
        let worker = start_worker(address);
        let (digest, ()) =
            tokio::join!(follow_to_the_end(&mut client), submit_invalid_episodes(address));
        drop(worker);
        digest
    });
    assert_eq!(digest, expected);
    assert!(attacked.ends_well());
    drop(idle);
}

/// Submits unsolicited and malformed episodes during the run.
async fn submit_invalid_episodes(address: SocketAddr) {
    let mut rng = episode_rng(9, 0, Stream::Reset);
    let whole = pb::Episode {
        number: 0,
        kind: pb::EpisodeKind::Training.into(),
        parameter_version: 0,
        observations: vec![0; 51 * 28 * 4],
        goal: vec![0; 12],
        actions: vec![0; 50 * 3 * 4],
        advised_arms: vec![0; 50],
        contacts: vec![0; 50],
        advice_charged: 0,
        avoidance_steps: None,
        queried_steps: None,
    };
    for slot in 0..40 {
        let mut episode = whole.clone();
        episode.number = slot;
        match slot % 4 {
            0 => {}
            1 => episode.observations.truncate(index(&mut rng, 5000)),
            2 => episode.actions.fill(0xff),
            _ => episode.kind = 17,
        }
        let request = pb::SubmitEpisodesRequest {
            worker_id: slot * 977,
            slot,
            episodes: vec![episode],
            environment_check: None,
        };
        let body = frame(0, &request.encode_to_vec());
        let answer = wire::call(address, "/tandem.v1.Learner/SubmitEpisodes", &body);
        match within_deadline("foreign episodes", answer).await {
            Answer::Status(Code::InvalidArgument | Code::NotFound, _) => {}
            // The run may end before all are sent.
            Answer::Closed => return,
            accepted => {
                assert_eq!(accepted, Answer::Closed, "unsolicited episodes of slot {slot}");
            }
        }
    }
}

#[test]
fn a_closed_output_pipe_ends_a_command_silently() {
    let (reader, writer) = std::io::pipe().expect("a pipe");
    drop(reader);
    let policy = concat!(env!("CARGO_MANIFEST_DIR"), "/policies/teacher-push.safetensors");
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    let ended = command.args(["policy", "show", policy]).stdout(writer).output().expect("runs");
    assert_eq!(String::from_utf8_lossy(&ended.stderr), "");
    assert_eq!(ended.status.code(), Some(141));
}
