//! The program's budget under fire: teachers that are killed while many clients ask, ledgers that are taken away, and
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

const N_CLIENTS: u64 = 64;
const ACCOUNT: &str = "shared";
/// Steps of a client's own in a request; one of somebody else's comes with them.
const OWN_STEPS: u32 = 4;
/// Far longer than anything here takes on a busy machine.
const DEADLINE: Duration = Duration::from_secs(120);

/// A teacher with a process of its own; killed at the latest with the test.
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

    /// Ends it as `kill -9` does.
    fn kill(&mut self) {
        assert!(self.process.try_wait().expect("a child").is_none(), "it still ran");
        self.process.kill().expect("killed");
        self.process.wait().expect("gone");
    }
}

/// The exit code and the one line of a teacher that does not start on `ledger`.
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
    let told = String::from_utf8(output.stderr).expect("UTF-8");
    assert_eq!(told.matches('\n').count(), 1, "{told:?}");
    assert!(!told.trim_end().contains(char::is_control), "{told:?}");
    (output.status.code(), told)
}

impl Drop for Teacher {
    fn drop(&mut self) {
        drop(self.process.kill());
        drop(self.process.wait());
    }
}

/// What all clients together were told.
#[derive(Default)]
struct Told {
    verdicts: Mutex<Verdicts>,
    news: Condvar,
    /// Charges after which clients ask nothing new for now, so that none outruns whoever kills; 0 for no such limit.
    hold_at: AtomicUsize,
}

#[derive(Default)]
struct Verdicts {
    /// Whether a step was charged, by episode and step.
    by_step: BTreeMap<(u64, u32), bool>,
    n_charged: usize,
}

impl Told {
    /// Notes the answer to a request, which must repeat what was said of its steps before.
    fn hear(&self, request: &pb::AdviseRequest, answer: &pb::AdviseResponse) {
        assert_eq!(answer.steps.len(), request.steps.len());
        let mut told = self.verdicts.lock().expect("whole");
        for (query, advice) in request.steps.iter().zip(&answer.steps) {
            let key = (query.episode, query.step);
            let known = told.by_step.insert(key, advice.charged);
            assert!(known.is_none_or(|known| known == advice.charged), "{key:?} was {known:?}");
            told.n_charged += usize::from(known.is_none() && advice.charged);
        }
        self.news.notify_all();
    }

    /// Some step that somebody was answered about, or will be.
    fn anybodys_step(&self, number: u64) -> (u64, u32) {
        let told = self.verdicts.lock().expect("whole");
        let mixed = number.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40;
        let from = (mixed % N_CLIENTS, u32::try_from(mixed / N_CLIENTS % 150).expect("few"));
        told.by_step.range(from..).next().map_or((0, 0), |(step, _)| *step)
    }

    /// Waits while the clients are to hold.
    async fn may_go_on(&self) {
        let is_held = || {
            let hold_at = self.hold_at.load(Ordering::Relaxed);
            hold_at > 0 && self.verdicts.lock().expect("whole").n_charged >= hold_at
        };
        while is_held() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    }

    fn wait_for(&self, n_charged: usize) {
        let told = self.verdicts.lock().expect("whole");
        let waited =
            self.news.wait_timeout_while(told, DEADLINE, |told| told.n_charged < n_charged);
        let (told, _) = waited.expect("whole");
        assert!(told.n_charged >= n_charged, "only {} charges until now", told.n_charged);
    }
}

/// A client with a connection to each of some teachers, of which it asks one and, when that is away, the next.
struct Client {
    teachers: Vec<TeacherClient<Channel>>,
    asked: usize,
}

impl Client {
    fn of(addresses: &[String], number: u64) -> Self {
        let asked = usize::try_from(number).expect("few") % addresses.len();
        Self { teachers: addresses.iter().map(|address| client_of(address)).collect(), asked }
    }

    async fn advise(&mut self, request: &pb::AdviseRequest) -> pb::AdviseResponse {
        loop {
            match self.teachers[self.asked].advise(request.clone()).await {
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
                    self.asked = (self.asked + 1) % self.teachers.len();
                    tokio::time::sleep(Duration::from_millis(5)).await;
                }
            }
        }
    }
}

fn query(episode: u64, step: u32) -> pb::StepQuery {
    let numbers = |n: u16| (0..n).map(|idx| f32::from(idx) / 100.0).collect();
    let (observation, goal, proposed_action) = (numbers(28), numbers(3), numbers(3));
    pb::StepQuery { episode, step, observation, goal, proposed_action }
}

