//! One machine that runs pods as processes: addresses of the loopback for pods, directories for volumes.

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

/// Longer than anything takes, even on a machine that is busy with other things.
const DEADLINE: Duration = Duration::from_secs(180);
const PAUSE: Duration = Duration::from_millis(50);
/// Every port is so much higher than the manifests say, so that what this machine offers by itself is not in the way.
const PORT_SHIFT: u16 = 20_000;
/// How the program ends when it is worth trying again, as when a peer is not there yet.
const TRY_AGAIN: i32 = 75;
/// The secret that `docs/cluster.md` tells people to make.
pub(crate) const SECRETS: [(&str, &str, &str); 2] = [
    ("tandem-secrets", "token", "the-right-token-0123"),
    ("tandem-secrets", "redis-password", "a-password-of-letters"),
];

/// Pods and their volumes.
pub(crate) struct Cluster {
    manifests: Manifests,
    run: String,
    place: TempDir,
    pods: Vec<Pod>,
}

pub(crate) struct Pod {
    pub(crate) name: String,
    workload: String,
    address: Ipv4Addr,
    process: Option<Child>,
}

impl Cluster {
    /// An empty cluster whose learner reads `run` as its run file.
    pub(crate) fn new(manifests: Manifests, run: String) -> Self {
        let place = tempfile::tempdir().expect("a directory");
        Self { manifests, run, place, pods: Vec::new() }
    }

