//! A whole run in separate processes, with all connections through proxies and a schedule of faults.

use std::collections::BTreeMap;
use std::fs;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use tandem_proto::pb;
use tandem_proto::pb::learner_client::LearnerClient;
use tandem_proto::pb::teacher_client::TeacherClient;
use tokio::sync::watch;
use tonic::transport::{Channel, Endpoint};

use crate::process::Process;
use crate::proxy::Proxy;
use crate::recovery::{Recoveries, Recovery};
use crate::schedule::{Event, Fault, Link, Schedule, Target};

/// Name of the run and of its account.
pub(crate) const NAME: &str = "chaos";
/// Polling interval.
const TICK: Duration = Duration::from_millis(20);
/// Maximum number of restarts that fail because the port is briefly in use.
const MAX_FALSE_STARTS: u32 = 20;

/// The processes of a run and the proxies between them.
pub(crate) struct Cluster {
    dir: PathBuf,
    teacher: Process,
    teacher_at: SocketAddr,
    learner: Process,
    learner_at: SocketAddr,
    workers: Vec<Process>,
    links: BTreeMap<Link, Proxy>,
    progress: watch::Receiver<pb::Progress>,
    started: Instant,
    /// Ends of active faults, with their times.
    undo: Vec<(Duration, Undo)>,
    /// Number of disturbances of each link.
    n_disturbances: BTreeMap<Link, u32>,
    recoveries: Recoveries,
    n_false_starts: u32,
}

/// The end of a fault. It is ignored if a newer fault has the same target.
#[derive(Debug, Clone, Copy)]
enum Undo {
    Continue(Target, u32),
    EndDisturbance(Link, u32),
}

/// The results of a run.
#[derive(Debug)]
pub(crate) struct Outcome {
    pub(crate) progress: pb::Progress,
    pub(crate) account: pb::Account,
    pub(crate) wall: Duration,
    pub(crate) events: Vec<Event>,
    pub(crate) recoveries: Vec<Recovery>,
}

/// Returns the ledger path of a run in `dir`.
pub(crate) fn ledger_path(dir: &Path) -> PathBuf {
    dir.join("ledger.sqlite")
}

/// Returns the run directory of a run in `dir`.
pub(crate) fn run_dir(dir: &Path) -> PathBuf {
    dir.join("run")
}

impl Cluster {
    /// Starts teacher, learner and workers in `dir`.
    pub(crate) async fn start(dir: &Path, run_file: &str, n_workers: usize) -> Self {
        let file = dir.join("run.toml");
        fs::write(&file, run_file).expect("writable");
        let log = |name: &str| dir.join(format!("{name}.log"));
        let path = |path: PathBuf| path.into_os_string();
        let policy =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/teacher-push-classic.safetensors");
        let args = ["teacher".into(), "--policy".into(), path(policy), "--ledger".into()];
        let args = args.into_iter().chain([path(ledger_path(dir))]).collect();
        let (teacher, teacher_at) = Process::serve(args, &log("teacher"));
        let mut links = BTreeMap::new();
        let proxy = Proxy::start(teacher_at).await;
        let args = ["learner".into(), "--run".into(), path(file), "--out".into()];
        let teacher_arg = ["--teacher".into(), proxy.address().to_string().into()];
        let args = args.into_iter().chain([path(run_dir(dir))]).chain(teacher_arg).collect();
        links.insert(Link::LearnerToTeacher, proxy);
        let (mut learner, learner_at) = Process::serve(args, &log("learner"));
        learner.add_args(["--resume".to_owned()]);
        let mut workers = Vec::new();
        for idx in 0..n_workers {
            let to_learner = Proxy::start(learner_at).await;
            let to_teacher = Proxy::start(teacher_at).await;
            let args = [
                "worker".into(),
                "--name".into(),
                worker_name(idx, 0).into(),
                "--connect".into(),
                to_learner.address().to_string().into(),
                "--teacher".into(),
                to_teacher.address().to_string().into(),
            ];
            workers.push(Process::start(args.into(), &log(&format!("worker-{idx}"))));
            links.insert(Link::WorkerToLearner(idx), to_learner);
            links.insert(Link::WorkerToTeacher(idx), to_teacher);
        }
        Self {
            dir: dir.to_owned(),
            teacher,
            teacher_at,
            learner,
            learner_at,
            workers,
            n_disturbances: links.keys().map(|link| (*link, 0)).collect(),
            links,
            progress: follow(learner_at),
            started: now(),
            undo: Vec::new(),
            recoveries: Recoveries::default(),
            n_false_starts: 0,
        }
    }