/// Asks about steps of its own episode until the budget is spent, then about all of them again.
async fn play(mut client: Client, number: u64, told: Arc<Told>) {
    let mut requests = Vec::new();
    for first in (0..).step_by(usize::try_from(OWN_STEPS).expect("few")) {
        told.may_go_on().await;
        let others = told.anybodys_step(number + u64::from(first));
        let own = (first..first + OWN_STEPS).map(|step| query(number, step));
        let steps = own.chain([query(others.0, others.1)]).collect();
        let request = pb::AdviseRequest { account: ACCOUNT.to_owned(), steps };
        let answer = client.advise(&request).await;
        told.hear(&request, &answer);
        requests.push(request);
        if answer.budget_left == 0 {
            break;
        }
    }
    for request in &requests {
        let answer = client.advise(request).await;
        told.hear(request, &answer);
    }
}

fn runtime() -> Runtime {
    Builder::new_multi_thread().worker_threads(2).enable_all().build().expect("a runtime")
}

/// Connects at the first call. To connect here would compile the client again, for this file.
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

fn start_clients(runtime: &Runtime, addresses: &[String], told: &Arc<Told>) -> JoinSet<()> {
    let mut clients = JoinSet::new();
    for number in 0..N_CLIENTS {
        let (addresses, told) = (addresses.to_vec(), Arc::clone(told));
        let play = async move { play(Client::of(&addresses, number), number, told).await };
        clients.spawn_on(play, runtime.handle());
    }
    clients
}

/// Waits for the clients and compares the sums: what they were told was charged, and what the account says.
fn check_sums(runtime: &Runtime, clients: JoinSet<()>, address: &str, told: &Told, budget: u64) {
    let done = async { tokio::time::timeout(DEADLINE, clients.join_all()).await };
    runtime.block_on(done).expect("all clients are done");
    let request = pb::GetAccountRequest { name: ACCOUNT.to_owned() };
    let account = runtime.block_on(async { client_of(address).get_account(request).await });
    let account = account.expect("an account").into_inner();
    let told = told.verdicts.lock().expect("whole");
    assert_eq!(account.spent, budget);
    assert_eq!((account.leased, account.left), (0, 0));
    assert_eq!(u64::try_from(told.n_charged).expect("few"), budget, "of {}", told.by_step.len());
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
    let (runtime, told) = (runtime(), Arc::new(Told::default()));
    open_account(&runtime, &address, BUDGET);
    told.hold_at.store(250, Ordering::Relaxed);
    let clients = start_clients(&runtime, std::slice::from_ref(&address), &told);
    for kill in 1..=N_KILLS {
        told.hold_at.store(kill * 190 + 60, Ordering::Relaxed);
        told.wait_for(kill * 190);
        teacher.kill();
        if kill.is_multiple_of(10) {
            // One more, which dies as it begins, before, while or after it opens the ledger.
            let mut unborn = Teacher::spawn(ledger, &address);
            std::thread::sleep(Duration::from_millis(u64::try_from(kill).expect("few")));
            unborn.kill().expect("killed");
            unborn.wait().expect("gone");
        }
        teacher = Teacher::start(ledger, &address);
    }
    let n_charged = told.verdicts.lock().expect("whole").n_charged;
    assert!(n_charged < 10_000, "the budget was spent before the last kill");
    told.hold_at.store(0, Ordering::Relaxed);
    check_sums(&runtime, clients, &address, &told, BUDGET);
    teacher.kill();
    let teacher = Teacher::start(ledger, &address);
    check_sums(&runtime, JoinSet::new(), &teacher.address, &told, BUDGET);
}

/// Asks once about `steps` of episode 1; gives which were charged.
fn ask_once(
    runtime: &Runtime,
    address: &str,
    steps: std::ops::Range<u32>,
) -> Result<Vec<bool>, tonic::Status> {
    let steps = steps.map(|step| query(1, step)).collect();
    let request = pb::AdviseRequest { account: ACCOUNT.to_owned(), steps };
    let answer = runtime.block_on(async { client_of(address).advise(request).await })?;
    Ok(answer.into_inner().steps.iter().map(|step| step.charged).collect())
}

