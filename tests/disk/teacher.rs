//! Teachers whose ledger is on the failing disk: their answers always match their charges.

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::LazyLock;
use std::time::Duration;

use tandem_proto::pb;
use tandem_proto::pb::teacher_client::TeacherClient;
use tokio::runtime::{Builder, Runtime};
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Response, Status};

use crate::device::{Device, EIO, ENOSPC, Fault, Mode};
use crate::run::{account, signal};

/// Part of the lines of disk calls on the ledger's files.
const LEDGER: &str = "ledger";
const ACCOUNT: &str = "shared";
const BUDGET: u64 = 30;
/// Episodes that have a lease.
const EPISODES: [u64; 4] = [1, 2, 3, 4];
const STEPS: u32 = 10;
const UNITS_PER_EPISODE: u32 = 10;
/// Far longer than any operation here takes on a busy machine.
const DEADLINE: Duration = Duration::from_secs(60);
/// Maximum number of attempts per request.
const TRIES: usize = 3;

/// The answers, the final account and the number of disk calls on the ledger of an undisturbed teacher.
static UNDISTURBED: LazyLock<(Vec<bool>, Vec<String>, usize)> = LazyLock::new(|| {
    let device = Device::new();
    let mut teacher = Teacher::start(&device, None).expect("starts");
    let Answers { charged, .. } = teacher.ask_everything();
    teacher.kill();
    let n_calls = device.calls().iter().filter(|call| call.contains(LEDGER)).count();
    (charged, account(&device.root().join("ledger.sqlite")), n_calls)
});

/// A teacher process that is killed on drop.
struct Teacher {
    process: Child,
    /// Runs the client's connection. `None` once the teacher is asked to end.
    runtime: Option<Runtime>,
    client: TeacherClient<Channel>,
}

/// A teacher's answers up to its first refusal.
#[derive(Default)]
struct Answers {
    /// True for each charged step, in the order of the requests.
    charged: Vec<bool>,
    /// Units charged by then.
    n_spent: usize,
    /// Units charged by the last answer that survives a power cut.
    n_durable: usize,
    refusal: Option<Status>,
}

impl Teacher {
    /// Starts a teacher. Returns `None` if it ends before it listens.
    fn start(device: &Device, fault: Option<&Fault>) -> Option<Self> {
        let policy =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/teacher-push.safetensors");
        let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
        command.args(["--log", "warn", "teacher", "--listen", "127.0.0.1:0", "--ledger"]);
        command.arg(device.root().join("ledger.sqlite")).arg("--policy").arg(policy);
        command.stdin(Stdio::null()).stdout(Stdio::piped());
        command.stderr(File::create(device.sibling("stderr")).expect("creates"));
        device.attach(&mut command, fault);
        let mut process = command.spawn().expect("starts");
        let mut line = String::new();
        let output = process.stdout.take().expect("piped");
        BufReader::new(output).read_line(&mut line).expect("readable");
        let Some(address) = line.trim().strip_prefix("listening on ") else {
            let code = process.wait().expect("a child").code();
            check_refusal(code, fault, &stderr(device));
            return None;
        };
        let endpoint = Endpoint::from_shared(format!("http://{address}")).expect("an address");
        let runtime = Builder::new_current_thread().enable_all().build().expect("a runtime");
        let client = {
            let _inside = runtime.enter();
            TeacherClient::new(endpoint.timeout(DEADLINE).connect_lazy())
        };
        Some(Self { process, runtime: Some(runtime), client })
    }

    /// Opens the account and its leases, asks about every step and settles. Stops at the first refusal.
    fn ask_everything(&mut self) -> Answers {
        let mut answers = Answers::default();
        if let Err(refusal) = self.try_everything(&mut answers) {
            answers.refusal = Some(refusal);
        }
        answers
    }

