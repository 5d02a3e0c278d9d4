//! `tandem train`: starts a learner, a teacher and workers as processes, supervises them and reports the result.

mod arguments;
mod inputs;
mod plan;
mod policy_server;
mod processes;
mod progress_stream;
mod restart_policy;
mod resume_command;
pub(crate) mod run_lock;
mod summary;
pub(crate) mod teacher_file;

use std::time::{Duration, Instant};

use anyhow::anyhow;
use tandem_core::text::counted;
use tandem_learner::INTERRUPTED;
use tandem_proto::pb;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use crate::cli::{RecordedName, TrainArgs};
use crate::columns::wrapped;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::live::LiveRun;
use crate::progress_json::progress_json;
use crate::run_display::Display;
use crate::{
    clock, environment_file, environment_server, metrics, output, run_directory, runtime,
    served_task, settings_page, signals,
};
use inputs::RunInputs;
use plan::Plan;
use processes::{PeakMemory, RunFailure, RunProcesses, Saved};
use progress_stream::ProgressUpdate;
use resume_command::resume_command;
use run_lock::RunLock;

/// Timeout of the start of all processes.
const START_TIMEOUT: Duration = Duration::from_secs(60);
/// Time that the learner has to finish the updates of a round, save and exit.
const END_TIMEOUT: Duration = Duration::from_mins(10);
/// Message if the learner exceeds this timeout.
const NOT_SAVED: &str = "the learner did not save within 10 minutes and was killed: a resumed run continues from \
                         its last checkpoint";
/// Time between two checks of the processes.
const CHECK_EVERY: Duration = Duration::from_millis(100);
/// Time between two samples of their memory.
const SAMPLE_EVERY: Duration = Duration::from_millis(500);

pub(crate) fn train(args: &TrainArgs) -> Result<(), Failed> {
    if args.list_settings {
        return settings_page::print(args.json);
    }
    if args.live.live.is_some() && args.recording.record == RecordedName::None {
        return Err(Failed::usage(
            "--live shows recorded episodes: choose --record evaluation or --record all",
        ));
    }
    let environment = environment_file::environment_of(args)?;
    let served = served_task::of_server(&environment)?;
    if args.print_run {
        return plan::print_run_file(args, served.as_ref());
    }
    // An address in use is reported before anything is written.
    let metrics = metrics::free_address(&args.metrics)?;
    let plan = Plan { metrics, ..Plan::of(args, environment, served.as_ref())? };
    let live = args.live.live.map(|address| LiveRun::start(address, plan.logs())).transpose()?;
    let lock = RunLock::take(&plan)?;
    let service_locks = lock.wait_for_leftovers(&plan)?;
    let former_round = run_directory::saved_round(&plan.out);
    plan.prepare()?;
    let inputs = RunInputs::write(&plan, &lock)?;
    drop(service_locks);
    let runtime = runtime::new().or_exit(Exit::TryAgain, String::new)?;
    let (last, memory) = runtime.block_on(async {
        let interrupted = signals::shutdown_token(args.exit_with_stdin)?;
        run((&plan, &lock), &interrupted, args).await
    })?;
    drop((inputs, live));
    if last.end_reason == INTERRUPTED && !lock.is_in_place() {
        let out = plan.out.display();
        return Err(Failed::new(
            Exit::TryAgain,
            anyhow!(
                "interrupted, and {out} was moved, removed or replaced: resume the run at its new path"
            ),
        ));
    }
    if last.end_reason == INTERRUPTED {
        summary::print_interrupted(&plan, args);
        return Err(Failed::new(Exit::Interrupted, anyhow!(INTERRUPTED)));
    }
    if former_round == Some(last.round) {
        output::message(format_args!(
            "nothing was trained: {}; a larger --max-env-steps, --max-minutes or --until-success continues the run, 0 \
             removes a limit",
            last.end_reason
        ));
    }
    summary::print(&plan, &last, memory, args)
}

