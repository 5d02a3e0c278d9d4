//! The advice budget under faults: teachers that are killed while many clients ask, ledger files that are deleted, and
//! second teachers on the same ledger.

use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

use tandem_proto::pb;
use tandem_proto::pb::teacher_client::TeacherClient;
use tempfile::TempDir;
use tokio::runtime::{Builder, Runtime};
use tokio::task::JoinSet;
use tonic::Code;
use tonic::transport::{Channel, Endpoint};

#[path = "services/skipped.rs"]
mod skipped;

use skipped::skip;

const N_CLIENTS: u64 = 64;
const ACCOUNT: &str = "shared";
/// Steps of the client's own episode in a request. Each request also repeats one step of another client.
const OWN_STEPS: u32 = 4;
/// Far longer than any operation here takes on a busy machine.
const DEADLINE: Duration = Duration::from_secs(120);

/// A teacher process that is killed on drop.
struct Teacher {
    process: Child,
    address: String,
}

impl Teacher {
    fn start(ledger: &str, listen: &str) -> Self {
        let mut process = Self::spawn(ledger, listen);
        let mut line = String::new();
        let output = process.stdout.take().expect("piped");
        BufReader::new(output).read_line(&mut line).expect("a line");
        let address = line.trim().strip_prefix("listening on ").expect("an address").to_owned();
        Self { process, address }
    }

    fn spawn(ledger: &str, listen: &str) -> Child {
        let policy =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/teacher-push.safetensors");
        Command::new(env!("CARGO_BIN_EXE_tandem"))
            .args(["--log", "warn", "teacher", "--listen", listen, "--ledger", ledger, "--policy"])
            .arg(policy)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .expect("starts")
    }

    /// Kills the process with SIGKILL.
    fn kill(&mut self) {
        assert!(self.process.try_wait().expect("a child").is_none(), "the teacher ended early");
        self.process.kill().expect("killed");
        self.process.wait().expect("gone");
    }
}

/// Returns the exit code and the single error line of a teacher that refuses to start on `ledger`.
fn refusal(ledger: &Path) -> (Option<i32>, String) {
    let policy = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/teacher-push.safetensors");
    let output = Command::new(env!("CARGO_BIN_EXE_tandem"))
        .args(["--log", "warn", "teacher", "--listen", "127.0.0.1:0", "--exit-with-stdin"])
        .arg("--ledger")
        .arg(ledger)
        .arg("--policy")
        .arg(policy)
        .stdin(Stdio::null())
        .output()
        .expect("ran");
    let stderr = String::from_utf8(output.stderr).expect("UTF-8");
    assert_eq!(stderr.matches('\n').count(), 1, "{stderr:?}");
    assert!(!stderr.trim_end().contains(char::is_control), "{stderr:?}");
    (output.status.code(), stderr)
}

impl Drop for Teacher {
    fn drop(&mut self) {
        drop(self.process.kill());
        drop(self.process.wait());
    }
}

/// The answers that all clients received.
#[derive(Default)]
struct Answers {
    verdicts: Mutex<Verdicts>,
    changed: Condvar,
    /// Number of charges after which clients pause, so that they do not outrun the kills. 0 means no limit.
    hold_at: AtomicUsize,
}

#[derive(Default)]
struct Verdicts {
    /// True for charged steps, by episode and step.
    by_step: BTreeMap<(u64, u32), bool>,
    n_charged: usize,
}

impl Answers {
    /// Records the answer to a request, which must agree with every earlier answer about the same steps.
    fn record(&self, request: &pb::AdviseRequest, answer: &pb::AdviseResponse) {
        assert_eq!(answer.steps.len(), request.steps.len());
        let mut verdicts = self.verdicts.lock().expect("whole");
        for (query, advice) in request.steps.iter().zip(&answer.steps) {
            let key = (query.episode, query.step);
            let known = verdicts.by_step.insert(key, advice.charged);
            assert!(known.is_none_or(|known| known == advice.charged), "{key:?} was {known:?}");
            verdicts.n_charged += usize::from(known.is_none() && advice.charged);
        }
        self.changed.notify_all();
    }

