//! Services that are sent nonsense, and command lines and files that are wrong.
//!
//! A service answers with an error or closes the connection, goes on serving others and charges nothing; the program
//! says in one line what is wrong and ends with the exit code that fits.

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

/// Every wait ends after this, however slow the machine.
const DEADLINE: Duration = Duration::from_secs(60);
/// Connections that somebody opens and forgets.
const N_IDLE: usize = 200;

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime")
}

/// Waits for what must come.
async fn soon<T>(what: &str, work: impl Future<Output = T>) -> T {
    let ended = tokio::time::timeout(DEADLINE, work).await;
    assert!(ended.is_ok(), "{what}: no end in a minute");
    ended.expect("checked")
}

/// Bodies that are whole frames and no message of any type.
const UNDECODABLE: [&str; 2] = ["a tag that cannot be", "a number without end"];

/// Bodies of a request, and whether an answer without an error would be right.
fn hostile_bodies() -> Vec<(String, Vec<u8>, bool)> {
    let mut bodies = vec![
        ("nothing".to_owned(), Vec::new(), true),
        ("half a frame's head".to_owned(), vec![0, 0, 0], false),
        ("a frame that is cut".to_owned(), [&frame(0, &[0; 100])[..15], &[]].concat(), false),
        ("compressed by nothing".to_owned(), frame(1, &[0; 10]), false),
        ("a flag without meaning".to_owned(), frame(7, &[0; 10]), false),
        ("4 GB claimed".to_owned(), [&[0, 0xff, 0xff, 0xff, 0xff][..], &[1; 10]].concat(), false),
        ("a tag that cannot be".to_owned(), frame(0, &[0x07, 1, 2]), false),
        ("a number without end".to_owned(), frame(0, &[0xff; 12]), false),
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

/// Sends every hostile body to every call of `service`, and what no call can take in.
async fn attack(address: SocketAddr, service: &str) {
    let calls: Vec<Rpc> = rpcs().into_iter().filter(|rpc| rpc.service == service).collect();
    assert!(calls.len() >= 6, "{calls:?}");
    for rpc in &calls {
        for (name, body, may_be_fine) in hostile_bodies() {
            let what = format!("{name} to {}", rpc.path);
            let answer = soon(&what, wire::call(address, &rpc.path, &body)).await;
            let refused = matches!(answer, Answer::Closed)
                || matches!(answer, Answer::Status(code, _) if code != Code::Ok);
            assert!(refused || may_be_fine, "{what}: {answer:?}");
            assert!(!matches!(&answer, Answer::Status(Code::Unknown, _)), "{what}: {answer:?}");
            if UNDECODABLE.contains(&name.as_str()) {
                let is_told = matches!(&answer, Answer::Status(Code::InvalidArgument, told) if told.contains("malformed"));
                assert!(is_told, "{what} is the client's mistake: {answer:?}");
            }
        }
        soon("a call that never ends", wire::endless(address, &rpc.path)).await;
    }
    let (nowhere, empty) = (format!("/{service}/NoSuchCall"), frame(0, &[]));
    let unknown = wire::call(address, &nowhere, &empty);
    let unknown = soon("a call that is not there", unknown).await;
    assert!(matches!(unknown, Answer::Status(Code::Unimplemented, _)), "{unknown:?}");
    let opened_and_dropped = wire::reset_storm(address, &calls[0].path, 300);
    soon("calls opened and dropped", opened_and_dropped).await;
    for garbage in wire::no_http2() {
        let what = format!("{:?}", String::from_utf8_lossy(&garbage[..garbage.len().min(24)]));
        let closed = tokio::task::spawn_blocking(move || wire::is_closed_after(address, &garbage));
        assert!(soon(&what, closed).await.expect("no panic"), "{what}: still open");
    }
}

/// Connections on which nothing, or only the beginning of a greeting, is said.
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

/// A question about one step of a two-arm push.
fn question(episode: u64, step: u32) -> pb::AdviseRequest {
    let steps = vec![pb::StepQuery {
        episode,
        step,
        observation: (0_u8..56).map(|i| f32::from(i) / 64.0).collect(),
        goal: vec![0.1; 6],
        proposed_action: vec![0.5; 6],
    }];
    pb::AdviseRequest { account: "attacked".to_owned(), steps }
}

/// Requests that are well-formed and cannot be answered, and what is said to them.
fn refused_questions() -> Vec<(Code, pb::AdviseRequest)> {
    let spoilt = |spoil: fn(&mut pb::AdviseRequest)| {
        let mut request = question(1, 0);
        spoil(&mut request);
        request
    };
    let invalid = [
        spoilt(|r| r.steps[0].observation[3] = f32::NAN),
        spoilt(|r| r.steps[0].goal[0] = f32::INFINITY),
        spoilt(|r| r.steps[0].proposed_action[5] = 1.5),
        spoilt(|r| r.steps[0].observation.truncate(55)),
        spoilt(|r| r.steps[0].observation.clear()),
        spoilt(|r| r.steps[0].observation.extend([0.0; 28 * 7])),
        spoilt(|r| r.steps[0].proposed_action.push(0.0)),
        spoilt(|r| r.steps = vec![r.steps[0].clone(); 1025]),
        spoilt(|r| r.account.clear()),
        spoilt(|r| r.account = "x".repeat(257)),
        spoilt(|r| r.steps.push(pb::StepQuery::default())),
    ];
    let unknown = spoilt(|r| r.account = "nobody's".to_owned());
    invalid
        .into_iter()
        .map(|request| (Code::InvalidArgument, request))
        .chain([(Code::NotFound, unknown)])
        .collect()
}

/// Sends questions with a few bytes exchanged; gives the steps that were answered with a charge.
async fn altered_questions(address: SocketAddr) -> BTreeSet<(u64, u32)> {
    let mut rng = episode_rng(8, 0, Stream::Reset);
    let mut charged = BTreeSet::new();
    for number in 0..150 {
        let mut bytes = question(1000 + number, 7).encode_to_vec();
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
        match soon("an altered question", answer).await {
            Answer::Message(answer) => {
                let asked = pb::AdviseRequest::decode(bytes.as_slice()).expect("it was answered");
                let answer = pb::AdviseResponse::decode(answer.as_slice()).expect("an answer");
                assert_eq!(asked.steps.len(), answer.steps.len());
                let steps =
                    asked.steps.iter().zip(&answer.steps).filter(|(_, advice)| advice.charged);
                charged.extend(steps.map(|(query, _)| (query.episode, query.step)));
            }
            Answer::Status(code, told) => {
                assert!(!matches!(code, Code::Ok | Code::Unknown), "{code:?}: {told}");
                assert!(told.len() < 2000, "{} bytes told", told.len());
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
        for (code, request) in refused_questions() {
            let refused = client.advise(request).await.expect_err("cannot be answered");
            assert_eq!(refused.code(), code, "{refused}");
        }
        let long = pb::OpenAccountRequest {
            name: "long".to_owned(),
            budget: 1,
            strategy: "x".repeat(3 << 20),
        };
        assert!(client.open_account(long).await.is_err(), "no such strategy");
        let name = pb::GetAccountRequest { name: "attacked".to_owned() };
        let mut late = teacher_client(address).await;
        let untouched = late.get_account(name.clone()).await.expect("served").into_inner();
        assert_eq!(untouched, opened, "nothing was charged");

        let charged = altered_questions(address).await;
        assert!((5..150).contains(&charged.len()), "{} of 150 were answered", charged.len());
        let advice = late.advise(question(1, 0)).await.expect("served").into_inner();
        assert!(advice.steps[0].charged, "a good question is answered as before");
        let account = late.get_account(name).await.expect("served").into_inner();
        assert_eq!(account.spent, charged.len() as u64 + 1, "what was answered, and no more");
        assert_eq!(account.spent + account.leased + account.left, account.budget);
    });
    assert!(teacher.peak_mib() < 256, "{} MiB", teacher.peak_mib());
    assert!(teacher.ends_on_sigterm(), "{N_IDLE} silent connections do not hold it up");
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
        let status = client.status(pb::BridgeStatusRequest {}).await.expect("served").into_inner();
        assert_eq!(status.phase(), pb::BridgePhase::Stopped, "nobody has let the arms go");
        assert!(status.at_rest, "{status:?}");
        for (arm, x_m) in status.arms.iter().zip([-0.12, 0.12]) {
            for (at_m, was_m) in arm.tool_in_world_m.iter().zip([x_m, 0.0, 0.095]) {
                assert!((at_m - was_m).abs() < 0.001, "{arm:?}");
            }
        }
        let stopped = client.stop(pb::StopRequest {}).await;
        assert!(stopped.is_ok(), "{stopped:?}");
    });
    assert!(bridge.peak_mib() < 256, "{} MiB", bridge.peak_mib());
    assert!(bridge.ends_on_sigterm(), "{N_IDLE} silent connections do not hold it up");
    drop(idle);
}

/// A short run of one arm that asks nobody.
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

/// Lets a worker play until the run has ended; gives its digest.
async fn follow_to_the_end(client: &mut LearnerClient<Channel>) -> String {
    let mut watched = client.watch(pb::WatchRequest {}).await.expect("watched").into_inner();
    loop {
        let progress = soon("progress", watched.message()).await.expect("goes on").expect("more");
        if progress.ended {
            return progress.digest;
        }
    }
}

fn play(address: SocketAddr) -> Running {
    Running::start(&["worker", "--connect", &address.to_string()])
}

#[test]
fn malformed_input_does_not_change_what_a_learner_learns() {
    let runtime = runtime();
    let calm = tempfile::tempdir().expect("a directory");
    let mut undisturbed = learner(calm.path());
    let _worker = play(undisturbed.address);
    let expected = runtime.block_on(async {
        let address = format!("http://{}", undisturbed.address);
        follow_to_the_end(&mut LearnerClient::connect(address).await.expect("connects")).await
    });
    assert!(undisturbed.ends_well() && expected.len() == 64, "{expected:?}");

    let stormy = tempfile::tempdir().expect("a directory");
    let mut attacked = learner(stormy.path());
    let address = attacked.address;
    let idle = idle_connections(address);
    let digest = runtime.block_on(async {
        let client = LearnerClient::connect(format!("http://{address}")).await;
        let mut client = client.expect("connects");
        attack(address, "tandem.v1.Learner").await;
        assert!(attacked.peak_mib() < 256, "{} MiB", attacked.peak_mib());
        let worker = play(address);
        let (digest, ()) = tokio::join!(follow_to_the_end(&mut client), foreign_episodes(address));
        drop(worker);
        digest
    });
    assert_eq!(digest, expected);
    assert!(attacked.ends_well());
    drop(idle);
}

/// Submits episodes that nobody ordered, or that are no episodes, while the run goes on.
async fn foreign_episodes(address: SocketAddr) {
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
        let request =
            pb::SubmitEpisodesRequest { worker_id: slot * 977, slot, episodes: vec![episode] };
        let body = frame(0, &request.encode_to_vec());
        let answer = wire::call(address, "/tandem.v1.Learner/SubmitEpisodes", &body);
        match soon("foreign episodes", answer).await {
            Answer::Status(Code::InvalidArgument | Code::NotFound, _) => {}
            // The run may be over before all are sent.
            Answer::Closed => return,
            taken => assert_eq!(taken, Answer::Closed, "episodes of slot {slot} by nobody"),
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
