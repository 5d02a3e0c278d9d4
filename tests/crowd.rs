//! Clients that hold as many connections to a service as it may have open files: operators and probes still get in.

#![cfg(target_os = "linux")]

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use tempfile::TempDir;
use tokio::runtime::Runtime;
use tokio::time::Instant;
use tonic::transport::{Channel, Endpoint};
use tonic::{Request, Streaming};

/// Limit of open files of a service.
const MAX_FILES: usize = 256;
/// Number of connections of a crowd.
const N_CLIENTS: usize = 300;
/// Limit of every wait, sufficient for busy machines.
const DEADLINE: Duration = Duration::from_secs(60);
const PAUSE: Duration = Duration::from_millis(20);
const SECRET: &str = "the-right-token-0123";
const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
/// An empty HTTP/2 settings frame.
const SETTINGS: [u8; 9] = [0, 0, 0, 4, 0, 0, 0, 0, 0];

/// A service that may have [`MAX_FILES`] open files.
struct Service {
    child: Child,
    address: SocketAddr,
    directory: TempDir,
}

impl Service {
    /// Starts `tandem ARGS` next to a file `token` and waits until it prints its address.
    fn start(args: &[&str]) -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        fs::write(directory.path().join("token"), SECRET).expect("writes");
        let log = File::create(directory.path().join("log")).expect("a log");
        let script = format!("ulimit -n {MAX_FILES}; exec \"$0\" \"$@\"");
        let mut command = Command::new("sh");
        command.args(["-c", &script, env!("CARGO_BIN_EXE_tandem")]).args(args);
        command.args(["--listen", "127.0.0.1:0"]).current_dir(directory.path());
        command.env_remove("TANDEM_TOKEN_FILE").env_remove("RUST_LOG");
        let streams = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(log);
        let mut child = streams.spawn().expect("starts");
        let mut line = String::new();
        let mut output = BufReader::new(child.stdout.take().expect("piped"));
        output.read_line(&mut line).expect("a line");
        let address = line.trim().strip_prefix("listening on ").expect("an address");
        Self { address: address.parse().expect("an address"), child, directory }
    }

    fn log(&self) -> String {
        fs::read_to_string(self.directory.path().join("log")).expect("readable")
    }

    fn n_files(&self) -> usize {
        let files = PathBuf::from(format!("/proc/{}/fd", self.child.id()));
        fs::read_dir(files).expect("it lives").count()
    }

    /// Returns the processor time used so far, in clock ticks.
    fn cpu_ticks(&self) -> u64 {
        let stat = fs::read_to_string(format!("/proc/{}/stat", self.child.id()));
        let stat = stat.expect("it lives");
        let (_, fields) = stat.rsplit_once(") ").expect("a name in brackets");
        let ticks = fields.split(' ').skip(11).take(2);
        ticks.map(|ticks| ticks.parse::<u64>().expect("a number")).sum()
    }

    /// Measures the share of a core that the service uses.
    fn cpu_share(&self) -> f64 {
        let (before, since) = (self.cpu_ticks(), Instant::now());
        std::thread::sleep(Duration::from_millis(500));
        let used = (self.cpu_ticks() - before) as f64;
        used / rustix::param::clock_ticks_per_second() as f64 / since.elapsed().as_secs_f64()
    }

    /// Waits until the service has accepted as many clients as it can.
    fn wait_until_full(&self) {
        let since = Instant::now();
        // A dashboard and the page of metrics have their own shares of the files.
        while self.n_files() < 9 * MAX_FILES / 16 {
            assert!(since.elapsed() < DEADLINE, "{} files: {}", self.n_files(), self.log());
            std::thread::sleep(PAUSE);
        }
    }

    fn run(&self, args: &[&str]) -> Output {
        let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
        command.args(args).current_dir(self.directory.path()).stdin(Stdio::null());
        command.env_remove("TANDEM_TOKEN_FILE").env_remove("RUST_LOG");
        command.output().expect("runs")
    }

    /// Runs a command, which must succeed.
    fn succeed(&self, args: &[&str]) {
        let Output { status, stderr, .. } = self.run(args);
        let stderr = String::from_utf8_lossy(&stderr);
        assert!(status.success(), "{args:?}: {status}: {stderr}, log: {}", self.log());
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        drop(self.child.kill());
        drop(self.child.wait());
    }
}

/// Clients that never close their connections.
#[derive(Default)]
struct IdleClients {
    sockets: Vec<TcpStream>,
    channels: Vec<Channel>,
    watches: Vec<Streaming<()>>,
}

/// The behavior of a client on its connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Behavior {
    OneByte,
    PrefaceOnly,
    WatchHealth,
    RequestStatus,
}

impl Behavior {
    fn crowd(self, runtime: &Runtime, address: SocketAddr) -> IdleClients {
        let mut clients = IdleClients::default();
        match self {
            Self::OneByte => clients.send(address, b"P"),
            Self::PrefaceOnly => clients.send(address, &[PREFACE, &SETTINGS].concat()),
            Self::WatchHealth => runtime.block_on(clients.watch(address)),
            Self::RequestStatus => runtime.block_on(clients.request_status(address)),
        }
        clients
    }
}

