//! Access control of the built program: tokens, certificates and `tandem health`.

#[path = "access/program.rs"]
mod program;

use prost::Message as _;
use serde_json::{Value, json};
use tandem_proto::pb;
use tandem_proto::pb::learner_client::LearnerClient;
use tandem_proto::pb::teacher_client::TeacherClient;
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Request, Status};

use program::{SECRET, Workspace, eventually, fails_with, teacher};

const OTHER: &str = "another-token-456789";

/// Attaches a bearer token, if any, to each request.
#[derive(Clone)]
struct BearerToken(Option<&'static str>);

impl Interceptor for BearerToken {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(token) = self.0 {
            let value = format!("Bearer {token}").parse().expect("ASCII");
            request.metadata_mut().insert("authorization", value);
        }
        Ok(request)
    }
}

type Caller = InterceptedService<Channel, BearerToken>;

fn caller(address: &str, token: Option<&'static str>) -> Caller {
    let endpoint = Endpoint::from_shared(format!("http://{address}")).expect("an address");
    InterceptedService::new(endpoint.connect_lazy(), BearerToken(token))
}

/// Returns the paths of all methods of a service.
fn methods_of(service: &str) -> Vec<String> {
    let set = prost_types::FileDescriptorSet::decode(tandem_proto::FILE_DESCRIPTOR_SET);
    let services = set.expect("descriptors").file.into_iter().flat_map(|file| file.service);
    services
        .filter(|found| found.name() == service)
        .flat_map(|found| found.method)
        .map(|method| format!("/tandem.v1.{service}/{}", method.name()))
        .collect()
}

/// Calls a method with an empty message and returns the status code. Streaming methods fail with the same code.
async fn code_of(caller: &Caller, path: &str) -> Code {
    let mut caller = tonic::client::Grpc::new(caller.clone());
    caller.ready().await.expect("ready");
    let codec = tonic_prost::ProstCodec::<(), ()>::default();
    let path = path.parse().expect("a path");
    let answer =
        tokio::time::timeout(program::DEADLINE, caller.unary(Request::new(()), path, codec));
    answer.await.expect("an answer").map_or_else(|status| status.code(), |_| Code::Ok)
}

#[test]
fn a_non_loopback_address_requires_a_token() {
    let workspace = Workspace::new();
    for address in ["0.0.0.0:0", "[::]:0", "[::ffff:0.0.0.0]:0"] {
        let line = fails_with(64, workspace.run(&teacher(&["--listen", address])));
        assert!(line.contains("--token-file"), "{line}");
    }
    let mut open = workspace.serve("insecure", &teacher(&["--listen", "0.0.0.0:0", "--insecure"]));
    let mut safe =
        workspace.serve("safe", &teacher(&["--listen", "0.0.0.0:0", "--token-file", "token"]));
    for service in [&mut open, &mut safe] {
        let health = workspace.run(&["health", &service.local_address()]);
        assert_eq!(String::from_utf8_lossy(&health.stdout), "serving\n");
    }
    assert_eq!(safe.end(), Some(0), "{}", safe.log());
    assert!(safe.log().contains("without --tls-cert"), "{}", safe.log());
}

#[test]
fn secrets_and_certificates_that_cannot_be_used_are_refused_at_start() {
    let workspace = Workspace::new();
    workspace.write("empty", " \n");
    workspace.write("short", "short\n");
    workspace.write("nul", "0123456789\0abcdef\n");
    workspace.write("umlaut", "0123456789abcdefü\n");
    let tls = |certificate, key| teacher(&["--tls-cert", certificate, "--tls-key", key]);
    let trust = |authority| {
        ["worker", "--connect", "127.0.0.1:1", "--tls-ca", authority].map(str::to_owned).to_vec()
    };
    for (command, expected) in [
        (teacher(&["--token-file", "empty"]), "it is empty"),
        (teacher(&["--token-file", "short"]), "5 characters"),
        (teacher(&["--token-file", "nul"]), "byte 11"),
        (teacher(&["--token-file", "umlaut"]), "byte 17"),
        (teacher(&["--token-file", "missing"]), "cannot read \"missing\""),
        (tls("missing.pem", "tls.key"), "cannot read \"missing.pem\""),
        (tls("token", "tls.key"), "no certificate"),
        (tls("tls.pem", "tls.pem"), "no private key"),
        (tls("tls.pem", "other.key"), "not the certificate's"),
        (trust("token"), "no certificate"),
        (trust("tls.key"), "no certificate"),
        (trust("missing.pem"), "cannot read \"missing.pem\""),
    ] {
        let line = fails_with(64, workspace.run(&command));
        assert!(line.contains(expected), "{command:?}: {line}");
    }
}

