//! `tandem bridge move`: executes the motion in a file.

use std::io::IsTerminal as _;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};
use serde_json::json;
use tandem_proto::pb;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status, Streaming};

use super::operator::{
    Client, acquire, call_with_timeout, failed, release, stop_arms, with_client,
};
use super::{file, show};
use crate::cli::MoveArgs;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{output, signals};

/// Time between two keep-alive messages; the bridge requires one every 100 ms.
const KEEP_ALIVE_EVERY: Duration = Duration::from_millis(40);
/// Timeout of the stream of reports, of which the bridge sends twenty per second.
const REPORT_TIMEOUT: Duration = Duration::from_secs(5);
/// Seconds between two plain lines.
const PLAIN_EVERY_S: f64 = 1.0;
/// The advice if the arms are not where a motion starts, for example after a joint has drifted.
const START_HINT: &str = " (without a bridge, `tandem bridge to-start` moves real arms to a start posture; simulated \
    arms are there after a restart of their bridge)";

pub(super) fn play(args: &MoveArgs) -> Result<(), Failed> {
    let motion = file::read(&args.file, args.speed)?;
    with_client(&args.connect, async |mut client: Client| {
        let accepted = check(&mut client, &motion, args.json).await?;
        if args.check_only {
            if args.json {
                output::print(json!({"accepted": show::accepted_json(&accepted)}))?;
            } else {
                output::print(format_args!("accepted: {}", accepted_line(&accepted)))?;
            }
            return Ok(());
        }
        let status = call_with_timeout(client.status(pb::BridgeStatusRequest {})).await?;
        if let Some(stop) = &status.stopped {
            return Err(stopped(stop));
        }
        let mut display = MotionDisplay::new(&accepted);
        display.print(&accepted_line(&accepted));
        let token = acquire(&mut client).await?;
        let name = args.file.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let done = execute(&mut client, &token, (name, motion), &mut display).await;
        release(&mut client, token).await;
        display.close();
        let last = done?;
        if args.json {
            output::print(json!({"done": true, "progress": show::progress_json(&last)}))?;
        } else {
            output::print("done")?;
        }
        Ok(())
    })
}

/// Checks the motion on the bridge, without moving anything.
async fn check(
    client: &mut Client,
    motion: &pb::MotionRequest,
    as_json: bool,
) -> Result<pb::AcceptedMotion, Failed> {
    use pb::check_response::Verdict;
    let request = pb::CheckRequest { motion: Some(motion.clone()) };
    match call_with_timeout(client.check(request)).await?.verdict {
        Some(Verdict::Accepted(accepted)) => Ok(accepted),
        Some(Verdict::Refused(refused)) => {
            if as_json {
                output::print(json!({"refused": show::refusal_json(&refused)}))?;
            }
            let hint = if refused.name == "start" { START_HINT } else { "" };
            let what = anyhow::anyhow!("the motion is refused: {}{hint}", refused.sentence);
            Err(Failed::new(Exit::Data, what))
        }
        None => Err(Failed::new(Exit::Bug, anyhow::anyhow!("the bridge sent no verdict"))),
    }
}

fn accepted_line(accepted: &pb::AcceptedMotion) -> String {
    let least_mm = |gaps_m: &[f64]| 1e3 * gaps_m.iter().copied().fold(f64::INFINITY, f64::min);
    let mut line = format!(
        "{:.1} s at speed {}; gaps: table {:.0} mm, arms {:.0} mm",
        accepted.duration_s / accepted.speed,
        accepted.speed,
        least_mm(&accepted.table_gap_m),
        1e3 * accepted.arms_gap_m
    );
    // A bridge of an earlier version does not report the gaps within an arm.
    if !accepted.self_gap_m.is_empty() {
        line.push_str(&format!(", within an arm {:.0} mm", least_mm(&accepted.self_gap_m)));
    }
    line
}

fn stopped(stop: &pb::BridgeStop) -> Failed {
    let sentence = &stop.sentence;
    let what = anyhow::anyhow!(
        "the arms are stopped: {sentence} (inspect them, then run `tandem bridge reset`)"
    );
    Failed::new(Exit::TryAgain, what)
}

/// Converts the error of a stream of reports. An error that the bridge has not sent is one of the connection.
fn stream_failed(status: &Status) -> Failed {
    if status.code() != Code::Unknown {
        return failed(status);
    }
    let what = anyhow::anyhow!(
        "the connection to the bridge broke: {} (this stops the arms; inspect them)",
        status.message()
    );
    Failed::new(Exit::TryAgain, what)
}