    /// Returns a pseudorandom step that has been answered, or the very first step.
    fn known_step(&self, number: u64) -> (u64, u32) {
        let verdicts = self.verdicts.lock().expect("whole");
        let mixed = number.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40;
        let from = (mixed % N_CLIENTS, u32::try_from(mixed / N_CLIENTS % 150).expect("few"));
        verdicts.by_step.range(from..).next().map_or((0, 0), |(step, _)| *step)
    }

    /// Waits until the number of charges is below the limit.
    async fn wait_until_released(&self) {
        let is_held = || {
            let hold_at = self.hold_at.load(Ordering::Relaxed);
            hold_at > 0 && self.verdicts.lock().expect("whole").n_charged >= hold_at
        };
        while is_held() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    }

    fn wait_for(&self, n_charged: usize) {
        let verdicts = self.verdicts.lock().expect("whole");
        let waited = self
            .changed
            .wait_timeout_while(verdicts, DEADLINE, |verdicts| verdicts.n_charged < n_charged);
        let (verdicts, _) = waited.expect("whole");
        assert!(verdicts.n_charged >= n_charged, "only {} charges so far", verdicts.n_charged);
    }
}

/// A client that asks one of several teachers and fails over to the next when that one is unavailable.
struct Client {
    teachers: Vec<TeacherClient<Channel>>,
    current: usize,
}

impl Client {
    fn of(addresses: &[String], number: u64) -> Self {
        let current = usize::try_from(number).expect("few") % addresses.len();
        Self { teachers: addresses.iter().map(|address| client_of(address)).collect(), current }
    }

    async fn advise(&mut self, request: &pb::AdviseRequest) -> pb::AdviseResponse {
        loop {
            match self.teachers[self.current].advise(request.clone()).await {
                Ok(answer) => return answer.into_inner(),
                Err(status) => {
                    let is_refusal = matches!(
                        status.code(),
                        Code::InvalidArgument
                            | Code::NotFound
                            | Code::AlreadyExists
                            | Code::OutOfRange
                    );
                    assert!(!is_refusal, "{status}");
                    self.current = (self.current + 1) % self.teachers.len();
                    tokio::time::sleep(Duration::from_millis(5)).await;
                }
            }
        }
    }
}

fn query(episode: u64, step: u32) -> pb::StepQuery {
    let numbers = |n: u16| (0..n).map(|idx| f32::from(idx) / 100.0).collect();
    let (observation, goal, proposed_action) = (numbers(28), numbers(3), numbers(3));
    pb::StepQuery { episode, step, observation, goal, proposed_action, ..Default::default() }
}

/// Asks about new steps of the client's own episode until the budget is spent, then repeats every request.
async fn play(mut client: Client, number: u64, answers: Arc<Answers>) {
    let mut requests = Vec::new();
    for first in (0..).step_by(usize::try_from(OWN_STEPS).expect("few")) {
        answers.wait_until_released().await;
        let others = answers.known_step(number + u64::from(first));
        let own = (first..first + OWN_STEPS).map(|step| query(number, step));
        let steps = own.chain([query(others.0, others.1)]).collect();
        let request =
            pb::AdviseRequest { account: ACCOUNT.to_owned(), steps, ..Default::default() };
        let answer = client.advise(&request).await;
        answers.record(&request, &answer);
        requests.push(request);
        if answer.budget_left == 0 {
            break;
        }
    }
    for request in &requests {
        let answer = client.advise(request).await;
        answers.record(request, &answer);
    }
}

fn runtime() -> Runtime {
    Builder::new_multi_thread().worker_threads(2).enable_all().build().expect("a runtime")
}

/// Returns a client that connects on its first call. Connecting here would compile the client again for this file.
fn client_of(address: &str) -> TeacherClient<Channel> {
    let endpoint = Endpoint::from_shared(format!("http://{address}")).expect("an address");
    TeacherClient::new(endpoint.timeout(DEADLINE).connect_lazy())
}