#[cfg(unix)]
#[test]
fn a_world_readable_token_file_is_used_with_a_warning() {
    use std::os::unix::fs::PermissionsExt as _;
    let workspace = Workspace::new();
    for (mode, warned) in [(0o600, false), (0o640, false), (0o644, true)] {
        let mode = std::fs::Permissions::from_mode(mode);
        std::fs::set_permissions(workspace.path().join("token"), mode).expect("our own file");
        let mut service = workspace.serve("teacher", &teacher(&["--token-file", "token"]));
        assert_eq!(service.end(), Some(0), "{}", service.log());
        assert_eq!(service.log().contains("chmod 600"), warned, "{}", service.log());
    }
}

#[test]
fn health_reports_the_service_and_the_cause_of_a_failure() {
    let workspace = Workspace::new();
    let tls = ["--token-file", "token", "--tls-cert", "tls.pem", "--tls-key", "tls.key"];
    let service = workspace.serve("teacher", &teacher(&tls));
    let address = service.address.clone();
    let health = |more: &[&str]| workspace.run(&[&["health", &address], more].concat());

    assert_eq!(String::from_utf8_lossy(&health(&["--tls-ca", "ca.pem"]).stdout), "serving\n");
    let named = health(&["--tls-ca", "ca.pem", "--service", "tandem.v1.Teacher", "--json"]);
    let shown: Value = serde_json::from_slice(&named.stdout).expect("JSON");
    let expected = json!({"address": address, "service": "tandem.v1.Teacher", "serving": true, "reason": null});
    assert_eq!((named.status.code(), shown), (Some(0), expected));

    let other = ["--tls-ca", "ca.pem", "--service", "tandem.v1.Learner"];
    let line = fails_with(75, health(&other));
    assert!(line.contains(&address) && line.contains("tandem.v1.Learner"), "{line}");
    let line = fails_with(75, health(&[]));
    assert!(line.contains(&address) && line.contains("--tls-ca"), "{line}");
    let line = fails_with(75, health(&["--tls-ca", "other.pem"]));
    assert!(line.contains(&address) && line.contains("--tls-ca"), "{line}");

    drop(service);
    let gone = health(&["--tls-ca", "ca.pem", "--json"]);
    let shown: Value = serde_json::from_slice(&gone.stdout).expect("JSON");
    assert_eq!((gone.status.code(), &shown["serving"]), (Some(75), &json!(false)));
    assert!(
        shown["reason"].as_str().is_some_and(|reason| reason.contains("nothing listens")),
        "{shown}"
    );
    fails_with(64, workspace.run(&["health", "nowhere"]));
}

#[test]
fn a_worker_answers_health_checks_while_it_waits_for_a_learner() {
    let workspace = Workspace::new();
    let worker = |listen| ["worker", "--connect", "127.0.0.1:1", "--listen", listen];
    let mut waiting = workspace.serve("worker", &worker("127.0.0.1:0"));
    let address = waiting.address.clone();
    for service in ["", "tandem.v1.Worker"] {
        let health = workspace.run(&["health", &address, "--service", service]);
        assert_eq!(String::from_utf8_lossy(&health.stdout), "serving\n", "{}", waiting.log());
    }
    let line = fails_with(64, workspace.run(&["status", &address]));
    assert!(line.contains(&format!("the service at {address} is a worker, not a ")), "{line}");
    let line = fails_with(75, workspace.run(&worker(&address)));
    assert!(line.contains(&address) && line.contains("another --listen"), "{line}");
    let line = fails_with(64, workspace.run(&worker("0.0.0.0:0")));
    assert!(line.contains("--token-file"), "{line}");
    assert_eq!(waiting.end(), Some(130), "{}", waiting.log());
}

#[test]
fn a_service_that_never_answers_is_unhealthy_after_the_timeout() {
    let silent = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = silent.local_addr().expect("bound").to_string();
    let line = fails_with(75, Workspace::new().run(&["health", &address, "--timeout-s", "0.2"]));
    assert!(line.contains(&address) && line.contains("200ms"), "{line}");
}

