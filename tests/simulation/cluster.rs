//! A whole run on a simulated network: a teacher, a learner and workers, each on a host of its own.
//!
//! All three are the real ones. What a crashed learner's thread still writes goes to a directory that nobody reads any
//! more: the next learner gets what was on the disk at the moment of the crash.

use std::cell::{Cell, RefCell};
use std::fs;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tandem_learner::{LearnerConfig, checkpoint};
use tandem_net::{Pacing, ServerConfig};
use tandem_policy::Policy;
use tandem_rl::RunConfig;
use tandem_teacher::policy::OneArmPolicy;
use tandem_teacher::{Advisor, serve_advisor};
use tandem_telemetry::MetricsLog;
use tandem_worker::{WorkerConfig, run};
use tokio_util::sync::CancellationToken;

use crate::books::{Ledgers, SharedBook, Watched};
use crate::machines::{House, Machines, with_causes};
use crate::network::{address, client_config, listen};
use crate::schedule::{Host, Schedule};
use crate::system;

/// Hosts of the services.
pub(crate) const SERVICES: [Host; 2] = [TEACHER, LEARNER];
const TEACHER: Host = "teacher";
pub(crate) const LEARNER: Host = "learner";
/// Hosts of the workers.
pub(crate) const WORKERS: [Host; 5] = ["worker-1", "worker-2", "worker-3", "worker-4", "worker-5"];

/// Numbers of workers that each learner has for itself.
const WORKER_NUMBERS: u64 = 1000;

/// A run and who takes part in it.
pub(crate) struct Scenario {
    pub(crate) run: RunConfig,
    pub(crate) workers: &'static [Host],
    pub(crate) ledgers: Ledgers,
}

/// How a run ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Outcome {
    pub(crate) digest: String,
    pub(crate) n_rounds: u64,
    /// Units of advice spent, set aside and left.
    pub(crate) units: [u64; 3],
    /// Rounds after which the policy was judged.
    pub(crate) judged: Vec<u64>,
    /// Counters, balance and evaluations in every detail, without the time they took.
    pub(crate) details: String,
}

/// What happened on the way.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Course {
    /// Simulated time that it took.
    pub(crate) took: Duration,
    /// Steps that the teacher was asked about again.
    pub(crate) n_repeats: u64,
    /// Learners that went on from a checkpoint.
    pub(crate) n_resumed: u64,
    /// Teachers that started.
    pub(crate) n_teachers: u64,
    /// Workers that started.
    pub(crate) n_workers: u64,
}

impl Course {
    pub(crate) fn plus(self, other: &Self) -> Self {
        Self {
            took: self.took + other.took,
            n_repeats: self.n_repeats + other.n_repeats,
            n_resumed: self.n_resumed + other.n_resumed,
            n_teachers: self.n_teachers + other.n_teachers,
            n_workers: self.n_workers + other.n_workers,
        }
    }
}

/// The pairs of hosts that talk to each other.
pub(crate) fn links(workers: &[Host]) -> Vec<(Host, Host)> {
    let of_workers = workers.iter().flat_map(|worker| SERVICES.map(|service| (*worker, service)));
    of_workers.chain([(LEARNER, TEACHER)]).collect()
}

/// Lets `scenario` go through `schedule`; gives how it ended, or what went wrong that must not.
pub(crate) fn simulate(
    scenario: &Scenario,
    schedule: &Schedule,
) -> Result<(Outcome, Course), String> {
    simulate_with(scenario, schedule, |_| {})
}

/// [`simulate`] with further hosts, which `invite` adds.
pub(crate) fn simulate_with<'a>(
    scenario: &'a Scenario,
    schedule: &'a Schedule,
    invite: impl FnOnce(&mut Machines<'a>),
) -> Result<(Outcome, Course), String> {
    let house = Rc::default();
    let stage = Rc::new(Stage::new(scenario.run.clone(), &house));
    let disk = Rc::clone(&stage);
    let before_crash = move |host| {
        if host == LEARNER {
            disk.keep_learner_disk();
        }
    };
    let mut machines = Machines::new(schedule, &house, links(scenario.workers), before_crash);
    let for_teacher = Rc::clone(&stage);
    machines.add(TEACHER, move || {
        let ledger = Watched::new(scenario.ledgers.open(), for_teacher.book.clone());
        Rc::clone(&for_teacher).teacher(ledger)
    });
    let for_learner = Rc::clone(&stage);
    machines.add(LEARNER, move || Rc::clone(&for_learner).learner());
    for worker in scenario.workers {
        let for_worker = Rc::clone(&stage);
        machines.add(worker, move || Rc::clone(&for_worker).worker(worker));
    }
    invite(&mut machines);
    let ended = machines.run_until(|| stage.ended.borrow_mut().take());
    let course = Course { took: machines.elapsed(), ..stage.course.get() };
    machines.end();
    let outcome = stage.outcome(&scenario.ledgers, ended??)?;
    let n_repeats = stage.book.lock().expect("nobody panics").n_repeats;
    Ok((outcome, Course { n_repeats, ..course }))
}

/// What outlives the processes on the hosts: the learner's directories, and what was seen.
struct Stage {
    run: RunConfig,
    house: Rc<House>,
    book: SharedBook,
    /// Learners that have started. Each has a directory of its own.
    n_learners: Cell<u64>,
    course: Cell<Course>,
    /// What the learner says at the end: the digest.
    ended: RefCell<Option<Result<String, String>>>,
}

impl Stage {
    fn new(run: RunConfig, house: &Rc<House>) -> Self {
        Self {
            run,
            house: Rc::clone(house),
            book: Arc::new(Mutex::default()),
            n_learners: Cell::new(0),
            course: Cell::default(),
            ended: RefCell::default(),
        }
    }