    fn try_everything(&mut self, answers: &mut Answers) -> Result<(), Status> {
        let (name, strategy) = (ACCOUNT.to_owned(), "ea".to_owned());
        let open = pb::OpenAccountRequest { name: name.clone(), budget: BUDGET, strategy };
        self.call(async |mut client| client.open_account(open.clone()).await)?;
        let (account, units_per_episode) = (name, UNITS_PER_EPISODE);
        let episodes = EPISODES.to_vec();
        let leases =
            pb::OpenLeasesRequest { account: account.clone(), episodes, units_per_episode };
        self.call(async |mut client| client.open_leases(leases.clone()).await)?;
        for episode in EPISODES {
            for step in 0..STEPS {
                let steps = vec![query(episode, step)];
                let ask =
                    pb::AdviseRequest { account: account.clone(), steps, ..Default::default() };
                let answer = self.call(async |mut client| client.advise(ask.clone()).await)?;
                let is_charged = answer.steps[0].charged;
                answers.charged.push(is_charged);
                answers.n_spent += usize::from(is_charged);
            }
            let settle =
                pb::SettleLeasesRequest { account: account.clone(), episodes: vec![episode] };
            self.call(async |mut client| client.settle_leases(settle.clone()).await)?;
            answers.n_durable = answers.n_spent;
        }
        Ok(())
    }

    /// Repeats a call until it succeeds, up to [`TRIES`] times.
    fn call<T>(
        &self,
        ask: impl AsyncFn(TeacherClient<Channel>) -> Result<Response<T>, Status>,
    ) -> Result<T, Status> {
        let attempt = || self.block_on(ask(self.client.clone()));
        let mut answer = attempt();
        for _ in 1..TRIES {
            if answer.is_ok() {
                break;
            }
            answer = attempt();
        }
        answer.map(Response::into_inner)
    }

    fn block_on<T>(&self, call: impl Future<Output = T>) -> T {
        self.runtime.as_ref().expect("the teacher was not asked to end").block_on(call)
    }

    /// Sends SIGTERM and waits for the end.
    fn end(&mut self) {
        drop(self.runtime.take());
        signal("-TERM", self.process.id());
        self.process.wait().expect("a child");
    }

    /// Kills the process with SIGKILL.
    fn kill(&mut self) {
        drop(self.process.kill());
        self.process.wait().expect("a child");
    }
}

impl Drop for Teacher {
    fn drop(&mut self) {
        self.kill();
    }
}

fn stderr(device: &Device) -> String {
    fs::read_to_string(device.sibling("stderr")).expect("readable")
}

fn query(episode: u64, step: u32) -> pb::StepQuery {
    let numbers = |n: u16| (0..n).map(|idx| f32::from(idx) / 100.0).collect();
    let (observation, goal, proposed_action) = (numbers(28), numbers(3), numbers(3));
    pb::StepQuery { episode, step, observation, goal, proposed_action, ..Default::default() }
}

/// Checks how a teacher that did not start ended.
fn check_refusal(code: Option<i32>, fault: Option<&Fault>, stderr: &str) {
    let is_killed = fault.is_some_and(|fault| matches!(fault.mode, Mode::Kill | Mode::Cut));
    if is_killed {
        assert_eq!(code, None, "{stderr}");
        return;
    }
    assert_eq!(code, Some(75), "{fault:?}: {stderr}");
    assert_eq!(stderr.lines().count(), 1, "{stderr}");
    assert!(
        stderr.contains("cannot open the ledger") && stderr.contains("ledger.sqlite"),
        "{stderr}"
    );
}