#[tokio::test]
async fn calls_without_the_right_token_are_rejected_without_effect() {
    let workspace = Workspace::new();
    let mut teacher = workspace.serve("teacher", &teacher(&["--token-file", "token"]));
    let right = ["--teacher", &teacher.address, "--token-file", "token"];
    let mut learner = workspace.serve("learner", &workspace.learner(&right));
    let relay = ["relay", "--connect", &learner.address, "--token-file", "token"];
    let relay = workspace.serve("relay", &relay);

    let bridge = workspace.serve("bridge", &["bridge", "--driver", "sim", "--token-file", "token"]);

    let [teacher_calls, learner_calls, bridge_calls] =
        ["Teacher", "Learner", "Bridge"].map(methods_of);
    assert!(teacher_calls.len() >= 7 && learner_calls.len() >= 6 && bridge_calls.len() >= 6);
    let services = [
        (&teacher.address, teacher_calls),
        (&learner.address, learner_calls.clone()),
        (&relay.address, learner_calls),
        (&bridge.address, bridge_calls),
    ];
    for token in [None, Some(OTHER)] {
        for (address, calls) in &services {
            let intruder = caller(address, token);
            for path in calls {
                assert_eq!(code_of(&intruder, path).await, Code::Unauthenticated, "{path}");
            }
        }
        let mut intruder = TeacherClient::new(caller(&teacher.address, token));
        let opened = intruder.open_account(account("intruder")).await.expect_err("rejected");
        assert_eq!(opened.code(), Code::Unauthenticated);
        let mut intruder = LearnerClient::new(caller(&learner.address, token));
        let joined = intruder.join(worker("intruder")).await.expect_err("rejected");
        assert_eq!(joined.code(), Code::Unauthenticated);
    }

    let mut allowed = TeacherClient::new(caller(&teacher.address, Some(SECRET)));
    let named = pb::GetAccountRequest { name: "intruder".to_owned() };
    let sought = allowed.get_account(named).await.expect_err("the account was not opened");
    assert_eq!(sought.code(), Code::NotFound);
    let args = ["worker", "--name", "allowed", "--connect", &learner.address];
    let _worker = workspace.start("worker", &[&args[..], &right].concat());
    let mut watcher = LearnerClient::new(caller(&learner.address, Some(SECRET)));
    let shown = async {
        let watched = watcher.watch(pb::WatchRequest {}).await;
        let mut stream = watched.expect("the watch is permitted").into_inner();
        loop {
            let progress = stream.message().await.expect("the stream continues").expect("progress");
            if !progress.workers.is_empty() {
                return progress.workers;
            }
        }
    };
    let workers = tokio::time::timeout(program::DEADLINE, shown).await.expect("a worker is listed");
    let names: Vec<String> = workers.into_iter().map(|worker| worker.name).collect();
    assert_eq!(names, ["allowed"]);
    for service in [&mut teacher, &mut learner] {
        service.end();
        assert!(!service.log().contains("intruder"), "{}", service.log());
    }
}

fn account(name: &str) -> pb::OpenAccountRequest {
    pb::OpenAccountRequest { name: name.to_owned(), budget: 10, strategy: "ea".to_owned() }
}

fn worker(name: &str) -> pb::JoinRequest {
    pb::JoinRequest { worker: name.to_owned(), version: env!("CARGO_PKG_VERSION").to_owned() }
}

#[test]
fn learners_and_workers_with_a_wrong_token_exit_with_an_error() {
    let workspace = Workspace::new();
    workspace.write("other-token", OTHER);
    let teacher = workspace.serve("teacher", &teacher(&["--token-file", "token"]));
    let right = ["--teacher", &teacher.address, "--token-file", "token"];
    let learner = workspace.serve("learner", &workspace.learner(&right));
    let worker = ["worker", "--connect", &learner.address, "--teacher", &teacher.address];
    for token in [&["--token-file", "other-token"][..], &[]] {
        let line = fails_with(64, workspace.run(&[&worker[..], token].concat()));
        assert!(line.contains(&learner.address) && line.contains("--token-file"), "{line}");
        let args = [&["--teacher", &teacher.address][..], token].concat();
        let line = fails_with(64, workspace.run(&workspace.learner(&args)));
        assert!(line.contains(&teacher.address) && line.contains("--token-file"), "{line}");
    }
}

#[test]
fn a_command_that_dials_the_wrong_service_ends_and_names_it() {
    let workspace = Workspace::new();
    let teacher = workspace.serve("teacher", &teacher(&[]));
    let learner = workspace.serve("learner", &workspace.learner(&["--teacher", &teacher.address]));
    let (teacher, learner) = (teacher.address.as_str(), learner.address.as_str());
    let command = |args: &[&str]| args.iter().copied().map(str::to_owned).collect::<Vec<_>>();
    let is_teacher = format!("the service at {teacher} is a teacher, not a ");
    let is_learner = format!("the service at {learner} is a learner, not a ");
    for (command, expected) in [
        (command(&["worker", "--connect", teacher, "--teacher", learner]), &is_teacher),
        (command(&["worker", "--connect", learner, "--teacher", learner]), &is_learner),
        (workspace.learner(&["--teacher", learner]), &is_learner),
        (command(&["status", teacher]), &is_teacher),
        (command(&["status", teacher, "--watch"]), &is_teacher),
        (command(&["bridge", "stop", "--connect", teacher]), &is_teacher),
        (command(&["bridge", "reset", "--connect", learner]), &is_learner),
    ] {
        let line = fails_with(64, workspace.run(&command));
        assert!(line.contains(expected), "{command:?}: {line}");
        let hint = match (command[0].as_str(), expected == &is_learner) {
            ("status" | "bridge", true) => format!("`tandem status {learner}`"),
            ("status" | "bridge", false) => format!("`tandem health {teacher}`"),
            _ => continue,
        };
        assert!(line.contains(&hint), "{command:?}: {line}");
    }
}