fn open_account(runtime: &Runtime, address: &str, budget: u64) {
    let request =
        pb::OpenAccountRequest { name: ACCOUNT.to_owned(), budget, strategy: "ea".to_owned() };
    let opened = runtime.block_on(async { client_of(address).open_account(request).await });
    assert_eq!(opened.expect("opened").into_inner().left, budget);
}

fn start_clients(runtime: &Runtime, addresses: &[String], answers: &Arc<Answers>) -> JoinSet<()> {
    let mut clients = JoinSet::new();
    for number in 0..N_CLIENTS {
        let (addresses, answers) = (addresses.to_vec(), Arc::clone(answers));
        let play = async move { play(Client::of(&addresses, number), number, answers).await };
        clients.spawn_on(play, runtime.handle());
    }
    clients
}

/// Waits for the clients, then compares the charges that they counted with the account.
fn check_sums(
    runtime: &Runtime,
    clients: JoinSet<()>,
    address: &str,
    answers: &Answers,
    budget: u64,
) {
    let done = async { tokio::time::timeout(DEADLINE, clients.join_all()).await };
    runtime.block_on(done).expect("all clients are done");
    let request = pb::GetAccountRequest { name: ACCOUNT.to_owned() };
    let account = runtime.block_on(async { client_of(address).get_account(request).await });
    let account = account.expect("an account").into_inner();
    let answers = answers.verdicts.lock().expect("whole");
    assert_eq!(account.spent, budget);
    assert_eq!((account.leased, account.left), (0, 0));
    assert_eq!(
        u64::try_from(answers.n_charged).expect("few"),
        budget,
        "of {}",
        answers.by_step.len()
    );
}

#[test]
fn ten_thousand_units_are_charged_once_while_the_teacher_is_killed_fifty_times() {
    const N_KILLS: usize = 50;
    const BUDGET: u64 = 10_000;
    let directory = tempfile::tempdir().expect("a directory");
    let ledger = directory.path().join("ledger.sqlite");
    let ledger = ledger.to_str().expect("UTF-8");
    let mut teacher = Teacher::start(ledger, "127.0.0.1:0");
    let address = teacher.address.clone();
    let (runtime, answers) = (runtime(), Arc::new(Answers::default()));
    open_account(&runtime, &address, BUDGET);
    answers.hold_at.store(250, Ordering::Relaxed);
    let clients = start_clients(&runtime, std::slice::from_ref(&address), &answers);
    for kill in 1..=N_KILLS {
        answers.hold_at.store(kill * 190 + 60, Ordering::Relaxed);
        answers.wait_for(kill * 190);
        teacher.kill();
        if kill.is_multiple_of(10) {
            // Another teacher, killed before, while or after it opens the ledger.
            let mut short_lived = Teacher::spawn(ledger, &address);
            std::thread::sleep(Duration::from_millis(u64::try_from(kill).expect("few")));
            short_lived.kill().expect("killed");
            short_lived.wait().expect("gone");
        }
        teacher = Teacher::start(ledger, &address);
    }
    let n_charged = answers.verdicts.lock().expect("whole").n_charged;
    assert!(n_charged < 10_000, "the budget was spent before the last kill");
    answers.hold_at.store(0, Ordering::Relaxed);
    check_sums(&runtime, clients, &address, &answers, BUDGET);
    teacher.kill();
    let teacher = Teacher::start(ledger, &address);
    check_sums(&runtime, JoinSet::new(), &teacher.address, &answers, BUDGET);
}

/// Asks once about `steps` of episode 1 and returns which ones were charged.
fn ask_once(
    runtime: &Runtime,
    address: &str,
    steps: std::ops::Range<u32>,
) -> Result<Vec<bool>, tonic::Status> {
    let steps = steps.map(|step| query(1, step)).collect();
    let request = pb::AdviseRequest { account: ACCOUNT.to_owned(), steps, ..Default::default() };
    let answer = runtime.block_on(async { client_of(address).advise(request).await })?;
    Ok(answer.into_inner().steps.iter().map(|step| step.charged).collect())
}