/// Asks a teacher on a disk with a fault, restarts it on a healthy disk and repeats every request.
fn check(fault: &Fault) {
    let device = Device::new();
    let mut answers = Answers::default();
    if let Some(mut teacher) = Teacher::start(&device, Some(fault)) {
        answers = teacher.ask_everything();
        teacher.end();
    }
    let what = format!("{fault}: {:?}: {}", answers.refusal, stderr(&device));
    assert!(device.is_triggered(), "the fault did not occur: {what}");
    assert_eq!(answers.charged, UNDISTURBED.0[..answers.charged.len()], "{what}");
    check_error_messages(fault, &answers, &stderr(&device), &what);
    let n_kept = if fault.mode == Mode::Cut { answers.n_durable } else { answers.n_spent };
    if fault.mode == Mode::Cut {
        device.lose_unsynced();
    }
    let mut teacher = Teacher::start(&device, None).expect("starts on a healthy disk");
    let n_spent = spent(&teacher);
    // One charge more than answers is allowed: the charge was written but its answer was not sent.
    assert!((n_kept..=answers.n_spent + 1).contains(&n_spent), "{n_spent} of {n_kept}: {what}");
    assert_eq!(teacher.ask_everything().charged, UNDISTURBED.0, "{what}");
    teacher.kill();
    assert_eq!(account(&device.root().join("ledger.sqlite")), UNDISTURBED.1, "{what}");
}

/// Checks that a teacher that refuses a request gives the reason to its caller and logs it once.
fn check_error_messages(fault: &Fault, answers: &Answers, stderr: &str, what: &str) {
    assert!(!stderr.contains("panicked"), "{what}");
    let is_killed = matches!(fault.mode, Mode::Kill | Mode::Cut);
    let Some(refusal) = answers.refusal.as_ref().filter(|_| !is_killed) else { return };
    assert_eq!(fault.mode, Mode::Dead, "the request is retried: {what}");
    let names = |text: &str| {
        let causes = ["disk I/O error", "database or disk is full"];
        text.contains("ledger.sqlite") && causes.iter().any(|cause| text.contains(cause))
    };
    assert_eq!(refusal.code(), Code::Unavailable, "{what}");
    assert!(names(refusal.message()), "{what}");
    let lines = stderr.lines().filter(|line| line.contains("nothing can be charged"));
    let lines: Vec<&str> = lines.collect();
    assert!(lines.len() == 1 && names(lines[0]), "{what}");
}

/// Returns the units spent by the account, or 0 if it is not open.
fn spent(teacher: &Teacher) -> usize {
    let request = pb::GetAccountRequest { name: ACCOUNT.to_owned() };
    let found = async {
        let mut client = teacher.client.clone();
        client.get_account(request).await
    };
    match teacher.block_on(found) {
        Ok(account) => usize::try_from(account.into_inner().spent).expect("few"),
        Err(status) => {
            assert_eq!(status.code(), Code::NotFound, "{status}");
            0
        }
    }
}

/// Returns faults at `n_hits` evenly spaced calls on the ledger.
fn faults(mode: Mode, errno: i32, n_hits: usize) -> Vec<Fault> {
    let n_calls = UNDISTURBED.2;
    let at = |hit: usize| hit * n_calls / n_hits + 1;
    (0..n_hits).map(|hit| Fault { errno, ..Fault::new(mode, at(hit), LEDGER) }).collect()
}

#[test]
fn a_teachers_answers_match_its_charges_under_disk_faults() {
    for mode in [Mode::Once, Mode::Dead, Mode::Kill, Mode::Cut] {
        faults(mode, EIO, 12).iter().for_each(check);
    }
}

#[test]
fn a_teachers_answers_match_its_charges_on_a_full_disk() {
    for mode in [Mode::Once, Mode::Dead] {
        faults(mode, ENOSPC, 4).iter().for_each(check);
    }
}

/// Faults at every disk call of a teacher on its ledger, in every mode:
///
/// ```text
/// cargo test --release --test disk -- --ignored every_call_of_a_teacher_may_fail
/// ```
#[test]
#[ignore = "takes minutes"]
fn every_call_of_a_teacher_may_fail() {
    for (mode, errno) in [
        (Mode::Once, EIO),
        (Mode::Dead, EIO),
        (Mode::Kill, EIO),
        (Mode::Cut, EIO),
        (Mode::Once, ENOSPC),
        (Mode::Dead, ENOSPC),
    ] {
        faults(mode, errno, UNDISTURBED.2).iter().for_each(check);
        println!("survived: {} calls, {mode:?}, error {errno}", UNDISTURBED.2);
    }
}