#[test]
fn a_tls_mismatch_is_explained_and_retried() {
    let workspace = Workspace::new();
    let plain = workspace.serve("plain", &teacher(&[]));
    let tls = workspace.serve("tls", &teacher(&["--tls-cert", "tls.pem", "--tls-key", "tls.key"]));
    let worker = |address: &str| ["worker", "--connect", address].map(str::to_owned).to_vec();
    let trusting = |mut command: Vec<String>| {
        command.extend(["--tls-ca".to_owned(), "ca.pem".to_owned()]);
        command
    };
    let learner = |address: &str| workspace.learner(&["--teacher", address]);
    for (name, command, message) in [
        ("plain-worker", worker(&tls.address), "speaks TLS"),
        ("tls-worker", trusting(worker(&plain.address)), "does not speak TLS"),
        ("plain-learner", learner(&tls.address), "speaks TLS"),
        ("tls-learner", trusting(learner(&plain.address)), "does not speak TLS"),
    ] {
        let debug = ["--log".to_owned(), "tandem_net::retry=debug".to_owned()];
        let mut running = workspace.start(name, &[command, debug.to_vec()].concat());
        let logged_twice = || running.log().matches(message).count() >= 2;
        assert!(eventually(logged_twice), "{name}: {}", running.log());
        let warnings =
            |log: &str| log.lines().filter(|line| line.contains("call failed, ")).count();
        assert_eq!(warnings(&running.log()), 1, "{name}: {}", running.log());
        assert!(running.log().contains("--tls-ca"), "{name}: {}", running.log());
        assert!(running.is_alive(), "{name}: {}", running.log());
    }
}

#[test]
fn a_run_through_a_relay_over_tls_with_a_token_succeeds() {
    let workspace = Workspace::new();
    let offer = ["--token-file", "token", "--tls-cert", "tls.pem", "--tls-key", "tls.key"];
    let call = ["--token-file", "token", "--tls-ca", "ca.pem"];
    let teacher = workspace.serve("teacher", &teacher(&offer));
    let more = [&["--teacher", &teacher.address, "--tls-ca", "ca.pem"][..], &offer].concat();
    let mut learner = workspace.serve("learner", &workspace.learner(&more));
    let relay = ["relay", "--connect", &learner.address, "--tls-ca", "ca.pem"];
    let relay = workspace.serve("relay", &[&relay[..], &offer].concat());
    let health = workspace.run(&["health", &relay.address, "--tls-ca", "ca.pem"]);
    assert_eq!(String::from_utf8_lossy(&health.stdout), "serving\n");
    let worker = ["worker", "--connect", &relay.address, "--teacher", &teacher.address];
    let worked = workspace.run(&[&worker[..], &call].concat());
    assert!(worked.status.success(), "{}", String::from_utf8_lossy(&worked.stderr));
    assert_eq!(learner.wait(), Some(0), "{}", learner.log());
}

#[test]
fn a_run_over_tls_with_a_token_succeeds() {
    let workspace = Workspace::new();
    let offer = ["--token-file", "token", "--tls-cert", "tls.pem", "--tls-key", "tls.key"];
    let call = ["--token-file", "token", "--tls-ca", "ca.pem"];
    let teacher = workspace.serve("teacher", &teacher(&offer));
    let more = [&["--teacher", &teacher.address, "--tls-ca", "ca.pem"][..], &offer].concat();
    let mut learner = workspace.serve("learner", &workspace.learner(&more));
    let worker = ["worker", "--connect", &learner.address, "--teacher", &teacher.address];
    let worked = workspace.run(&[&worker[..], &call].concat());
    assert!(worked.status.success(), "{}", String::from_utf8_lossy(&worked.stderr));
    assert_eq!(learner.wait(), Some(0), "{}", learner.log());
    assert!(learner.log().contains("advice account opened"), "{}", learner.log());
}
