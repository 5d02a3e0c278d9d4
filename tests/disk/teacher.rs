//! Teachers whose ledger is on the disk: what they answered is what they have charged.

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

const ACCOUNT: &str = "shared";
const BUDGET: u64 = 30;
/// Episodes that have a lease.
const EPISODES: [u64; 4] = [1, 2, 3, 4];
const STEPS: u32 = 10;
const UNITS_PER_EPISODE: u32 = 10;
/// Far longer than anything here takes on a busy machine.
const DEADLINE: Duration = Duration::from_secs(60);
/// How often a refused request is made again.
const TRIES: usize = 3;

/// An undisturbed teacher: what it answered, its account at the end, and the number of its calls to the disk.
static CALM: LazyLock<(Vec<bool>, Vec<String>, usize)> = LazyLock::new(|| {
    let device = Device::new();
    let mut teacher = Teacher::start(&device, None).expect("starts");
    let Told { charged, .. } = teacher.ask_everything();
    teacher.kill();
    let n_calls = device.calls().len();
    (charged, account(&device.root().join("ledger.sqlite")), n_calls)
});

/// A teacher with a process of its own; killed at the latest with the test.
struct Teacher {
    process: Child,
    /// Has the client's connection; gone once the teacher is asked to end.
    runtime: Option<Runtime>,
    client: TeacherClient<Channel>,
}

/// What a teacher answered before it could not any more.
#[derive(Default)]
struct Told {
    /// Whether a step was charged, in the order of the questions.
    charged: Vec<bool>,
    /// Units charged by then.
    n_spent: usize,
    /// Units charged by the last answer that survives a power cut.
    n_durable: usize,
    refusal: Option<Status>,
}

impl Teacher {
    /// `None` when it ends before it listens.
    fn start(device: &Device, fault: Option<&Fault>) -> Option<Self> {
        let policy =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/teacher-push.safetensors");
        let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
        command.args(["--log", "warn", "teacher", "--listen", "127.0.0.1:0", "--ledger"]);
        command.arg(device.root().join("ledger.sqlite")).arg("--policy").arg(policy);
        command.stdin(Stdio::null()).stdout(Stdio::piped());
        command.stderr(File::create(device.beside("said")).expect("creates"));
        device.attach(&mut command, fault);
        let mut process = command.spawn().expect("starts");
        let mut line = String::new();
        let output = process.stdout.take().expect("piped");
        BufReader::new(output).read_line(&mut line).expect("readable");
        let Some(address) = line.trim().strip_prefix("listening on ") else {
            let code = process.wait().expect("a child").code();
            check_refusal(code, fault, &said(device));
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

    /// Opens the account and its leases, asks about every step and settles; goes no further than it is answered.
    fn ask_everything(&mut self) -> Told {
        let mut told = Told::default();
        if let Err(refusal) = self.try_everything(&mut told) {
            told.refusal = Some(refusal);
        }
        told
    }

    fn try_everything(&mut self, told: &mut Told) -> Result<(), Status> {
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
                let ask = pb::AdviseRequest { account: account.clone(), steps };
                let answer = self.call(async |mut client| client.advise(ask.clone()).await)?;
                let is_charged = answer.steps[0].charged;
                told.charged.push(is_charged);
                told.n_spent += usize::from(is_charged);
            }
            let settle =
                pb::SettleLeasesRequest { account: account.clone(), episodes: vec![episode] };
            self.call(async |mut client| client.settle_leases(settle.clone()).await)?;
            told.n_durable = told.n_spent;
        }
        Ok(())
    }

    /// Calls until there is an answer, a few times.
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
        self.runtime.as_ref().expect("it was not asked to end").block_on(call)
    }

    /// Asks it to end, and waits until it has.
    fn end(&mut self) {
        drop(self.runtime.take());
        signal("-TERM", self.process.id());
        self.process.wait().expect("a child");
    }

    /// Ends it as `kill -9` does.
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

