//! A whole run on a simulated network: a teacher, a learner and workers, each on its own host.
//!
//! All three run the production code. The next learner starts from the files on disk at the moment of a crash. Later
//! writes of the crashed learner's thread go to an abandoned directory.

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
use tandem_worker::{Liveness, WorkerConfig, run};
use tokio_util::sync::CancellationToken;

use crate::ledgers::{Ledgers, ObservedLedger, SharedRecord};
use crate::machines::{Machines, ProcessTracker, with_causes};
use crate::network::{address, client_config, listen};
use crate::schedule::{Host, Schedule};
use crate::system;

/// Hosts of the services.
pub(crate) const SERVICES: [Host; 2] = [TEACHER, LEARNER];
const TEACHER: Host = "teacher";
pub(crate) const LEARNER: Host = "learner";
/// Hosts of the workers.
pub(crate) const WORKERS: [Host; 5] = ["worker-1", "worker-2", "worker-3", "worker-4", "worker-5"];

/// Number of worker ids reserved for each learner.
const WORKER_NUMBERS: u64 = 1000;

/// A run and its participants.
pub(crate) struct Scenario {
    pub(crate) run: RunConfig,
    pub(crate) workers: &'static [Host],
    pub(crate) ledgers: Ledgers,
}

/// The result of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Outcome {
    pub(crate) digest: String,
    pub(crate) n_rounds: u64,
    /// Units of advice spent, set aside and left.
    pub(crate) units: [u64; 3],
    /// Rounds after which the policy was evaluated.
    pub(crate) evaluated: Vec<u64>,
    /// Counters, balance and evaluations in full, without wall times.
    pub(crate) details: String,
}

/// Statistics of a simulated run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Statistics {
    /// Simulated duration.
    pub(crate) took: Duration,
    /// Number of repeated requests for a step.
    pub(crate) n_repeats: u64,
    /// Number of learners that resumed from a checkpoint.
    pub(crate) n_resumed: u64,
    /// Number of teacher starts.
    pub(crate) n_teachers: u64,
    /// Number of worker starts.
    pub(crate) n_workers: u64,
}

impl Statistics {
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

/// Returns the pairs of hosts that communicate.
pub(crate) fn links(workers: &[Host]) -> Vec<(Host, Host)> {
    let of_workers = workers.iter().flat_map(|worker| SERVICES.map(|service| (*worker, service)));
    of_workers.chain([(LEARNER, TEACHER)]).collect()
}

/// Simulates `scenario` under `schedule`. Returns its outcome, or the first violation.
pub(crate) fn simulate(
    scenario: &Scenario,
    schedule: &Schedule,
) -> Result<(Outcome, Statistics), String> {
    simulate_with(scenario, schedule, |_| {})
}

/// [`simulate`] with further hosts, added by `add_hosts`.
pub(crate) fn simulate_with<'a>(
    scenario: &'a Scenario,
    schedule: &'a Schedule,
    add_hosts: impl FnOnce(&mut Machines<'a>),
) -> Result<(Outcome, Statistics), String> {
    let tracker = Rc::default();
    let state = Rc::new(PersistentState::new(scenario.run.clone(), &tracker));
    let disk = Rc::clone(&state);
    let before_crash = move |host| {
        if host == LEARNER {
            disk.keep_learner_disk();
        }
    };
    let mut machines = Machines::new(schedule, &tracker, links(scenario.workers), before_crash);
    let for_teacher = Rc::clone(&state);
    machines.add(TEACHER, move || {
        let ledger = ObservedLedger::new(scenario.ledgers.open(), for_teacher.record.clone());
        Rc::clone(&for_teacher).teacher(ledger)
    });
    let for_learner = Rc::clone(&state);
    machines.add(LEARNER, move || Rc::clone(&for_learner).learner());
    for worker in scenario.workers {
        let for_worker = Rc::clone(&state);
        machines.add(worker, move || Rc::clone(&for_worker).worker(worker));
    }
    add_hosts(&mut machines);
    let ended = machines.run_until(|| state.ended.borrow_mut().take());
    let statistics = Statistics { took: machines.elapsed(), ..state.statistics.get() };
    machines.end();
    let outcome = state.outcome(&scenario.ledgers, ended??)?;
    let n_repeats = state.record.lock().expect("not poisoned").n_repeats;
    Ok((outcome, Statistics { n_repeats, ..statistics }))
}

/// State that outlives the processes: the learner's directories and the observations.
struct PersistentState {
    run: RunConfig,
    tracker: Rc<ProcessTracker>,
    record: SharedRecord,
    /// Number of learner starts. Each learner has its own directory.
    n_learners: Cell<u64>,
    statistics: Cell<Statistics>,
    /// The digest that the learner returned, or its error.
    ended: RefCell<Option<Result<String, String>>>,
}

impl PersistentState {
    fn new(run: RunConfig, tracker: &Rc<ProcessTracker>) -> Self {
        Self {
            run,
            tracker: Rc::clone(tracker),
            record: Arc::new(Mutex::default()),
            n_learners: Cell::new(0),
            statistics: Cell::default(),
            ended: RefCell::default(),
        }
    }

