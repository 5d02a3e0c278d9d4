//! Runs the commands, arguments, settings and probes of the Kubernetes manifests as local processes.
//!
//! Pods get loopback addresses, services resolve to them and volumes are directories. The tests check everything that
//! needs no cluster: commands are spelt correctly, fit together and recover when they are killed.
#![cfg(target_os = "linux")]
#![expect(clippy::panic, reason = "a test panics where it fails")]

#[path = "kubernetes/cluster.rs"]
mod cluster;
#[path = "kubernetes/manifests.rs"]
mod manifests;
#[path = "services/skipped.rs"]
mod skipped;

use std::collections::{BTreeMap, BTreeSet};
use std::process::{Command, Stdio};

use tandem_proto::pb;
use tandem_proto::pb::teacher_client::TeacherClient;
use tokio::runtime::Builder;
use toml::{Table, Value};
use tonic::Request;
use tonic::transport::Endpoint;

use cluster::{Cluster, SECRETS};
use manifests::Manifests;
use skipped::skip;

const ENV_STEPS: i64 = 4_000;

/// Shrinks the run file of the manifests: rounds of 4 slots, small networks, few updates.
fn small(run: &str) -> String {
    let mut run: Table = run.parse().expect("a run file");
    let mut change = |section: &str, key: &str, value: Value| {
        let section = run.entry(section).or_insert_with(|| Value::Table(Table::new()));
        section.as_table_mut().expect("a section").insert(key.to_owned(), value);
    };
    change("rounds", "slots", Value::Integer(4));
    change("rounds", "updates_per_env_step", Value::Float(0.05));
    change("rounds", "warmup_env_steps", Value::Integer(400));
    change("ddpg", "n_hidden", Value::Integer(16));
    change("world", "substeps", Value::Integer(10));
    change("evaluation", "episodes", Value::Integer(4));
    change("evaluation", "every_env_steps", Value::Integer(2_000));
    change("checkpoint", "every_rounds", Value::Integer(1));
    change("stop", "max_env_steps", Value::Integer(ENV_STEPS));
    toml::to_string(&run).expect("TOML")
}

/// Returns the manifests of a training run with a small run.
fn small_base() -> Manifests {
    let mut manifests = Manifests::of_base();
    manifests.settings.text = small(&manifests.settings.text);
    manifests
}

/// Returns true if Redis is installed. Otherwise, reports that.
fn has_redis() -> bool {
    let is_installed = |program: &str| {
        Command::new(program).arg("--version").stdout(Stdio::null()).status().is_ok()
    };
    let installed = is_installed("redis-server") && is_installed("redis-cli");
    if !installed {
        skip("REDIS", "a run as the Kubernetes manifests describe it: Redis is not installed");
    }
    installed
}

/// Returns the units spent and left of an account in the teachers' ledger.
fn account(cluster: &Cluster, teacher: &str, name: &str) -> (u64, u64) {
    let address = format!("http://{}", cluster.address(teacher, "grpc"));
    let mut request = Request::new(pb::GetAccountRequest { name: name.to_owned() });
    let token = format!("Bearer {}", SECRETS[0].2).parse().expect("ASCII");
    request.metadata_mut().insert("authorization", token);
    let runtime = Builder::new_current_thread().enable_all().build().expect("a runtime");
    let account = runtime.block_on(async {
        let mut teacher =
            TeacherClient::new(Endpoint::from_shared(address).expect("an address").connect_lazy());
        teacher.get_account(request).await.expect("an account").into_inner()
    });
    assert_eq!(account.leased, 0);
    (account.spent, account.left)
}

/// Starts all pods at once, as `kubectl apply` does, and waits until they are ready. A pod that starts too early retries.
fn start(cluster: &mut Cluster, names: &[String]) {
    for name in names {
        cluster.start(name);
    }
    // A fast machine would end the run before every pod was seen to be ready.
    let (workers, services): (Vec<String>, Vec<String>) =
        names.iter().cloned().partition(|name| name.starts_with("worker-"));
    for worker in &workers {
        cluster.signal(worker, "-STOP");
    }
    cluster.wait_until_ready(&services);
    for worker in &workers {
        cluster.signal(worker, "-CONT");
    }
    cluster.wait_until_ready(&workers);
}

