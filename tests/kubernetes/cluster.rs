//! Runs pods as local processes, with loopback addresses for pods and directories for volumes.

use std::collections::BTreeMap;
use std::fs::{self, File, Permissions};
use std::io::{Read as _, Write as _};
use std::net::{Ipv4Addr, SocketAddr, TcpStream};
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::Duration;

use tempfile::TempDir;

use crate::manifests::{Container, Manifests, Probe, Source, ValueFrom, Workload};

/// Limit of every wait, sufficient for busy machines.
const DEADLINE: Duration = Duration::from_secs(180);
const PAUSE: Duration = Duration::from_millis(50);
/// Offset of every port from the manifests' port, to avoid collisions with other services of this machine.
const PORT_SHIFT: u16 = 20_000;
/// Exit code of temporary failures, such as a peer that has not started.
const TRY_AGAIN: i32 = 75;
/// The field that is the index of a pod in an Indexed Job.
const COMPLETION_INDEX: &str = "metadata.annotations['batch.kubernetes.io/job-completion-index']";
/// The secrets that `docs/cluster.md` describes.
pub(crate) const SECRETS: [(&str, &str, &str); 2] = [
    ("tandem-secrets", "token", "the-right-token-0123"),
    ("tandem-secrets", "redis-password", "a-password-of-letters"),
];

/// Pods and their volumes.
pub(crate) struct Cluster {
    manifests: Manifests,
    workspace: TempDir,
    pods: Vec<Pod>,
}

pub(crate) struct Pod {
    pub(crate) name: String,
    workload: String,
    /// Number of the pod in its workload.
    index: u64,
    address: Ipv4Addr,
    process: Option<Child>,
}

impl Cluster {
    pub(crate) fn new(manifests: Manifests) -> Self {
        let workspace = tempfile::tempdir().expect("a directory");
        Self { manifests, workspace, pods: Vec::new() }
    }

    /// Adds `replicas` pods of a workload without starting them and returns their names.
    pub(crate) fn add(&mut self, workload: &str, replicas: u64) -> Vec<String> {
        let pods = (0..replicas).map(|index| Pod {
            name: format!("{workload}-{index}"),
            workload: workload.to_owned(),
            index,
            address: new_address(),
            process: None,
        });
        let mut names = Vec::new();
        for pod in pods {
            fs::create_dir_all(self.root_of(&pod)).expect("a directory");
            names.push(pod.name.clone());
            self.pods.push(pod);
        }
        names
    }

    pub(crate) fn start(&mut self, name: &str) {
        let idx = self.index(name);
        let pod = &self.pods[idx];
        let log = File::options().create(true).append(true).open(self.log_of(pod)).expect("a log");
        let mut command = self.command(pod);
        command.stdout(log.try_clone().expect("a log")).stderr(log);
        self.pods[idx].process = Some(command.spawn().expect("starts"));
    }

    /// Waits until every probe of each of these pods succeeds or the pod is complete. Restarts pods that ended because a
    /// peer was unavailable.
    pub(crate) fn wait_until_ready(&mut self, names: &[String]) {
        for name in names {
            let ready = (0..DEADLINE.as_millis() / PAUSE.as_millis()).any(|_| {
                std::thread::sleep(PAUSE);
                self.restart_if_needed(name) || self.is_healthy(self.pod(name))
            });
            assert!(ready, "{name} did not become ready: {}", self.log(name));
        }
    }

    /// Restarts a pod that ended because a peer was unavailable. Returns true if the pod is complete: it stays ended.
    fn restart_if_needed(&mut self, name: &str) -> bool {
        let idx = self.index(name);
        let process = self.pods[idx].process.as_mut().expect("the pod was started");
        match process.try_wait().expect("ours").map(|status| status.code()) {
            None => {}
            Some(Some(0)) => return true,
            Some(Some(TRY_AGAIN)) => self.start(name),
            Some(code) => panic!("{name} ended with {code:?}: {}", self.log(name)),
        }
        false
    }

    pub(crate) fn is_healthy(&self, pod: &Pod) -> bool {
        let container = &self.workload(pod).container;
        container.probes().all(|probe| self.holds(pod, probe))
    }