    /// Returns the run directory of the `number`th learner, counted from 1.
    fn learner_directory(number: u64) -> PathBuf {
        PathBuf::from(format!("learner-{number}"))
    }

    /// Copies the learner's current files to the directory of the next learner.
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
        // The file does not exist before the first evaluation.
        drop(fs::copy(from.join("metrics.jsonl"), to.join("metrics.jsonl")));
    }

    async fn learner(self: Rc<Self>) -> turmoil::Result {
        let number = self.n_learners.get() + 1;
        self.n_learners.set(number);
        let out = Self::learner_directory(number);
        let resume = !checkpoint::list(&out.join("checkpoint")).is_empty();
        self.statistics.update(|statistics| Statistics {
            n_resumed: statistics.n_resumed + u64::from(resume),
            ..statistics
        });
        let lifetime = self.tracker.lifetime_token(LEARNER);
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
                let _lifetime = &lifetime;
                system::now()
            }),
            unix_start: Duration::ZERO,
            version: "simulated".to_owned(),
            first_worker: number * WORKER_NUMBERS,
            pacing: Pacing::Lockstep,
        };
        // A crash drops this future and cancels the token, which ends the learner's thread.
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

    async fn teacher(self: Rc<Self>, ledger: ObservedLedger) -> turmoil::Result {
        self.statistics.update(|statistics| Statistics {
            n_teachers: statistics.n_teachers + 1,
            ..statistics
        });
        let policy = OneArmPolicy::new(teacher_policy())?;
        let advisor = Advisor::new(Box::new(policy), Box::new(ledger))?;
        let (server_config, shutdown) = (ServerConfig::default(), CancellationToken::new());
        let served =
            serve_advisor(advisor, listen().await?, &server_config, shutdown, Pacing::Lockstep)
                .await;
        if let Err(error) = served {
            self.tracker.report_violation(with_causes(TEACHER, &error));
        }
        Ok(())
    }

    async fn worker(self: Rc<Self>, host: Host) -> turmoil::Result {
        self.statistics
            .update(|statistics| Statistics { n_workers: statistics.n_workers + 1, ..statistics });
        let config = WorkerConfig {
            environment: None,
            client: client_config(),
            learner: address(LEARNER),
            teacher: Some(address(TEACHER)),
            name: host.to_owned(),
            recording: None,
            pacing: Pacing::Lockstep,
            liveness: Liveness::default(),
        };
        if let Err(error) = run(config, self.tracker.shutdown_token(host)).await {
            self.tracker.report_violation(with_causes(host, &error));
        }
        Ok(())
    }

    /// Returns the outcome of the run that ended with `digest`, from its files, ledger and record.
    fn outcome(&self, ledgers: &Ledgers, digest: String) -> Result<Outcome, String> {
        let record = self.record.lock().expect("not poisoned");
        let violation =
            self.tracker.first_violation().or_else(|| record.violations.first().cloned());
        if let Some(violation) = violation {
            return Err(violation);
        }
        let directory = Self::learner_directory(self.n_learners.get());
        let mut metrics = MetricsLog::read_all(&directory.join("metrics.jsonl"))
            .map_err(|error| error.to_string())?;
        metrics.iter_mut().for_each(|row| row.wall_s = 0.0);
        let checkpoints = directory.join("checkpoint");
        let loaded =
            checkpoint::load_newest(&checkpoints, &self.run).map_err(|error| error.to_string())?;
        let trainer = loaded.ok_or("no checkpoint")?.trainer;
        if trainer.digest() != digest {
            return Err("the last checkpoint differs from the result of the run".to_owned());
        }
        let account = self.run.name.as_str();
        if record.accounts() != [account] {
            return Err(format!("a run has one account, not {:?}", record.accounts()));
        }
        let balance = ledgers.open().balance(account).map_err(|error| error.to_string())?;
        let counters = trainer.counters();
        let (n_charged, n_arrived) = (record.n_charged(account), counters.advice_spent);
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
            evaluated: metrics.iter().map(|row| row.round).collect(),
            details: format!("{counters:?} {balance:?} {metrics:?}"),
        })
    }
}

/// Returns the teacher's policy.
fn teacher_policy() -> &'static Policy {
    static POLICY: OnceLock<Policy> = OnceLock::new();
    POLICY.get_or_init(|| {
        let path =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/teacher-push-classic.safetensors");
        Policy::load(&path).expect("ships")
    })
}