#[test]
fn a_second_teacher_on_the_same_ledger_file_is_refused() {
    let directory = tempfile::tempdir().expect("a directory");
    let sibling = |name: &str| directory.path().join(name);
    let ledger = sibling("ledger.sqlite");
    let ledger = ledger.to_str().expect("UTF-8");
    let mut teacher = Teacher::start(ledger, "127.0.0.1:0");
    let runtime = runtime();
    open_account(&runtime, &teacher.address, 10);
    assert_eq!(ask_once(&runtime, &teacher.address, 0..6).expect("charged"), [true; 6]);

    let (link, twin) = (sibling("link.sqlite"), sibling("twin.sqlite"));
    std::os::unix::fs::symlink(ledger, &link).expect("a link");
    std::fs::hard_link(ledger, &twin).expect("a link");
    let check_in_use = |path: &Path| {
        let (code, stderr) = refusal(path);
        assert!(stderr.contains("another teacher uses the ledger"), "{stderr}");
        assert_eq!(code, Some(75), "{stderr}");
    };
    for deleted in ["ledger.sqlite.lock", "ledger.sqlite-shm", "ledger.sqlite-wal"] {
        drop(std::fs::remove_file(sibling(deleted)));
        for path in [Path::new(ledger), &link, &twin] {
            check_in_use(path);
        }
    }

    // The write-ahead log was deleted: the teacher keeps its contents and charges nothing that could be lost.
    let refused = ask_once(&runtime, &teacher.address, 6..8).expect_err("refused");
    assert_eq!(refused.code(), Code::Unavailable, "{refused}");
    assert!(refused.message().contains("-wal file was deleted"), "{refused}");
    assert_eq!(ask_once(&runtime, &teacher.address, 0..6).expect("known"), [true; 6]);
    teacher.kill();
    for path in [Path::new(ledger), &twin] {
        let (code, stderr) = refusal(path);
        assert!(stderr.contains("the file has 2 names (hard links)"), "{stderr}");
        assert_eq!(code, Some(64), "{stderr}");
    }
    std::fs::remove_file(twin).expect("removed");
    let teacher = Teacher::start(link.to_str().expect("UTF-8"), "127.0.0.1:0");
    let charged = ask_once(&runtime, &teacher.address, 0..20).expect("charged");
    assert_eq!(charged, [[true; 10], [false; 10]].concat());
}

#[test]
fn a_teacher_charges_nothing_to_a_deleted_ledger() {
    let directory = tempfile::tempdir().expect("a directory");
    let ledger = directory.path().join("ledger.sqlite");
    let teacher = Teacher::start(ledger.to_str().expect("UTF-8"), "127.0.0.1:0");
    let runtime = runtime();
    open_account(&runtime, &teacher.address, 10);
    assert_eq!(ask_once(&runtime, &teacher.address, 0..6).expect("charged"), [true; 6]);
    for suffix in ["", "-wal", "-shm"] {
        let name = format!("ledger.sqlite{suffix}");
        std::fs::remove_file(directory.path().join(name)).expect("removed");
    }
    let second = Teacher::start(ledger.to_str().expect("UTF-8"), "127.0.0.1:0");
    open_account(&runtime, &second.address, 10);
    for _ in 0..2 {
        let refused = ask_once(&runtime, &teacher.address, 6..8).expect_err("refused");
        assert_eq!(refused.code(), Code::Unavailable, "{refused}");
        let cause = "the file was deleted, moved or replaced while in use";
        assert!(refused.message().contains(cause), "{refused}");
    }
    let charged = ask_once(&runtime, &second.address, 0..20).expect("charged");
    assert_eq!(charged, [[true; 10], [false; 10]].concat());
}