impl IdleClients {
    fn send(&mut self, address: SocketAddr, bytes: &[u8]) {
        for _ in 0..N_CLIENTS {
            let mut socket = TcpStream::connect(address).expect("connects");
            socket.write_all(bytes).expect("sent");
            self.sockets.push(socket);
        }
    }

    /// Watches health, which needs no token. Late clients may be rejected.
    async fn watch(&mut self, address: SocketAddr) {
        let path = "/grpc.health.v1.Health/Watch".parse::<http::uri::PathAndQuery>();
        let path = path.expect("a path");
        for _ in 0..N_CLIENTS {
            let Some((channel, mut caller)) = connect(address).await else { continue };
            let codec = tonic_prost::ProstCodec::<(), ()>::default();
            let watch = caller.server_streaming(Request::new(()), path.clone(), codec);
            if let Ok(Ok(watch)) = tokio::time::timeout(DEADLINE, watch).await {
                self.watches.push(watch.into_inner());
            }
            self.channels.push(channel);
        }
    }

    /// Requests the status, which is authenticated if the service has no token.
    async fn request_status(&mut self, address: SocketAddr) {
        let path = "/tandem.v1.Bridge/Status".parse::<http::uri::PathAndQuery>();
        let path = path.expect("a path");
        for _ in 0..N_CLIENTS {
            let Some((channel, mut caller)) = connect(address).await else { continue };
            let codec = tonic_prost::ProstCodec::<(), ()>::default();
            let call = caller.unary(Request::new(()), path.clone(), codec);
            drop(tokio::time::timeout(DEADLINE, call).await);
            self.channels.push(channel);
        }
    }
}

async fn connect(address: SocketAddr) -> Option<(Channel, tonic::client::Grpc<Channel>)> {
    let endpoint = Endpoint::from_shared(format!("http://{address}")).expect("an address");
    let channel = endpoint.connect().await.ok()?;
    let mut caller = tonic::client::Grpc::new(channel.clone());
    caller.ready().await.ok()?;
    Some((channel, caller))
}

/// Fills a service with clients of each behavior in turn. Meanwhile `check` must succeed.
fn crowd(service: &Service, behaviors: &[Behavior], check: impl Fn(&Service)) {
    let mut runtime = tokio::runtime::Builder::new_multi_thread();
    let runtime = runtime.worker_threads(1).enable_all().build().expect("a runtime");
    let (since, idle_share) = (Instant::now(), service.cpu_share());
    for behavior in behaviors {
        let clients = behavior.crowd(&runtime, service.address);
        service.wait_until_full();
        check(service);
        let share = service.cpu_share();
        assert!(share < idle_share + 0.5, "{behavior:?}: {share:.2} cores, idle {idle_share:.2}");
        assert!(service.n_files() < MAX_FILES, "{behavior:?}: {} files", service.n_files());
        drop(clients);
    }
    let log = service.log();
    let n_lines = log.matches("too many connections").count() as u64;
    // One line a minute at most.
    assert!((1..=1 + since.elapsed().as_secs() / 60).contains(&n_lines), "{log}");
    assert!(!log.contains("cannot accept"), "{log}");
}

#[test]
fn the_arms_can_be_stopped_while_idle_clients_hold_all_connections_of_a_bridge() {
    let bridge = Service::start(&["bridge", "--driver", "sim"]);
    let address = bridge.address.to_string();
    let behaviors =
        [Behavior::OneByte, Behavior::PrefaceOnly, Behavior::WatchHealth, Behavior::RequestStatus];
    crowd(&bridge, &behaviors, |bridge| {
        bridge.succeed(&["bridge", "stop", "--connect", &address]);
        bridge.succeed(&["health", &address]);
    });
}

#[test]
fn the_arms_can_be_stopped_with_the_token_while_unauthenticated_clients_watch_health() {
    let bridge = Service::start(&["bridge", "--driver", "sim", "--token-file", "token"]);
    let address = bridge.address.to_string();
    let behaviors = [Behavior::WatchHealth, Behavior::RequestStatus, Behavior::OneByte];
    crowd(&bridge, &behaviors, |bridge| {
        bridge.succeed(&["bridge", "stop", "--connect", &address, "--token-file", "token"]);
        bridge.succeed(&["health", &address]);
    });
}

#[test]
fn a_teacher_is_healthy_while_idle_clients_hold_all_its_connections() {
    let policy = concat!(env!("CARGO_MANIFEST_DIR"), "/policies/teacher-push.safetensors");
    let teacher = Service::start(&["teacher", "--ledger", "memory", "--policy", policy]);
    let address = teacher.address.to_string();
    crowd(&teacher, &[Behavior::OneByte, Behavior::WatchHealth], |teacher| {
        teacher.succeed(&["health", &address]);
    });
}