    /// The run directory of the learner that started as number `number`, from 1.
    fn learner_directory(number: u64) -> PathBuf {
        PathBuf::from(format!("learner-{number}"))
    }

    /// Hands what is on the learner's disk at this moment to the learner that will start next.
    fn keep_learner_disk(&self) {
        let (from, to) = (
            Self::learner_directory(self.n_learners.get()),
            Self::learner_directory(self.n_learners.get() + 1),
        );
        fs::create_dir_all(to.join("checkpoint")).expect("a directory");
        for path in checkpoint::list(&from.join("checkpoint")) {
            let name = path.file_name().expect("a file").to_owned();
            fs::copy(&path, to.join("checkpoint").join(name)).expect("a copy");
        }
        // There is none before the first evaluation.
        drop(fs::copy(from.join("metrics.jsonl"), to.join("metrics.jsonl")));
    }

    async fn learner(self: Rc<Self>) -> turmoil::Result {
        let number = self.n_learners.get() + 1;
        self.n_learners.set(number);
        let out = Self::learner_directory(number);
        let resume = !checkpoint::list(&out.join("checkpoint")).is_empty();
        self.course
            .update(|course| Course { n_resumed: course.n_resumed + u64::from(resume), ..course });
        let life = self.house.life_of(LEARNER);
        let config = LearnerConfig {
            run: self.run.clone(),
            server_config: ServerConfig::default(),
            client_config: client_config(),
            teacher: Some(address(TEACHER)),
            start_from: None,
            out,
            resume,
            out_is_locked: false,
            run_file: None,
            n_threads: 1,
            clock: Arc::new(move || {
                let _life = &life;
                system::now()
            }),
            version: "simulated".to_owned(),
            first_worker: number * WORKER_NUMBERS,
            pacing: Pacing::Lockstep,
        };
        // A crash drops this future and cancels the token: what is left of the learner's thread then ends.
        let shutdown = CancellationToken::new();
        let _crash = shutdown.clone().drop_guard();
        let ended = match tandem_learner::serve(config, listen().await?, shutdown).await {
            Ok(ended) if ended.interrupted => Err(format!("interrupted: {}", ended.reason)),
            Ok(ended) => Ok(ended.digest),
            Err(error) => Err(with_causes(LEARNER, &error)),
        };
        *self.ended.borrow_mut() = Some(ended);
        Ok(())
    }

    async fn teacher(self: Rc<Self>, ledger: Watched) -> turmoil::Result {
        self.course.update(|course| Course { n_teachers: course.n_teachers + 1, ..course });
        let policy = OneArmPolicy::new(teacher_policy())?;
        let advisor = Advisor::new(Box::new(policy), Box::new(ledger))?;
        let (server_config, for_ever) = (ServerConfig::default(), CancellationToken::new());
        let served =
            serve_advisor(advisor, listen().await?, &server_config, for_ever, Pacing::Lockstep)
                .await;
        if let Err(error) = served {
            self.house.complain(with_causes(TEACHER, &error));
        }
        Ok(())
    }

    async fn worker(self: Rc<Self>, host: Host) -> turmoil::Result {
        self.course.update(|course| Course { n_workers: course.n_workers + 1, ..course });
        let config = WorkerConfig {
            client: client_config(),
            learner: address(LEARNER),
            teacher: Some(address(TEACHER)),
            name: host.to_owned(),
            log_dir: None,
            pacing: Pacing::Lockstep,
        };
        if let Err(error) = run(config, self.house.leave_of(host)).await {
            self.house.complain(with_causes(host, &error));
        }
        Ok(())
    }

    /// How the run that gave `digest` ended, according to everything that is left of it.
    fn outcome(&self, ledgers: &Ledgers, digest: String) -> Result<Outcome, String> {
        let book = self.book.lock().expect("nobody panics");
        let complaint = self.house.complaint().or_else(|| book.complaints.first().cloned());
        if let Some(complaint) = complaint {
            return Err(complaint);
        }
        let directory = Self::learner_directory(self.n_learners.get());
        let mut metrics = MetricsLog::read_all(&directory.join("metrics.jsonl"))
            .map_err(|error| error.to_string())?;
        metrics.iter_mut().for_each(|row| row.wall_s = 0.0);
        let checkpoints = directory.join("checkpoint");
        let loaded =
            checkpoint::load_newest(&checkpoints, &self.run).map_err(|error| error.to_string())?;
        let trainer = loaded.ok_or("no checkpoint is left")?.trainer;
        if trainer.digest() != digest {
            return Err("the last checkpoint is not what the run ended with".to_owned());
        }
        let account = self.run.name.as_str();
        if book.accounts() != [account] {
            return Err(format!("a run has one account, not {:?}", book.accounts()));
        }
        let balance = ledgers.open().balance(account).map_err(|error| error.to_string())?;
        let counters = trainer.counters();
        let (n_charged, n_arrived) = (book.n_charged(account), counters.advice_spent);
        if [n_charged, n_arrived] != [balance.spent; 2] {
            let spent = balance.spent;
            return Err(format!(
                "{n_charged} steps were charged, {n_arrived} units came with episodes, {spent} are spent"
            ));
        }
        Ok(Outcome {
            digest,
            n_rounds: counters.round,
            units: [balance.spent, balance.leased, balance.left],
            judged: metrics.iter().map(|row| row.round).collect(),
            details: format!("{counters:?} {balance:?} {metrics:?}"),
        })
    }
}

/// The policy that teaches.
fn teacher_policy() -> &'static Policy {
    static POLICY: OnceLock<Policy> = OnceLock::new();
    POLICY.get_or_init(|| {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/teacher-push.safetensors");
        Policy::load(&path).expect("ships")
    })
}