    fn holds(&self, pod: &Pod, probe: &Probe) -> bool {
        if let Some(grpc) = &probe.grpc {
            let address = self.pod_address(pod, grpc.port).to_string();
            let mut ask = tandem();
            ask.args(["health", &address, "--service", &grpc.service]);
            return ask.output().expect("runs").status.success();
        }
        if let Some(socket) = &probe.tcp_socket {
            let address = self.pod_address(pod, socket.port);
            return TcpStream::connect_timeout(&address, Duration::from_secs(5)).is_ok();
        }
        let exec = &probe.exec.as_ref().expect("a way to probe").command;
        // Inside a pod the command probes the loopback address at the manifests' port.
        let [port] = &self.workload(pod).container.ports[..] else { panic!("one port") };
        let address = self.pod_address(pod, port.container_port);
        let mut ask = Command::new(&exec[0]);
        ask.args(["-h", &address.ip().to_string(), "-p", &address.port().to_string()]);
        ask.args(&exec[1..]).envs(self.environment(pod));
        ask.output().expect("runs").status.success()
    }

    /// Sends SIGTERM to a pod, as Kubernetes does, and returns its exit code.
    pub(crate) fn terminate(&mut self, name: &str) -> Option<i32> {
        self.signal(name, "-TERM");
        self.wait_for_exit(name)
    }

    /// Kills a pod with SIGKILL, as the loss of a node does.
    pub(crate) fn kill(&mut self, name: &str) {
        self.signal(name, "-KILL");
        assert_eq!(self.wait_for_exit(name), None, "{name} ended by itself");
    }

    pub(crate) fn signal(&self, name: &str, signal: &str) {
        let pid = self.pod(name).process.as_ref().expect("the pod was started").id().to_string();
        let sent = Command::new("kill").args([signal, &pid]).status().expect("kill runs");
        assert!(sent.success(), "{name} has ended: {}", self.log(name));
    }

    pub(crate) fn wait_for_exit(&mut self, name: &str) -> Option<i32> {
        let idx = self.index(name);
        let mut process = self.pods[idx].process.take().expect("the pod was started");
        for _ in 0..DEADLINE.as_millis() / PAUSE.as_millis() {
            if let Some(status) = process.try_wait().expect("ours") {
                return status.code();
            }
            std::thread::sleep(PAUSE);
        }
        drop(process.kill());
        drop(process.wait());
        panic!("{name} does not end: {}", self.log(name));
    }

    /// Reads `/metrics` from a pod's port `metrics` and returns values by name. Empty if the pod is unreachable.
    pub(crate) fn figures(&self, name: &str) -> BTreeMap<String, f64> {
        let pod = self.pod(name);
        let ports = &self.workload(pod).container.ports;
        let port = ports.iter().find(|port| port.name == "metrics").expect("a port for figures");
        let page = get(self.pod_address(pod, port.container_port)).unwrap_or_default();
        let samples = page.lines().filter(|line| !line.starts_with('#'));
        let samples = samples.filter_map(|line| line.rsplit_once(' '));
        samples.filter_map(|(name, value)| Some((name.to_owned(), value.parse().ok()?))).collect()
    }

    /// Polls a pod's metrics until they are as expected.
    pub(crate) fn wait_for_figures(
        &self,
        learner: &str,
        expected: impl Fn(&BTreeMap<String, f64>) -> bool,
    ) -> BTreeMap<String, f64> {
        for _ in 0..DEADLINE.as_millis() / PAUSE.as_millis() {
            let figures = self.figures(learner);
            if expected(&figures) {
                return figures;
            }
            std::thread::sleep(PAUSE);
        }
        panic!("{:?}: {}", self.figures(learner), self.log(learner));
    }

    /// Returns the address of a pod's port.
    pub(crate) fn address(&self, name: &str, port: &str) -> SocketAddr {
        let pod = self.pod(name);
        let ports = &self.workload(pod).container.ports;
        let port = ports.iter().find(|declared| declared.name == port).expect("a port");
        self.pod_address(pod, port.container_port)
    }

    /// Returns the log of a pod.
    pub(crate) fn log(&self, name: &str) -> String {
        fs::read_to_string(self.log_of(self.pod(name))).unwrap_or_default()
    }