/// Starts all processes, supervises them until the run has ended, and ends them.
async fn run(
    (plan, lock): (&Plan, &RunLock),
    interrupted: &CancellationToken,
    args: &TrainArgs,
) -> Result<(pb::Progress, PeakMemory), Failed> {
    let mut display = Display::new(args.quiet);
    announce(plan, &display);
    let mut processes = RunProcesses::new((plan, lock)).or_cannot_write(String::new)?;
    let started = tokio::select! {
        started = start(&mut processes, &display) => started,
        () = interrupted.cancelled() => Ok(()),
    };
    let last = match started {
        Ok(()) => {
            // Without the address, `tandem status` needs it from its user; the run continues.
            if let Err(failed) =
                inputs::write_learner_address(&plan.out, processes.learner_address())
            {
                display.print(&failed.line());
            }
            let mut supervisor = Supervisor::new(plan, &mut processes, &mut display);
            supervisor.prints_json = args.progress_json;
            supervisor.run(interrupted).await
        }
        Err(failure) => Err(failure),
    };
    display.close();
    if interrupted.is_cancelled() {
        display.print("interrupted: saving, a second Ctrl-C ends at once");
    }
    let saved = tokio::select! {
        saved = processes.end(END_TIMEOUT) => saved,
        interrupted_again = signals::second_shutdown() => interrupted_again.map(|()| Saved::Yes)?,
    };
    if saved == Saved::TooLate {
        display.print(NOT_SAVED);
    }
    let last = last.map_err(|RunFailure { exit, error }| {
        Failed::new(exit, error.context(failure_context((plan, args), exit)))
    })?;
    if interrupted.is_cancelled()
        && let Saved::Failed(why) = saved
    {
        let exit = Exit::TryAgain;
        return Err(Failed::new(exit, anyhow!(why)).context(failure_context((plan, args), exit)));
    }
    if last.ended && !interrupted.is_cancelled() {
        return Ok((last, processes.peak_memory()));
    }
    let last = pb::Progress { end_reason: INTERRUPTED.to_owned(), ..last };
    Ok((last, processes.peak_memory()))
}

/// Prints what is trained, and where its files are.
fn announce(plan: &Plan, display: &Display) {
    let config = &plan.config;
    let (arms, workers) = (counted(config.arms, "arm"), counted(plan.n_workers, "worker"));
    let (task, strategy, seed) = (&config.task, &config.advice.strategy, config.seed);
    display.print(&wrapped(
        &format!("training {task} with {arms}, strategy {strategy}, seed {seed}, {workers}"),
        "  ",
    ));
    display.print(&format!("run directory {}", plan.out.display()));
    if let Some(address) = plan.metrics {
        display.print(&format!("Prometheus metrics on http://{address}/metrics"));
    }
    if let Some(server) = environment_server::shown(&plan.environment) {
        display.print(&format!("environments of {server}"));
    }
}

/// Starts all processes in time.
async fn start(processes: &mut RunProcesses<'_>, display: &Display) -> Result<(), RunFailure> {
    let started = tokio::time::timeout(START_TIMEOUT, processes.start(display)).await;
    started.unwrap_or_else(|_elapsed| {
        Err(anyhow!("a process did not print its address within {START_TIMEOUT:?}").into())
    })
}

/// Describes how to resume the run, if that can help, and which log to read.
fn failure_context((plan, args): (&Plan, &TrainArgs), exit: Exit) -> String {
    let log = plan.log_path();
    let log = log.display();
    match exit {
        Exit::TryAgain => {
            let command = resume_command(&plan.out, args);
            format!("the run was interrupted, resume it with `{command}`; see {log}")
        }
        _ => format!("the run cannot continue; see {log}"),
    }
}