    /// Waits for the end of the run while `schedule` injects faults. Panics after `deadline`.
    pub(crate) async fn run(mut self, schedule: Option<Schedule>, deadline: Duration) -> Outcome {
        let mut schedule = schedule.into_iter().flatten().peekable();
        let mut events = Vec::new();
        while !self.has_ended() {
            let elapsed = self.started.elapsed();
            assert!(elapsed < deadline, "not done after {elapsed:?}; so far {events:#?}\n{self:?}");
            self.undo_until(elapsed);
            if let Some(event) = schedule.next_if(|event| event.at <= elapsed) {
                events.push(event);
                self.apply(event.fault);
            }
            tokio::time::sleep(TICK).await;
        }
        let wall = self.started.elapsed();
        self.undo_until(Duration::MAX);
        let account = self.account().await;
        assert!(self.teacher.end().success(), "{self:?}");
        let progress = self.progress.borrow().clone();
        Outcome { progress, account, wall, events, recoveries: self.recoveries.take() }
    }

    /// Returns true once the learner has ended and reported its result.
    ///
    /// # Panics
    /// If a process ends without having been killed.
    fn has_ended(&mut self) -> bool {
        let is_reported = self.progress.borrow().ended && !self.progress.borrow().digest.is_empty();
        match self.learner.ended() {
            None => (),
            Some(status) if status.success() && is_reported => return true,
            // Its last message was lost: a restart reports the same result.
            Some(status) if status.success() => self.learner.restart(),
            Some(status) => self.restart_if_port_was_taken(Target::Learner, status.code()),
        }
        if let Some(status) = self.teacher.ended() {
            self.restart_if_port_was_taken(Target::Teacher, status.code());
        }
        for idx in 0..self.workers.len() {
            let status = self.workers[idx].ended();
            assert!(status.is_none_or(|status| status.success()), "worker {idx}: {self:?}");
        }
        false
    }

    fn restart_if_port_was_taken(&mut self, target: Target, code: Option<i32>) {
        let is_taken = self.process(target).log_tail().contains("cannot listen");
        self.n_false_starts += 1;
        assert!(
            code == Some(75) && is_taken && self.n_false_starts < MAX_FALSE_STARTS,
            "{target:?} ended with {code:?}: {self:?}"
        );
        self.process(target).restart();
    }

    fn apply(&mut self, fault: Fault) {
        let until = self.started.elapsed() + fault.lasts();
        self.recoveries.disturbed_by(fault);
        match fault {
            Fault::Kill(target) => {
                self.process(target).kill();
                self.restart(target);
                self.measure(target);
            }
            Fault::Stop(target, _) => {
                let process = self.process(target);
                process.n_interruptions += 1;
                process.signal("-STOP");
                let undo = Undo::Continue(target, process.n_interruptions);
                self.undo.push((until, undo));
            }
            Fault::Cut(link) => self.links[&link].cut(),
            Fault::Disturb(link, how, _) => {
                self.links[&link].disturb(Some(how));
                let n_disturbances = self.n_disturbances.entry(link).or_default();
                *n_disturbances += 1;
                self.undo.push((until, Undo::EndDisturbance(link, *n_disturbances)));
            }
        }
    }

    /// Ends the faults that are over at `elapsed`.
    fn undo_until(&mut self, elapsed: Duration) {
        let is_over = |(at, _): &mut (Duration, Undo)| *at <= elapsed;
        let over: Vec<_> = self.undo.extract_if(.., is_over).collect();
        over.into_iter().for_each(|(_, undo)| self.undo(undo));
    }

