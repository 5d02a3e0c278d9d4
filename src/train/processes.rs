//! The processes of a run: started in order, restarted when they die, ended together.

use std::ffi::OsString;
use std::net::{IpAddr, SocketAddr};
use std::process::Stdio;
use std::time::{Duration, Instant};

use anyhow::{Context as _, anyhow};
use tandem_system::process::ResidentMemory;
use tokio::task::JoinSet;

use super::arguments;
use super::plan::Plan;
use super::restart_policy::{Decision, RestartPolicy, Role};
use super::run_lock::RunLock;
use crate::exit::Exit;
use crate::launch::{ChildProcess, Launcher, ProcessEnd, ProcessLog, ServiceAddresses};
use crate::run_display::Display;
use crate::{clock, dashboard};

/// Time that the teacher and the workers have to exit after the learner.
const GRACE: Duration = Duration::from_secs(5);

pub(crate) struct RunProcesses<'a> {
    plan: &'a Plan,
    /// The lock on the run directory. Once another directory has its path, no process is restarted.
    lock: &'a RunLock,
    launcher: Launcher,
    /// The teacher, if the run has one, the learner, the workers.
    processes: Vec<Process>,
    /// Addresses of the services, which stay the same after a restart.
    teacher_address: Option<String>,
    learner_address: String,
    /// IP address that the dashboard listens on, if there is to be one.
    dashboard_ip: Option<IpAddr>,
    /// Address of the dashboard, if there is one.
    dashboard: Option<SocketAddr>,
    /// The learner has still to write the run file, which it does when it has loaded its checkpoint.
    awaits_run_file: bool,
    peak: PeakMemory,
}

/// Largest resident memory of each kind of process, MiB; 0 if there is none or it is unknown.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct PeakMemory {
    pub(crate) learner_mib: u64,
    pub(crate) teacher_mib: u64,
    pub(crate) worker_mib: u64,
}

/// The error after which a run cannot continue.
#[derive(Debug)]
pub(crate) struct RunFailure {
    pub(crate) exit: Exit,
    pub(crate) error: anyhow::Error,
}

impl From<anyhow::Error> for RunFailure {
    fn from(error: anyhow::Error) -> Self {
        Self { exit: Exit::TryAgain, error }
    }
}

/// The state of a learner that was asked to exit.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Saved {
    /// It has.
    Yes,
    /// It could not, for this reason.
    Failed(String),
    /// It was killed at the deadline.
    TooLate,
}

/// Events found by [`RunProcesses::check`].
#[derive(Debug, Default)]
pub(crate) struct ProcessEvents {
    /// One line per restart.
    pub(crate) lines: Vec<String>,
    pub(crate) learner_restarted: bool,
    /// The learner was interrupted by a signal and has saved its state.
    pub(crate) interrupted: bool,
}

struct Process {
    role: Role,
    name: String,
    state: State,
    policy: RestartPolicy,
}

enum State {
    Running(ChildProcess),
    Waiting { until: Instant, end: ProcessEnd, reason: String },
}

/// The result of starting a service.
enum ServiceStart {
    /// It has printed its addresses.
    Ready { process: Process, addresses: ServiceAddresses },
    /// It ended before that.
    Ended { name: String, child: ChildProcess, end: ProcessEnd },
}

impl<'a> RunProcesses<'a> {
    /// Prepares a run whose processes log to the plan's log file.
    pub(crate) fn new((plan, lock): (&'a Plan, &'a RunLock)) -> anyhow::Result<Self> {
        Ok(Self {
            plan,
            lock,
            launcher: Launcher::new(ProcessLog::open(&plan.log_path())?)?,
            processes: Vec::new(),
            teacher_address: None,
            learner_address: String::new(),
            dashboard_ip: plan.dashboard.map(|address| address.ip()),
            dashboard: None,
            awaits_run_file: true,
            peak: PeakMemory::default(),
        })
    }

    /// Starts the teacher, the learner and the workers, in this order.
    pub(crate) async fn start(&mut self, display: &Display) -> Result<(), RunFailure> {
        let plan = self.plan;
        if plan.config.advice.asks() {
            let args = arguments::teacher(plan);
            self.teacher_address = Some(self.start_service(Role::Teacher, &args, display).await?);
        }
        let mut args = arguments::learner(plan, self.teacher_address.as_deref(), plan.resume);
        args.push(arguments::KEEP_RUN_FILE.into());
        arguments::push_dashboard(&mut args, plan, plan.dashboard);
        self.learner_address = self.start_service(Role::Learner, &args, display).await?;
        for number in 1..=plan.n_workers {
            let name = format!("worker-{number}");
            let child = self.spawn(&name, &self.worker_args(&name), Stdio::null())?;
            self.processes.push(Process::new(Role::Worker, name, child));
        }
        Ok(())
    }

    /// Notes that the learner has written the run file, which a restarted one leaves as it is.
    pub(crate) const fn run_file_is_written(&mut self) {
        self.awaits_run_file = false;
    }