/// Executes the motion and returns the last report.
async fn execute(
    client: &mut Client,
    token: &str,
    (name, motion): (String, pb::MotionRequest),
    display: &mut MotionDisplay,
) -> Result<pb::MotionProgress, Failed> {
    let interrupted = signals::shutdown_token(false)?;
    let (sender, requests) = mpsc::channel(4);
    let start = pb::ExecuteStart { token: token.to_owned(), motion: Some(motion), name };
    let start = request(pb::execute_request::Request::Start(start));
    sender.try_send(start).or_exit(Exit::Bug, String::new)?;
    tokio::spawn(send_keep_alives(sender));
    let mut stopper = client.clone();
    let reports = tokio::select! {
        reports = client.execute(ReceiverStream::new(requests)) => {
            reports.map_err(|status| failed(&status))?.into_inner()
        }
        () = interrupted.cancelled() => return Err(interrupt(&mut stopper).await),
    };
    watch(reports, &interrupted, &mut stopper, display).await
}

async fn watch(
    mut reports: Streaming<pb::ExecuteResponse>,
    interrupted: &CancellationToken,
    client: &mut Client,
    display: &mut MotionDisplay,
) -> Result<pb::MotionProgress, Failed> {
    loop {
        let next = tokio::select! {
            next = tokio::time::timeout(REPORT_TIMEOUT, reports.message()) => next,
            () = interrupted.cancelled() => {
                display.close();
                return Err(interrupt(client).await);
            }
        };
        let Ok(next) = next else {
            display.close();
            return Err(stop_silent(client).await);
        };
        let Some(next) = next.map_err(|status| stream_failed(&status))? else {
            let what = anyhow::anyhow!("the bridge did not report how the motion ended");
            return Err(Failed::new(Exit::TryAgain, what));
        };
        let progress = next.progress.unwrap_or_default();
        match next.outcome.and_then(|outcome| outcome.outcome) {
            None => display.update(&progress),
            Some(pb::motion_outcome::Outcome::Done(_)) => return Ok(progress),
            Some(pb::motion_outcome::Outcome::Stopped(stop)) => return Err(stopped(&stop)),
        }
    }
}

/// Stops the arms and reports whether the bridge received the command.
async fn interrupt(client: &mut Client) -> Failed {
    match stop_arms(client).await {
        Ok(_) => output::message("tandem: interrupted: the arms are stopped"),
        Err(failed) => output::message(format_args!(
            "tandem: interrupted, and the arms could NOT be stopped, use the emergency stop: {:#}",
            failed.into_error()
        )),
    }
    Failed::new(Exit::Interrupted, anyhow::anyhow!("interrupted"))
}

/// Stops the arms of a bridge that sends no more reports, and returns what is known about them.
async fn stop_silent(client: &mut Client) -> Failed {
    let what = match stop_arms(client).await {
        Ok(_) => {
            "the bridge sent no more reports, and the arms were stopped: inspect them".to_owned()
        }
        Err(failed) => format!(
            "the bridge sends no more reports and does not confirm a stop, use the emergency stop: {:#}",
            failed.into_error()
        ),
    };
    Failed::new(Exit::TryAgain, anyhow::anyhow!(what))
}

/// Sends keep-alive messages until the stream is closed.
async fn send_keep_alives(sender: mpsc::Sender<pb::ExecuteRequest>) {
    let mut pace = tokio::time::interval(KEEP_ALIVE_EVERY);
    pace.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    while !sender.is_closed() {
        pace.tick().await;
        let alive = request(pb::execute_request::Request::Alive(pb::SignOfLife {}));
        // A message that does not fit into the queue is not needed: others are waiting.
        sender.try_send(alive).ok();
    }
}

fn request(request: pb::execute_request::Request) -> pb::ExecuteRequest {
    pb::ExecuteRequest { request: Some(request) }
}

/// The display of a motion: a bar on a terminal, plain lines elsewhere.
struct MotionDisplay {
    bar: Option<ProgressBar>,
    printed_s: f64,
    phase: pb::BridgePhase,
}

impl MotionDisplay {
    fn new(accepted: &pb::AcceptedMotion) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(millis(accepted.duration_s / accepted.speed));
            let style = ProgressStyle::with_template("[{bar:32}] {msg}");
            bar.with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
        });
        Self { bar, printed_s: f64::NEG_INFINITY, phase: pb::BridgePhase::Unspecified }
    }

    fn print(&self, line: &str) {
        match &self.bar {
            Some(bar) => bar.println(output::escaped(line)),
            None => output::message(line),
        }
    }

    fn update(&mut self, progress: &pb::MotionProgress) {
        let [played_s, duration_s] =
            show::clock_times_s([progress.played_s, progress.duration_s], progress.speed);
        let phase = show::phase(progress.phase());
        let line = format!("{phase} {played_s:.1} of {duration_s:.1} s");
        if let Some(bar) = &self.bar {
            bar.set_position(millis(played_s));
            bar.set_message(line);
        } else if progress.phase() != self.phase || played_s >= self.printed_s + PLAIN_EVERY_S {
            (self.phase, self.printed_s) = (progress.phase(), played_s);
            self.print(&line);
        }
    }

    fn close(&mut self) {
        if let Some(bar) = self.bar.take() {
            bar.finish_and_clear();
        }
    }
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a few minutes at most, for a progress bar"
)]
fn millis(seconds: f64) -> u64 {
    (1e3 * seconds) as u64
}