/// Supervises a run: displays its progress and restarts its processes.
struct Supervisor<'a, 'run> {
    plan: &'a Plan,
    processes: &'a mut RunProcesses<'run>,
    display: &'a mut Display,
    last: pb::Progress,
    /// The stream that delivered the latest message.
    stream: u32,
    /// The learner was restarted and has not sent a message since.
    awaits_learner: bool,
    started_at: Instant,
    /// Seconds that the run had taken before this start, once a message has reported them.
    earlier_wall_s: Option<f64>,
    /// True if every message is printed as JSON.
    prints_json: bool,
}

impl<'a, 'run> Supervisor<'a, 'run> {
    fn new(
        plan: &'a Plan,
        processes: &'a mut RunProcesses<'run>,
        display: &'a mut Display,
    ) -> Self {
        Self {
            plan,
            processes,
            display,
            last: pb::Progress::default(),
            stream: 0,
            awaits_learner: false,
            started_at: clock::now(),
            earlier_wall_s: None,
            prints_json: false,
        }
    }

    /// Follows the learner's progress until the run ends or is interrupted, and returns the last message.
    async fn run(mut self, interrupted: &CancellationToken) -> Result<pb::Progress, RunFailure> {
        if interrupted.is_cancelled() {
            return Ok(self.last);
        }
        let mut updates: mpsc::Receiver<ProgressUpdate> =
            progress_stream::follow(self.processes.learner_address())?;
        let mut check = tokio::time::interval(CHECK_EVERY);
        let mut sample = tokio::time::interval(SAMPLE_EVERY);
        loop {
            tokio::select! {
                Some(update) = updates.recv() => {
                    self.handle_update(update);
                    if self.last.ended {
                        return Ok(self.last);
                    }
                }
                _ = check.tick() => {
                    if self.check_processes()? {
                        return Ok(self.last);
                    }
                }
                _ = sample.tick() => self.processes.sample_memory(),
                () = interrupted.cancelled() => return Ok(self.last),
            }
        }
    }

    /// Displays a message. Messages of a learner that is starting, or that ends with an error, are ignored: the exit
    /// code of the process determines what follows.
    fn handle_update(&mut self, ProgressUpdate { stream, progress }: ProgressUpdate) {
        let is_new_stream = stream != self.stream;
        if progress.task.is_empty() || (progress.ended && progress.digest.is_empty()) {
            return;
        }
        if is_new_stream {
            self.stream = stream;
            self.display.begin_stream();
        }
        if self.last.task.is_empty() {
            // The learner has loaded its checkpoint, so the run continues.
            self.processes.run_file_is_written();
            let removed = summary::remove(&self.plan.out);
            for kept in [removed, self.plan.keep_teacher(), self.plan.keep_environment()] {
                if let Err(failed) = kept {
                    self.display.print(&format!("{:#}", failed.into_error()));
                }
            }
        }
        if self.awaits_learner && is_new_stream {
            self.awaits_learner = false;
            let round = progress.resumed_from_round;
            self.display.print(&format!("the learner continues from round {round}"));
        }
        // A restarted learner knows neither the time since its last checkpoint nor the time until its restart.
        let elapsed_s = self.started_at.elapsed().as_secs_f64();
        let earlier_s = *self.earlier_wall_s.get_or_insert((progress.wall_s - elapsed_s).max(0.0));
        self.last = pb::Progress { wall_s: earlier_s + elapsed_s, ..progress };
        self.display.show(&self.last);
        if self.prints_json {
            self.print_json();
        }
    }

    /// Prints the latest message as one line. An error is ignored: the reader may have exited, and the run continues.
    fn print_json(&self) {
        let mut message = progress_json(&self.last);
        message["dashboard"] = self.processes.dashboard_url().into();
        drop(output::print(message));
    }

    /// Restarts processes that have ended. Returns true if the learner was interrupted.
    fn check_processes(&mut self) -> Result<bool, RunFailure> {
        let events = self.processes.check()?;
        events.lines.iter().for_each(|line| self.display.print(line));
        self.awaits_learner |= events.learner_restarted;
        Ok(events.interrupted)
    }
}