    pub(crate) fn learner_address(&self) -> &str {
        &self.learner_address
    }

    /// Restarts processes that have ended.
    ///
    /// # Errors
    /// When a process has ended that must not be restarted.
    pub(crate) fn check(&mut self) -> Result<ProcessEvents, RunFailure> {
        let (plan, lock) = (self.plan, self.lock);
        let mut events = ProcessEvents::default();
        for idx in 0..self.processes.len() {
            let process = &mut self.processes[idx];
            if let State::Running(child) = &mut process.state
                && let Some(end) = child.try_wait()?
            {
                match process.handle_end(end, self.launcher.log(), &mut events) {
                    Err(_) if !lock.is_in_place() => {
                        return Err(displaced(plan, &process.name, end));
                    }
                    handled => handled?,
                }
            }
            if let State::Waiting { until, end, reason } = &process.state
                && *until <= clock::now()
            {
                if !lock.is_in_place() {
                    return Err(displaced(plan, &process.name, *end));
                }
                events.lines.push(format!("{} {end} and is restarted{reason}", process.name));
                events.learner_restarted |= process.role == Role::Learner;
                self.restart(idx)?;
            }
        }
        Ok(events)
    }

    /// Returns the largest sizes sampled so far.
    pub(crate) const fn peak_memory(&self) -> PeakMemory {
        self.peak
    }

    /// Samples the memory of the processes.
    pub(crate) fn sample_memory(&mut self) {
        for process in &self.processes {
            let State::Running(child) = &process.state else { continue };
            let peak = match process.role {
                Role::Teacher => &mut self.peak.teacher_mib,
                Role::Learner => &mut self.peak.learner_mib,
                Role::Worker => &mut self.peak.worker_mib,
            };
            let peak_kib = child.pid().map_or(0, |pid| ResidentMemory::of(pid).peak_kib);
            *peak = (peak_kib / 1024).max(*peak);
        }
    }

    /// Asks all processes to exit and waits for them. The learner, which saves its state, has until `deadline`. The
    /// teacher, which the learner may still call, ends after it. The leases of a round that was ordered in advance stay
    /// open. Returns true if the learner has saved its state.
    pub(crate) async fn end(&mut self, deadline: Duration) -> Saved {
        let mut learner = None;
        let mut teacher = None;
        let mut workers = JoinSet::new();
        let mut learner_end = None;
        for process in self.processes.drain(..) {
            let child = match process.state {
                State::Running(child) => child,
                State::Waiting { end, reason, .. } if process.role == Role::Learner => {
                    learner_end = Some(format!("the learner {end}{reason}"));
                    continue;
                }
                State::Waiting { .. } => continue,
            };
            match process.role {
                Role::Learner => learner = Some(child),
                Role::Teacher => teacher = Some(child),
                Role::Worker => drop(workers.spawn(child.end(GRACE))),
            }
        }
        let saved = match learner {
            Some(learner) => {
                let offset = learner.log_offset();
                match learner.end(deadline).await {
                    Some(ProcessEnd::Code(0 | 130)) => Saved::Yes,
                    Some(end) => {
                        let reason = self.launcher.log().last_error_since(offset);
                        Saved::Failed(format!("the learner {end}: {reason}"))
                    }
                    None => Saved::TooLate,
                }
            }
            None => learner_end.map_or(Saved::Yes, Saved::Failed),
        };
        if let Some(teacher) = teacher {
            teacher.end(GRACE).await;
        }
        workers.join_all().await;
        saved
    }

    /// Starts a service and returns its address. A service that a signal kills before it prints its address is
    /// restarted.
    async fn start_service(
        &mut self,
        role: Role,
        args: &[OsString],
        display: &Display,
    ) -> Result<String, RunFailure> {
        let mut policy = RestartPolicy::new(role);
        loop {
            let (name, child, end) = match self.try_start_service(role, args).await? {
                ServiceStart::Ready { process, addresses } => {
                    self.show_dashboard(&addresses, display);
                    self.processes.push(Process { policy, ..process });
                    return Ok(addresses.service);
                }
                ServiceStart::Ended { name, child, end } => (name, child, end),
            };
            let log = self.launcher.log();
            match (end, policy.decide(end, child.uptime())) {
                (ProcessEnd::Signal(_), Decision::Restart { after }) => {
                    display.print(&format!("{name} {end} and is restarted"));
                    tokio::time::sleep(after).await;
                }
                (ProcessEnd::Signal(_), Decision::GiveUp { n_times }) => {
                    return Err(given_up(&name, n_times, end, log, &child).into());
                }
                _ => {
                    let reason = log.last_error_since(child.log_offset());
                    let error = anyhow!("{name} {end}: {reason}");
                    return Err(RunFailure { exit: exit_code(end), error });
                }
            }
        }
    }