    fn undo(&mut self, undo: Undo) {
        match undo {
            Undo::Continue(target, n_interruptions) => {
                let process = self.process(target);
                if process.n_interruptions == n_interruptions {
                    process.signal("-CONT");
                }
            }
            Undo::EndDisturbance(link, n_disturbances) => {
                if self.n_disturbances[&link] == n_disturbances {
                    self.links[&link].disturb(None);
                }
            }
        }
    }

    fn restart(&mut self, target: Target) {
        let process = self.process(target);
        if let Target::Worker(idx) = target {
            let name = worker_name(idx, process.n_interruptions + 1);
            process.set_arg("--name", &name);
        }
        process.restart();
    }

    /// Measures the recovery time of a process.
    fn measure(&mut self, target: Target) {
        match target {
            Target::Teacher => self.recoveries.teacher(teacher(self.teacher_at)),
            Target::Learner => self.recoveries.learner(learner(self.learner_at)),
            Target::Worker(idx) => {
                let name = worker_name(idx, self.workers[idx].n_interruptions);
                self.recoveries.worker(idx, name, learner(self.learner_at));
            }
        }
    }

    fn process(&mut self, target: Target) -> &mut Process {
        match target {
            Target::Teacher => &mut self.teacher,
            Target::Learner => &mut self.learner,
            Target::Worker(idx) => &mut self.workers[idx],
        }
    }

    async fn account(&self) -> pb::Account {
        let mut teacher = teacher(self.teacher_at);
        for _ in 0..600 {
            let request = pb::GetAccountRequest { name: NAME.to_owned() };
            if let Ok(account) = teacher.get_account(request).await {
                return account.into_inner();
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
        panic!("no account: {self:?}");
    }
}

impl std::fmt::Debug for Cluster {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let progress = self.progress.borrow();
        let (round, phase) = (progress.round, &progress.phase);
        writeln!(formatter, "run in {:?}, round {round}, {phase}", self.dir)?;
        writeln!(formatter, "active faults: {:?}", self.undo)?;
        let workers = self.workers.iter().enumerate();
        let workers = workers.map(|(idx, worker)| (format!("worker {idx}"), worker));
        let services = [("teacher", &self.teacher), ("learner", &self.learner)];
        let services = services.map(|(name, process)| (name.to_owned(), process));
        for (name, process) in services.into_iter().chain(workers) {
            writeln!(formatter, "log of {name}:\n{}", process.log_tail())?;
        }
        Ok(())
    }
}

/// Returns the name of a worker after `n_restarts` restarts.
fn worker_name(idx: usize, n_restarts: u32) -> String {
    format!("worker-{idx}.{n_restarts}")
}

fn channel(address: SocketAddr) -> Channel {
    let endpoint = Endpoint::from_shared(format!("http://{address}")).expect("an address");
    // A stopped process accepts connections but does not answer.
    endpoint.timeout(Duration::from_secs(2)).connect_lazy()
}

fn teacher(address: SocketAddr) -> TeacherClient<Channel> {
    TeacherClient::new(channel(address))
}

fn learner(address: SocketAddr) -> LearnerClient<Channel> {
    LearnerClient::new(channel(address))
}

/// Follows the learner's progress across its restarts. A starting learner reports nothing.
fn follow(address: SocketAddr) -> watch::Receiver<pb::Progress> {
    let (sender, receiver) = watch::channel(pb::Progress::default());
    tokio::spawn(async move {
        let endpoint = Endpoint::from_shared(format!("http://{address}")).expect("an address");
        let mut learner = LearnerClient::new(endpoint.connect_lazy());
        while !sender.is_closed() {
            if let Ok(stream) = learner.watch(pb::WatchRequest {}).await {
                let mut stream = stream.into_inner();
                while let Ok(Some(progress)) = stream.message().await {
                    if !progress.task.is_empty() {
                        sender.send_replace(progress);
                    }
                }
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    });
    receiver
}

#[expect(clippy::disallowed_methods, reason = "faults come by the clock")]
pub(crate) fn now() -> Instant {
    Instant::now()
}