    /// Returns the files that a pod has left outside its volumes.
    pub(crate) fn stray_files(&self, name: &str) -> Vec<PathBuf> {
        let left = fs::read_dir(self.root_of(self.pod(name))).expect("a directory");
        left.flatten().map(|entry| entry.path()).collect()
    }

    /// Runs a pod's command with one argument replaced and waits for its end.
    pub(crate) fn run_changed(&self, name: &str, idx: usize, argument: &str) -> Output {
        let pod = self.pod(name);
        let mut changed = self.workload(pod).clone();
        changed.container.args[idx] = argument.to_owned();
        self.command_of(pod, &changed).output().expect("runs")
    }

    /// Runs a pod's command with more arguments and waits for its end.
    pub(crate) fn run_with(&self, name: &str, arguments: &[&str]) -> Output {
        self.command(self.pod(name)).args(arguments).output().expect("runs")
    }

    pub(crate) fn container(&self, name: &str) -> &Container {
        &self.workload(self.pod(name)).container
    }

    pub(crate) fn pod(&self, name: &str) -> &Pod {
        &self.pods[self.index(name)]
    }

    fn index(&self, name: &str) -> usize {
        self.pods.iter().position(|pod| pod.name == name).expect("a pod")
    }

    fn workload(&self, pod: &Pod) -> &Workload {
        &self.manifests.workloads[&pod.workload]
    }

    /// Returns the address of a pod's own port, which the pod must declare.
    fn pod_address(&self, pod: &Pod, port: u16) -> SocketAddr {
        assert!(self.workload(pod).container.has_port(port), "{} declares no {port}", pod.name);
        SocketAddr::from((pod.address, port + PORT_SHIFT))
    }

    fn command(&self, pod: &Pod) -> Command {
        self.command_of(pod, self.workload(pod))
    }

    fn command_of(&self, pod: &Pod, workload: &Workload) -> Command {
        let container = &workload.container;
        let mut command = match container.command[0].as_str() {
            "/usr/local/bin/tandem" => tandem(),
            other => Command::new(other),
        };
        let environment = self.environment(pod);
        let arguments = container.command[1..].iter().chain(&container.args);
        command.args(arguments.map(|text| self.localized(pod, &expanded(text, &environment))));
        command.envs(&environment).current_dir(self.root_of(pod)).stdin(Stdio::null());
        command
    }

    fn environment(&self, pod: &Pod) -> BTreeMap<String, String> {
        let mut environment = BTreeMap::new();
        for variable in &self.workload(pod).container.env {
            let value = match (&variable.value, &variable.value_from) {
                (Some(value), None) => self.localized(pod, &expanded(value, &environment)),
                (None, Some(ValueFrom::SecretKeyRef { name, key })) => secret(name, key),
                (None, Some(ValueFrom::FieldRef { field_path })) => match field_path.as_str() {
                    "metadata.name" => pod.name.clone(),
                    COMPLETION_INDEX => pod.index.to_string(),
                    other => panic!("{}: {other:?}", variable.name),
                },
                other => panic!("{}: {other:?}", variable.name),
            };
            environment.insert(variable.name.clone(), value);
        }
        environment
    }

    /// Replaces the cluster's addresses, ports and paths in a manifest's text by those of this machine.
    fn localized(&self, pod: &Pod, text: &str) -> String {
        let container = &self.workload(pod).container;
        if text.starts_with('/') {
            return self.path(pod, text).to_string_lossy().into_owned();
        }
        if let Ok(port) = text.parse() {
            return if container.has_port(port) { port + PORT_SHIFT } else { port }.to_string();
        }
        if text == "0.0.0.0" {
            return pod.address.to_string();
        }
        let authority = text.split_once("://").map_or(text, |(_, rest)| rest);
        let authority = authority.split('/').next().unwrap_or_default();
        let authority = authority.rsplit('@').next().unwrap_or_default();
        let Some((host, port)) = authority.split_once(':') else { return text.to_owned() };
        let Ok(port) = port.parse() else { return text.to_owned() };
        let there = if host == "0.0.0.0" {
            self.pod_address(pod, port)
        } else {
            self.service_address(pod, host, port)
        };
        text.replace(authority, &there.to_string())
    }