fn said(device: &Device) -> String {
    fs::read_to_string(device.beside("said")).expect("readable")
}

fn query(episode: u64, step: u32) -> pb::StepQuery {
    let numbers = |n: u16| (0..n).map(|idx| f32::from(idx) / 100.0).collect();
    let (observation, goal, proposed_action) = (numbers(28), numbers(3), numbers(3));
    pb::StepQuery { episode, step, observation, goal, proposed_action }
}

/// Checks the end of a teacher that did not start.
fn check_refusal(code: Option<i32>, fault: Option<&Fault>, said: &str) {
    let is_killed = fault.is_some_and(|fault| matches!(fault.mode, Mode::Kill | Mode::Cut));
    if is_killed {
        assert_eq!(code, None, "{said}");
        return;
    }
    assert_eq!(code, Some(75), "{fault:?}: {said}");
    assert_eq!(said.lines().count(), 1, "{said}");
    assert!(said.contains("cannot open the ledger") && said.contains("ledger.sqlite"), "{said}");
}

/// Asks a teacher on a disk with a fault, restarts it on the whole disk and asks everything again.
fn check(fault: &Fault) {
    let device = Device::new();
    let mut told = Told::default();
    if let Some(mut teacher) = Teacher::start(&device, Some(fault)) {
        told = teacher.ask_everything();
        teacher.end();
    }
    let what = format!("{fault}: {:?}: {}", told.refusal, said(&device));
    assert_eq!(told.charged, CALM.0[..told.charged.len()], "{what}");
    check_words(fault, &told, &said(&device), &what);
    let n_kept = if fault.mode == Mode::Cut { told.n_durable } else { told.n_spent };
    if fault.mode == Mode::Cut {
        device.lose_unsynced();
    }
    let mut teacher = Teacher::start(&device, None).expect("starts on a whole disk");
    let n_spent = spent(&teacher);
    // One more than was answered: the charge was written, the answer was not sent.
    assert!((n_kept..=told.n_spent + 1).contains(&n_spent), "{n_spent} of {n_kept}: {what}");
    assert_eq!(teacher.ask_everything().charged, CALM.0, "{what}");
    teacher.kill();
    assert_eq!(account(&device.root().join("ledger.sqlite")), CALM.1, "{what}");
}

/// Checks that a teacher that does not answer says why: to its caller, and once in its log.
fn check_words(fault: &Fault, told: &Told, said: &str, what: &str) {
    assert!(!said.contains("panicked"), "{what}");
    let is_killed = matches!(fault.mode, Mode::Kill | Mode::Cut);
    let Some(refusal) = told.refusal.as_ref().filter(|_| !is_killed) else { return };
    assert_eq!(fault.mode, Mode::Dead, "it is asked again: {what}");
    let names = |text: &str| {
        let causes = ["disk I/O error", "database or disk is full"];
        text.contains("ledger.sqlite") && causes.iter().any(|cause| text.contains(cause))
    };
    assert_eq!(refusal.code(), Code::Unavailable, "{what}");
    assert!(names(refusal.message()), "{what}");
    let lines = said.lines().filter(|line| line.contains("nothing can be charged"));
    let lines: Vec<&str> = lines.collect();
    assert!(lines.len() == 1 && names(lines[0]), "{what}");
}

/// Units spent by the account; none when it is not open.
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

/// Faults at `n_hits` calls, at equal distances.
fn faults(mode: Mode, errno: i32, n_hits: usize) -> Vec<Fault> {
    let n_calls = CALM.2;
    let at = |hit: usize| hit * n_calls / n_hits + 1;
    (0..n_hits).map(|hit| Fault { errno, ..Fault::new(mode, at(hit), "ledger") }).collect()
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

/// Every call of a teacher to its disk, in every mode:
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
        faults(mode, errno, CALM.2).iter().for_each(check);
        println!("survived: {} calls, {mode:?}, error {errno}", CALM.2);
    }
}