#[test]
fn a_second_teacher_on_the_same_ledger_file_is_refused() {
    let directory = tempfile::tempdir().expect("a directory");
    let beside = |name: &str| directory.path().join(name);
    let ledger = beside("ledger.sqlite");
    let ledger = ledger.to_str().expect("UTF-8");
    let mut teacher = Teacher::start(ledger, "127.0.0.1:0");
    let runtime = runtime();
    open_account(&runtime, &teacher.address, 10);
    assert_eq!(ask_once(&runtime, &teacher.address, 0..6).expect("charged"), [true; 6]);

    let (link, twin) = (beside("link.sqlite"), beside("twin.sqlite"));
    std::os::unix::fs::symlink(ledger, &link).expect("a link");
    std::fs::hard_link(ledger, &twin).expect("a link");
    let is_in_use = |path: &Path| {
        let (code, told) = refusal(path);
        assert!(told.contains("another teacher uses the ledger"), "{told}");
        assert_eq!(code, Some(75), "{told}");
    };
    for deleted in ["ledger.sqlite.lock", "ledger.sqlite-shm", "ledger.sqlite-wal"] {
        drop(std::fs::remove_file(beside(deleted)));
        for path in [Path::new(ledger), &link, &twin] {
            is_in_use(path);
        }
    }

    // The log is gone: what it had is rescued, and nothing is charged that might be lost.
    let refused = ask_once(&runtime, &teacher.address, 6..8).expect_err("refused");
    assert_eq!(refused.code(), Code::Unavailable, "{refused}");
    assert!(refused.message().contains("-wal file was deleted"), "{refused}");
    assert_eq!(ask_once(&runtime, &teacher.address, 0..6).expect("known"), [true; 6]);
    teacher.kill();
    for path in [Path::new(ledger), &twin] {
        let (code, told) = refusal(path);
        assert!(told.contains("the file has 2 names (hard links)"), "{told}");
        assert_eq!(code, Some(64), "{told}");
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
        let told = "the file was deleted, moved or replaced while in use";
        assert!(refused.message().contains(told), "{refused}");
    }
    let charged = ask_once(&runtime, &second.address, 0..20).expect("charged");
    assert_eq!(charged, [[true; 10], [false; 10]].concat());
}

#[test]
fn a_ledger_that_cannot_be_opened_is_refused_with_the_right_exit_code() {
    let directory = tempfile::tempdir().expect("a directory");
    let check = |path: &Path, expected_code: i32, expected: &str| {
        let (code, told) = refusal(path);
        assert!(told.contains(expected), "{told}");
        assert_eq!(code, Some(expected_code), "{told}");
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
    let Some(redis) = Redis::start() else {
        println!("SKIPPED: redis-server is not installed");
        return;
    };
    let ledger = format!("redis://127.0.0.1:{}/0", redis.port);
    let mut teachers = [(); 2].map(|()| Teacher::start(&ledger, "127.0.0.1:0"));
    let addresses = [teachers[0].address.clone(), teachers[1].address.clone()];
    let (runtime, told) = (runtime(), Arc::new(Told::default()));
    open_account(&runtime, &addresses[0], BUDGET);
    open_account(&runtime, &addresses[1], BUDGET);
    let clients = start_clients(&runtime, &addresses, &told);
    told.wait_for(1_000);
    teachers[0].kill();
    check_sums(&runtime, clients, &addresses[1], &told, BUDGET);
}

/// A Redis server of the test's own.
struct Redis {
    process: Child,
    port: u16,
    _directory: TempDir,
}

impl Redis {
    /// None where Redis is not installed; there the test fails if `TANDEM_REQUIRE_REDIS` is 1.
    fn start() -> Option<Self> {
        if Command::new("redis-server").arg("--version").stdout(Stdio::null()).status().is_err() {
            #[expect(clippy::disallowed_methods, reason = "the one switch of the tests")]
            let required = std::env::var("TANDEM_REQUIRE_REDIS").is_ok_and(|value| value == "1");
            assert!(!required, "redis-server is not installed, but TANDEM_REQUIRE_REDIS=1");
            return None;
        }
        // Between looking for a free port and taking it, somebody else may take it.
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
            if server.answers().is_ok_and(|answers| answers) {
                return Some(server);
            }
            if server.process.try_wait().expect("a child").is_some() {
                return None;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        None
    }

    fn answers(&self) -> std::io::Result<bool> {
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