    /// Starts a service and waits until it prints its addresses or ends.
    async fn try_start_service(
        &self,
        role: Role,
        args: &[OsString],
    ) -> anyhow::Result<ServiceStart> {
        let name = format!("the {}", role.name());
        let mut child = self.spawn(&name, args, Stdio::piped())?;
        let has_dashboard = args.iter().any(|arg| arg == arguments::DASHBOARD);
        let addresses = child.addresses(has_dashboard).await;
        match addresses.with_context(|| format!("cannot read the address of {name}"))? {
            Some(addresses) => {
                Ok(ServiceStart::Ready { process: Process::new(role, name, child), addresses })
            }
            None => {
                let end = child.wait().await?.into();
                Ok(ServiceStart::Ended { name, child, end })
            }
        }
    }

    /// Restarts a process. A service gets its former address, so its clients find it again.
    fn restart(&mut self, idx: usize) -> anyhow::Result<()> {
        let plan = self.plan;
        let Process { role, name, .. } = &self.processes[idx];
        let teacher = self.teacher_address.as_deref();
        let (mut args, address) = match role {
            Role::Teacher => (arguments::teacher(plan), teacher),
            Role::Learner => {
                (arguments::learner(plan, teacher, true), Some(self.learner_address.as_str()))
            }
            Role::Worker => (self.worker_args(name), None),
        };
        arguments::push_address(&mut args, "--listen", address);
        if *role == Role::Learner {
            if self.awaits_run_file {
                args.push(arguments::KEEP_RUN_FILE.into());
            }
            arguments::push_dashboard(&mut args, plan, self.dashboard);
        }
        let child = self.spawn(name, &args, Stdio::null())?;
        self.processes[idx].state = State::Running(child);
        Ok(())
    }

    /// Prints the line about the dashboard, and keeps its address for the next start of the learner.
    fn show_dashboard(&mut self, addresses: &ServiceAddresses, display: &Display) {
        let Some(line) = &addresses.dashboard_line else { return };
        display.print(line);
        let port = dashboard::port_of(line);
        self.dashboard = self.dashboard_ip.zip(port).map(SocketAddr::from);
    }

    /// Returns the address of the dashboard as a link, if there is one.
    pub(crate) fn dashboard_url(&self) -> Option<String> {
        self.dashboard.map(dashboard::url)
    }

    fn worker_args(&self, name: &str) -> Vec<OsString> {
        arguments::worker(self.plan, name, &self.learner_address, self.teacher_address.as_deref())
    }

    fn spawn(&self, name: &str, args: &[OsString], stdout: Stdio) -> anyhow::Result<ChildProcess> {
        self.launcher.spawn(args, stdout).with_context(|| format!("cannot start {name}"))
    }
}

impl Process {
    const fn new(role: Role, name: String, child: ChildProcess) -> Self {
        Self { role, name, state: State::Running(child), policy: RestartPolicy::new(role) }
    }

    /// Decides what follows from the end of the process.
    fn handle_end(
        &mut self,
        end: ProcessEnd,
        log: &ProcessLog,
        events: &mut ProcessEvents,
    ) -> Result<(), RunFailure> {
        let State::Running(child) = &self.state else { return Ok(()) };
        let name = &self.name;
        match self.policy.decide(end, child.uptime()) {
            Decision::Restart { after } => {
                // A process that asks for another attempt has given up a peer or a resource.
                let reason = match end {
                    ProcessEnd::Code(75) => {
                        format!(": {}", log.last_error_since(child.log_offset()))
                    }
                    _ => String::new(),
                };
                self.state = State::Waiting { until: clock::now() + after, end, reason };
                Ok(())
            }
            Decision::Interrupted => {
                events.interrupted = true;
                Ok(())
            }
            Decision::Fail(exit) => {
                let reason = log.last_error_since(child.log_offset());
                Err(RunFailure { exit, error: anyhow!("{name} {end}: {reason}") })
            }
            Decision::GiveUp { n_times } => Err(given_up(name, n_times, end, log, child).into()),
        }
    }
}

/// The error about a process that is not restarted once more.
fn given_up(
    name: &str,
    n_times: u32,
    end: ProcessEnd,
    log: &ProcessLog,
    child: &ChildProcess,
) -> anyhow::Error {
    let error = anyhow!("{name} died {n_times} times in a row; the last time it {end}");
    match end {
        ProcessEnd::Code(_) => anyhow!("{error}: {}", log.last_error_since(child.log_offset())),
        ProcessEnd::Signal(_) => error,
    }
}

/// The error about a process that cannot be restarted because the run directory is no longer this run's.
fn displaced(plan: &Plan, name: &str, end: ProcessEnd) -> RunFailure {
    let out = plan.out.display();
    let error = anyhow!("{name} {end}, and {out} was moved, removed or replaced");
    RunFailure { exit: Exit::Usage, error }
}

/// Returns the exit code of a run whose service did not start.
const fn exit_code(end: ProcessEnd) -> Exit {
    match end {
        ProcessEnd::Code(64) => Exit::Usage,
        ProcessEnd::Code(65) => Exit::Data,
        ProcessEnd::Code(70) => Exit::Bug,
        _ => Exit::TryAgain,
    }
}