    /// Resolves a service from a pod.
    fn service_address(&self, pod: &Pod, host: &str, port: u16) -> SocketAddr {
        let service = self.manifests.services.get(host);
        let service = service.unwrap_or_else(|| panic!("{} calls {host:?}, no service", pod.name));
        let port = service.ports.get(&port);
        let port = port.unwrap_or_else(|| panic!("{host} has no such port, {} calls it", pod.name));
        let behind: Vec<&Pod> =
            self.pods.iter().filter(|other| other.workload == service.workload).collect();
        let chosen = usize::from(pod.address.octets()[3]) % behind.len();
        self.pod_address(behind[chosen], *port)
    }

    /// Maps a path inside a pod to this machine: below a volume, or in the image.
    fn path(&self, pod: &Pod, path: &str) -> PathBuf {
        if let Some(policy) = path.strip_prefix("/usr/share/tandem/") {
            return Path::new(env!("CARGO_MANIFEST_DIR")).join(policy);
        }
        let mounts = &self.workload(pod).container.volume_mounts;
        let below = mounts
            .iter()
            .find_map(|mount| Some((mount, Path::new(path).strip_prefix(&mount.mount_path).ok()?)));
        let (mount, rest) =
            below.unwrap_or_else(|| panic!("{}: nothing is mounted at {path}", pod.name));
        self.volume(pod, &mount.name).join(rest)
    }

    /// Creates the directory of a pod's volume with its content.
    fn volume(&self, pod: &Pod, name: &str) -> PathBuf {
        let directory = self.workspace.path().join("volumes").join(&pod.name).join(name);
        fs::create_dir_all(&directory).expect("a directory");
        match &self.workload(pod).volumes[name] {
            Source::Claim => {}
            Source::ConfigMap(map) => {
                let settings = &self.manifests.settings;
                assert_eq!(*map, settings.name);
                fs::write(directory.join(&settings.file), &settings.text).expect("writes");
            }
            Source::Secret(files) => {
                for (file, (name, key)) in files {
                    let file = directory.join(file);
                    fs::write(&file, secret(name, key)).expect("writes");
                    fs::set_permissions(&file, Permissions::from_mode(0o640)).expect("ours");
                }
            }
        }
        directory
    }

    /// Returns the working directory of a pod's processes, which replaces the read-only root.
    fn root_of(&self, pod: &Pod) -> PathBuf {
        self.workspace.path().join("roots").join(&pod.name)
    }

    fn log_of(&self, pod: &Pod) -> PathBuf {
        self.workspace.path().join(format!("{}.log", pod.name))
    }
}

impl Drop for Pod {
    fn drop(&mut self) {
        if let Some(process) = &mut self.process {
            drop(process.kill());
            drop(process.wait());
        }
    }
}

fn tandem() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    for variable in ["TANDEM_TOKEN_FILE", "TANDEM_LEDGER", "RUST_LOG"] {
        command.env_remove(variable);
    }
    command
}

/// Returns a loopback address that no other pod of any running test uses.
fn new_address() -> Ipv4Addr {
    static NEXT: AtomicU8 = AtomicU8::new(1);
    let [_, _, high, low] = std::process::id().to_be_bytes();
    Ipv4Addr::new(127, 1 + high % 250, low, NEXT.fetch_add(1, Ordering::Relaxed))
}

fn secret(name: &str, key: &str) -> String {
    let found = SECRETS.iter().find(|(secret, known, _)| (*secret, *known) == (name, key));
    found.unwrap_or_else(|| panic!("there is no {key:?} in a secret {name:?}")).2.to_owned()
}

/// Expands the variables `$(NAME)` of `environment` in `text`.
fn expanded(text: &str, environment: &BTreeMap<String, String>) -> String {
    let known = environment.iter();
    known.fold(text.to_owned(), |text, (name, value)| text.replace(&format!("$({name})"), value))
}

fn get(address: SocketAddr) -> std::io::Result<String> {
    let mut stream = TcpStream::connect_timeout(&address, Duration::from_secs(5))?;
    stream.set_read_timeout(Some(Duration::from_secs(30)))?;
    stream.write_all(b"GET /metrics HTTP/1.1\r\nhost: learner\r\n\r\n")?;
    let mut page = String::new();
    stream.read_to_string(&mut page)?;
    Ok(page)
}