    /// Adds `replicas` pods of a workload, which are not started yet; gives their names.
    pub(crate) fn add(&mut self, workload: &str, replicas: u64) -> Vec<String> {
        let names: Vec<String> = (0..replicas).map(|idx| format!("{workload}-{idx}")).collect();
        for name in &names {
            let pod = Pod {
                name: name.clone(),
                workload: workload.to_owned(),
                address: new_address(),
                process: None,
            };
            fs::create_dir_all(self.root_of(&pod)).expect("a directory");
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

    /// Waits until every probe of every pod holds. A pod that ended because a peer was not there is started again.
    pub(crate) fn wait_until_ready(&mut self) {
        let names: Vec<String> = self.pods.iter().map(|pod| pod.name.clone()).collect();
        for name in names {
            let ready = (0..DEADLINE.as_millis() / PAUSE.as_millis()).any(|_| {
                std::thread::sleep(PAUSE);
                self.tend(&name);
                self.is_well(self.pod(&name))
            });
            assert!(ready, "{name} does not get ready: {}", self.log(&name));
        }
    }

    /// Starts a pod again that ended because a peer was not there; one that is through with the run stays so.
    fn tend(&mut self, name: &str) {
        let idx = self.index(name);
        let process = self.pods[idx].process.as_mut().expect("it was started");
        match process.try_wait().expect("ours").map(|status| status.code()) {
            None | Some(Some(0)) => {}
            Some(Some(TRY_AGAIN)) => self.start(name),
            Some(code) => panic!("{name} ended with {code:?}: {}", self.log(name)),
        }
    }

    pub(crate) fn is_well(&self, pod: &Pod) -> bool {
        let container = &self.workload(pod).container;
        container.probes().all(|probe| self.holds(pod, probe))
    }

    fn holds(&self, pod: &Pod, probe: &Probe) -> bool {
        if let Some(grpc) = &probe.grpc {
            let address = self.inside(pod, grpc.port).to_string();
            let mut ask = tandem();
            ask.args(["health", &address, "--service", &grpc.service]);
            return ask.output().expect("runs").status.success();
        }
        if let Some(socket) = &probe.tcp_socket {
            let address = self.inside(pod, socket.port);
            return TcpStream::connect_timeout(&address, Duration::from_secs(5)).is_ok();
        }
        let exec = &probe.exec.as_ref().expect("a way to probe").command;
        // Inside a pod this asks the loopback, at the port that the manifests say.
        let [port] = &self.workload(pod).container.ports[..] else { panic!("one port") };
        let address = self.inside(pod, port.container_port);
        let mut ask = Command::new(&exec[0]);
        ask.args(["-h", &address.ip().to_string(), "-p", &address.port().to_string()]);
        ask.args(&exec[1..]).envs(self.environment(pod));
        ask.output().expect("runs").status.success()
    }

    /// Asks a pod to end as Kubernetes does; gives its exit code.
    pub(crate) fn terminate(&mut self, name: &str) -> Option<i32> {
        self.signal(name, "-TERM");
        self.wait_for_the_end(name)
    }

    /// Ends a pod as a lost node does.
    pub(crate) fn kill(&mut self, name: &str) {
        self.signal(name, "-KILL");
        assert_eq!(self.wait_for_the_end(name), None, "{name} ended by itself");
    }

    fn signal(&self, name: &str, signal: &str) {
        let pid = self.pod(name).process.as_ref().expect("it was started").id().to_string();
        let sent = Command::new("kill").args([signal, &pid]).status().expect("kill runs");
        assert!(sent.success(), "{name} is gone: {}", self.log(name));
    }

    pub(crate) fn wait_for_the_end(&mut self, name: &str) -> Option<i32> {
        let idx = self.index(name);
        let mut process = self.pods[idx].process.take().expect("it was started");
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

    /// What stands at `/metrics` of a pod's port of that name: values by name; nothing when it cannot be asked.
    pub(crate) fn figures(&self, name: &str) -> BTreeMap<String, f64> {
        let pod = self.pod(name);
        let ports = &self.workload(pod).container.ports;
        let port = ports.iter().find(|port| port.name == "metrics").expect("a port for figures");
        let page = get(self.inside(pod, port.container_port)).unwrap_or_default();
        let samples = page.lines().filter(|line| !line.starts_with('#'));
        let samples = samples.filter_map(|line| line.rsplit_once(' '));
        samples.filter_map(|(name, value)| Some((name.to_owned(), value.parse().ok()?))).collect()
    }

    /// Looks at the learner's figures until they are as expected.
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

    /// Where others reach a pod's port.
    pub(crate) fn address(&self, name: &str, port: &str) -> SocketAddr {
        let pod = self.pod(name);
        let ports = &self.workload(pod).container.ports;
        let port = ports.iter().find(|declared| declared.name == port).expect("a port");
        self.inside(pod, port.container_port)
    }

    /// What a pod's processes have said.
    pub(crate) fn log(&self, name: &str) -> String {
        fs::read_to_string(self.log_of(self.pod(name))).unwrap_or_default()
    }

    /// Files that a pod has left outside its volumes.
    pub(crate) fn litter(&self, name: &str) -> Vec<PathBuf> {
        let left = fs::read_dir(self.root_of(self.pod(name))).expect("a directory");
        left.flatten().map(|entry| entry.path()).collect()
    }

    /// Runs a pod's command to its end, with one of its arguments changed.
    pub(crate) fn run_changed(&self, name: &str, idx: usize, argument: &str) -> Output {
        let pod = self.pod(name);
        let mut changed = self.workload(pod).clone();
        changed.container.args[idx] = argument.to_owned();
        self.command_of(pod, &changed).output().expect("runs")
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

    /// The address of a pod's own port, which it must have declared.
    fn inside(&self, pod: &Pod, port: u16) -> SocketAddr {
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
        command.args(arguments.map(|text| self.localised(pod, &expanded(text, &environment))));
        command.envs(&environment).current_dir(self.root_of(pod)).stdin(Stdio::null());
        command
    }

    fn environment(&self, pod: &Pod) -> BTreeMap<String, String> {
        let mut environment = BTreeMap::new();
        for variable in &self.workload(pod).container.env {
            let value = match (&variable.value, &variable.value_from) {
                (Some(value), None) => self.localised(pod, &expanded(value, &environment)),
                (None, Some(ValueFrom::SecretKeyRef { name, key })) => secret(name, key),
                (None, Some(ValueFrom::FieldRef { field_path })) => {
                    assert_eq!(field_path, "metadata.name");
                    pod.name.clone()
                }
                other => panic!("{}: {other:?}", variable.name),
            };
            environment.insert(variable.name.clone(), value);
        }
        environment
    }

    /// A text of a manifest with this machine's addresses, ports and directories in place of a cluster's.
    fn localised(&self, pod: &Pod, text: &str) -> String {
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
        let there =
            if host == "0.0.0.0" { self.inside(pod, port) } else { self.called(pod, host, port) };
        text.replace(authority, &there.to_string())
    }

    /// Where a service leads a pod.
    fn called(&self, pod: &Pod, host: &str, port: u16) -> SocketAddr {
        let service = self.manifests.services.get(host);
        let service = service.unwrap_or_else(|| panic!("{} calls {host:?}, no service", pod.name));
        let port = service.ports.get(&port);
        let port = port.unwrap_or_else(|| panic!("{host} has no such port, {} calls it", pod.name));
        let behind: Vec<&Pod> =
            self.pods.iter().filter(|other| other.workload == service.workload).collect();
        let chosen = usize::from(pod.address.octets()[3]) % behind.len();
        self.inside(behind[chosen], *port)
    }

    /// What stands for a path inside a pod: below a volume, or in the image.
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

    /// The directory of a pod's volume, filled with what belongs there.
    fn volume(&self, pod: &Pod, name: &str) -> PathBuf {
        let directory = self.place.path().join("volumes").join(&pod.name).join(name);
        fs::create_dir_all(&directory).expect("a directory");
        match &self.workload(pod).volumes[name] {
            Source::Claim => {}
            Source::ConfigMap(map) => {
                assert_eq!(map, "tandem-run");
                fs::write(directory.join("run.toml"), &self.run).expect("writes");
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

    /// Where a pod's processes start, in place of a root that cannot be written to.
    fn root_of(&self, pod: &Pod) -> PathBuf {
        self.place.path().join("roots").join(&pod.name)
    }

    fn log_of(&self, pod: &Pod) -> PathBuf {
        self.place.path().join(format!("{}.log", pod.name))
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

/// An address of the loopback that no other pod of any running test has.
fn new_address() -> Ipv4Addr {
    static NEXT: AtomicU8 = AtomicU8::new(1);
    let [_, _, high, low] = std::process::id().to_be_bytes();
    Ipv4Addr::new(127, 1 + high % 250, low, NEXT.fetch_add(1, Ordering::Relaxed))
}

fn secret(name: &str, key: &str) -> String {
    let found = SECRETS.iter().find(|(secret, known, _)| (*secret, *known) == (name, key));
    found.unwrap_or_else(|| panic!("there is no {key:?} in a secret {name:?}")).2.to_owned()
}

/// `text` with the variables `$(NAME)` that are known by now.
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