#[test]
fn the_manifests_train_to_the_end_while_pods_are_deleted() {
    if !has_redis() {
        return;
    }
    let manifests = small_base();
    let workloads = manifests.workloads.clone();
    let mut cluster = Cluster::new(manifests);
    let mut names = Vec::new();
    for (name, workload) in &workloads {
        names.extend(cluster.add(name, workload.replicas));
    }
    assert_eq!(
        names,
        ["bridge-0", "learner-0", "redis-0", "teacher-0", "teacher-1", "worker-0", "worker-1"]
    );
    start(&mut cluster, &names);

    let rounds = |figures: &BTreeMap<String, f64>| {
        figures.get("tandem_run_rounds").copied().unwrap_or_default()
    };
    let before = cluster.wait_for_figures("learner-0", |figures| rounds(figures) >= 2.0);
    assert_eq!(before["tandem_ended"], 0.0, "the run ended before the first disturbance");
    assert_eq!(cluster.terminate("learner-0"), Some(130), "{}", cluster.log("learner-0"));
    // Not 0, the code that completes the job of the workers.
    assert_eq!(cluster.terminate("worker-0"), Some(130), "{}", cluster.log("worker-0"));
    cluster.start("worker-0");
    for taken in ["redis-0", "teacher-1", "worker-1"] {
        cluster.kill(taken);
        cluster.start(taken);
    }
    cluster.start("learner-0");
    cluster.wait_until_ready(&names);
    assert!(cluster.log("learner-0").contains("run resumed"), "{}", cluster.log("learner-0"));

    let figures =
        cluster.wait_for_figures("learner-0", |figures| figures.get("tandem_ended") == Some(&1.0));
    assert!(rounds(&figures) > rounds(&before));
    assert_eq!(figures["tandem_run_env_steps"], ENV_STEPS as f64);
    let (spent, left) = account(&cluster, "teacher-0", "push");
    assert!(spent > 0);
    assert_eq!(figures["tandem_run_advice_spent"], spent as f64);
    assert_eq!(figures["tandem_advice_left"], left as f64);

    for worker in ["worker-0", "worker-1"] {
        assert_eq!(cluster.wait_for_exit(worker), Some(0), "{}", cluster.log(worker));
    }
    // The results remain available.
    assert!(cluster.is_healthy(cluster.pod("learner-0")), "{}", cluster.log("learner-0"));
    for asked in ["learner-0", "teacher-0", "teacher-1", "bridge-0", "redis-0"] {
        assert_eq!(cluster.terminate(asked), Some(0), "{asked}: {}", cluster.log(asked));
    }
    for name in &names {
        assert!(
            cluster.stray_files(name).is_empty(),
            "{name} wrote {:?}",
            cluster.stray_files(name)
        );
        let shown = SECRETS.iter().find(|(_, _, value)| cluster.log(name).contains(value));
        assert!(shown.is_none(), "{name} logs a secret: {}", cluster.log(name));
    }
}

#[test]
fn a_misspelt_argument_in_a_manifest_is_detected() {
    let mut cluster = Cluster::new(small_base());
    for name in ["redis", "teacher", "learner", "bridge", "worker"] {
        cluster.add(name, 1);
    }
    for name in ["teacher-0", "learner-0", "bridge-0", "worker-0"] {
        let args = cluster.container(name).args.clone();
        let named = args.iter().enumerate();
        for (idx, flag) in named.filter(|(idx, arg)| *idx == 0 || arg.starts_with("--")) {
            let misspelt = format!("{flag}x");
            let output = cluster.run_changed(name, idx, &misspelt);
            let stderr = String::from_utf8_lossy(&output.stderr);
            assert_eq!(output.status.code(), Some(64), "{misspelt}: {stderr}");
            assert!(stderr.contains(&misspelt), "{misspelt}: {stderr}");
        }
    }
}

#[test]
fn each_pod_of_the_sweep_plans_a_run_of_its_own() {
    let manifests = Manifests::of_sweep();
    let completions = manifests.workloads["sweep"].completions.expect("an Indexed Job");
    let mut cluster = Cluster::new(manifests);
    // One more than the Job has: its index must be out of range.
    let mut pods = cluster.add("sweep", completions + 1);
    let surplus = pods.pop().expect("a pod");
    let mut planned = BTreeSet::new();
    for (idx, pod) in pods.iter().enumerate() {
        let output = cluster.run_with(pod, &["--dry-run", "--json"]);
        assert!(output.status.success(), "{pod}: {}", String::from_utf8_lossy(&output.stderr));
        let plan: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
        let runs = plan["runs"].as_array().expect("a list");
        assert_eq!(runs.len(), 1, "{pod}: {plan}");
        assert_eq!(runs[0]["index"], idx, "{pod}: {plan}");
        planned.insert(runs[0]["name"].as_str().expect("a name").to_owned());
    }
    assert_eq!(planned.len(), pods.len(), "{planned:?}");
    let output = cluster.run_with(&surplus, &["--dry-run"]);
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(64), "{stderr}");
    assert!(stderr.contains(&format!("--only {completions}")), "{stderr}");
}