#[test]
fn a_ledger_that_cannot_be_opened_is_refused_with_the_right_exit_code() {
    let directory = tempfile::tempdir().expect("a directory");
    let check = |path: &Path, expected_code: i32, expected: &str| {
        let (code, stderr) = refusal(path);
        assert!(stderr.contains(expected), "{stderr}");
        assert_eq!(code, Some(expected_code), "{stderr}");
    };
    check(directory.path(), 64, "it is a directory");
    check(Path::new("/dev/null"), 64, "it is not a regular file");
    check(&directory.path().join("none/ledger.sqlite"), 64, "there is no directory");
    let text = directory.path().join("text");
    std::fs::write(&text, "a shopping list").expect("written");
    check(&text, 65, "is no ledger");
    let damaged = directory.path().join("damaged.sqlite");
    drop(Teacher::start(damaged.to_str().expect("UTF-8"), "127.0.0.1:0"));
    let sql = "INSERT INTO accounts VALUES (1, char(27) || '[31m' || char(10), 10, 'ea', 0, 0)";
    let other = rusqlite::Connection::open(&damaged).expect("a database");
    other.execute_batch(sql).expect(sql);
    drop(other);
    check(&damaged, 65, "its rows do not match its checksum");
}

#[test]
fn two_teachers_share_a_budget_on_one_redis_and_one_of_them_is_killed() {
    const BUDGET: u64 = 3_000;
    let Some(redis) = Redis::start() else { return };
    let ledger = format!("redis://127.0.0.1:{}/0", redis.port);
    let mut teachers = [(); 2].map(|()| Teacher::start(&ledger, "127.0.0.1:0"));
    let addresses = [teachers[0].address.clone(), teachers[1].address.clone()];
    let (runtime, answers) = (runtime(), Arc::new(Answers::default()));
    open_account(&runtime, &addresses[0], BUDGET);
    open_account(&runtime, &addresses[1], BUDGET);
    // Requests in flight add at most 256 units: some remain to be charged after the kill.
    answers.hold_at.store(1_400, Ordering::Relaxed);
    let clients = start_clients(&runtime, &addresses, &answers);
    answers.wait_for(1_000);
    teachers[0].kill();
    let n_charged = answers.verdicts.lock().expect("whole").n_charged as u64;
    assert!(n_charged < BUDGET, "the budget was spent before the kill");
    answers.hold_at.store(0, Ordering::Relaxed);
    check_sums(&runtime, clients, &addresses[1], &answers, BUDGET);
}

/// A Redis server owned by the test.
struct Redis {
    process: Child,
    port: u16,
    _directory: TempDir,
}

impl Redis {
    /// Starts a server. Reports that and returns `None` if Redis is not installed.
    fn start() -> Option<Self> {
        if Command::new("redis-server").arg("--version").stdout(Stdio::null()).status().is_err() {
            skip("REDIS", "teachers that share a budget: redis-server is not installed");
            return None;
        }
        // Another process may take the free port before the server binds it.
        let started = (0..10).find_map(|_| Self::start_once());
        Some(started.expect("redis-server starts"))
    }

    fn start_once() -> Option<Self> {
        let directory = tempfile::tempdir().expect("a directory");
        let port = TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr());
        let port = port.expect("a port").port();
        let process = Command::new("redis-server")
            .args(["--port", &port.to_string(), "--bind", "127.0.0.1", "--save", ""])
            .args(["--appendonly", "yes", "--dir"])
            .arg(directory.path())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .spawn()
            .expect("starts");
        let mut server = Self { process, port, _directory: directory };
        for _ in 0..6000 {
            if server.responds().is_ok_and(|responds| responds) {
                return Some(server);
            }
            if server.process.try_wait().expect("a child").is_some() {
                return None;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        None
    }

    fn responds(&self) -> std::io::Result<bool> {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port))?;
        stream.set_read_timeout(Some(Duration::from_secs(1)))?;
        stream.write_all(b"PING\r\n")?;
        let mut answer = [0; 5];
        stream.read_exact(&mut answer)?;
        Ok(answer == *b"+PONG")
    }
}

impl Drop for Redis {
    fn drop(&mut self) {
        drop(self.process.kill());
        drop(self.process.wait());
    }
}
