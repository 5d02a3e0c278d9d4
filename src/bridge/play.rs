//! `tandem bridge move`: a motion from a file, watched to its end.

use std::io::IsTerminal as _;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};
use serde_json::json;
use tandem_proto::pb;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status, Streaming};

use super::operator::{Client, acquire, answer, failed, release, with_client};
use super::{file, show};
use crate::cli::MoveArgs;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{output, signals};

/// Time from one sign of life to the next: the bridge wants one every 100 ms.
const SIGN: Duration = Duration::from_millis(40);
/// The bridge reports twenty times a second; whoever hears nothing for this long gives up.
const SILENCE: Duration = Duration::from_secs(5);
/// Seconds of a motion's own time between two plain lines.
const PLAIN_EVERY_S: f64 = 1.0;

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
        let status = answer(client.status(pb::BridgeStatusRequest {})).await?;
        if let Some(stop) = &status.stopped {
            return Err(stopped(stop));
        }
        let mut watched = Watched::new(&accepted);
        watched.say(&accepted_line(&accepted));
        let token = acquire(&mut client).await?;
        let done = execute(&mut client, &token, motion, &mut watched).await;
        release(&mut client, token).await;
        watched.close();
        let last = done?;
        if args.json {
            output::print(json!({"done": true, "progress": show::progress_json(&last)}))?;
        } else {
            output::print("done")?;
        }
        Ok(())
    })
}

/// The motion as the bridge accepts it.
async fn check(
    client: &mut Client,
    motion: &pb::MotionRequest,
    as_json: bool,
) -> Result<pb::AcceptedMotion, Failed> {
    use pb::check_response::Verdict;
    let request = pb::CheckRequest { motion: Some(motion.clone()) };
    match answer(client.check(request)).await?.verdict {
        Some(Verdict::Accepted(accepted)) => Ok(accepted),
        Some(Verdict::Refused(refused)) => {
            if as_json {
                output::print(json!({"refused": show::refusal_json(&refused)}))?;
            }
            let what = anyhow::anyhow!("the motion is refused: {}", refused.sentence);
            Err(Failed::new(Exit::Data, what))
        }
        None => Err(Failed::new(Exit::Bug, anyhow::anyhow!("the bridge has judged nothing"))),
    }
}

fn accepted_line(accepted: &pb::AcceptedMotion) -> String {
    let least_mm = |gaps_m: &[f64]| 1e3 * gaps_m.iter().copied().fold(f64::INFINITY, f64::min);
    let mut line = format!(
        "{:.1} s at speed {}, at least {:.0} mm above the table, {:.0} mm between the arms",
        accepted.duration_s / accepted.speed,
        accepted.speed,
        least_mm(&accepted.table_gap_m),
        1e3 * accepted.arms_gap_m
    );
    // A bridge of an earlier version does not report the gaps within an arm.
    if !accepted.self_gap_m.is_empty() {
        line.push_str(&format!(", {:.0} mm within an arm", least_mm(&accepted.self_gap_m)));
    }
    line
}

fn stopped(stop: &pb::BridgeStop) -> Failed {
    let sentence = &stop.sentence;
    let what = anyhow::anyhow!(
        "the arms are stopped: {sentence} (look at them, then `tandem bridge reset`)"
    );
    Failed::new(Exit::TryAgain, what)
}

/// What a person is told when the stream of a motion ends with an error. One that the bridge has not sent is the connection's.
fn broken(status: &Status) -> Failed {
    if status.code() != Code::Unknown {
        return failed(status);
    }
    let what = anyhow::anyhow!(
        "the connection to the bridge broke: {} (the arms are stopped by that; look at them)",
        status.message()
    );
    Failed::new(Exit::TryAgain, what)
}

/// Plays the motion; gives where it has led.
async fn execute(
    client: &mut Client,
    token: &str,
    motion: pb::MotionRequest,
    watched: &mut Watched,
) -> Result<pb::MotionProgress, Failed> {
    let interrupted = signals::shutdown_token(false)
        .or_exit(Exit::TryAgain, || "cannot watch for signals".to_owned())?;
    let (signs, requests) = mpsc::channel(4);
    let start = pb::ExecuteStart { token: token.to_owned(), motion: Some(motion) };
    let start = request(pb::execute_request::Request::Start(start));
    signs.try_send(start).or_exit(Exit::Bug, String::new)?;
    tokio::spawn(give_signs(signs));
    let mut stopper = client.clone();
    let told = tokio::select! {
        told = client.execute(ReceiverStream::new(requests)) => {
            told.map_err(|status| failed(&status))?.into_inner()
        }
        () = interrupted.cancelled() => return Err(interrupt(&mut stopper).await),
    };
    watch(told, &interrupted, &mut stopper, watched).await
}

async fn watch(
    mut told: Streaming<pb::ExecuteResponse>,
    interrupted: &CancellationToken,
    client: &mut Client,
    watched: &mut Watched,
) -> Result<pb::MotionProgress, Failed> {
    loop {
        let next = tokio::select! {
            next = tokio::time::timeout(SILENCE, told.message()) => next,
            () = interrupted.cancelled() => {
                watched.close();
                return Err(interrupt(client).await);
            }
        };
        let next = next.or_exit(Exit::TryAgain, || "the bridge says nothing more".to_owned())?;
        let Some(next) = next.map_err(|status| broken(&status))? else {
            let what = anyhow::anyhow!("the bridge has not said how the motion ended");
            return Err(Failed::new(Exit::TryAgain, what));
        };
        let progress = next.progress.unwrap_or_default();
        match next.outcome.and_then(|outcome| outcome.outcome) {
            None => watched.look(&progress),
            Some(pb::motion_outcome::Outcome::Done(_)) => return Ok(progress),
            Some(pb::motion_outcome::Outcome::Stopped(stop)) => return Err(stopped(&stop)),
        }
    }
}

/// Stops the arms and says whether that was heard.
async fn interrupt(client: &mut Client) -> Failed {
    match answer(client.stop(pb::StopRequest {})).await {
        Ok(_) => output::message("tandem: interrupted: the arms are stopped"),
        Err(failed) => output::message(format_args!(
            "tandem: interrupted, and the arms could NOT be stopped, use the emergency stop: {:#}",
            failed.into_error()
        )),
    }
    Failed::new(Exit::Interrupted, anyhow::anyhow!("interrupted"))
}

/// Lets the bridge hear of us until nobody listens any more.
async fn give_signs(signs: mpsc::Sender<pb::ExecuteRequest>) {
    let mut pace = tokio::time::interval(SIGN);
    pace.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    while !signs.is_closed() {
        pace.tick().await;
        let alive = request(pb::execute_request::Request::Alive(pb::SignOfLife {}));
        // A sign that finds no room is not needed: others wait.
        signs.try_send(alive).ok();
    }
}

fn request(request: pb::execute_request::Request) -> pb::ExecuteRequest {
    pb::ExecuteRequest { request: Some(request) }
}

/// What a person sees: a bar on a terminal, plain lines elsewhere.
struct Watched {
    bar: Option<ProgressBar>,
    told_s: f64,
    phase: pb::BridgePhase,
}

impl Watched {
    fn new(accepted: &pb::AcceptedMotion) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(millis(accepted.duration_s));
            let style = ProgressStyle::with_template("[{bar:32}] {msg}");
            bar.with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
        });
        Self { bar, told_s: f64::NEG_INFINITY, phase: pb::BridgePhase::Unspecified }
    }

    fn say(&self, line: &str) {
        match &self.bar {
            Some(bar) => bar.println(output::escaped(line)),
            None => output::message(line),
        }
    }

    fn look(&mut self, progress: &pb::MotionProgress) {
        let line = format!(
            "{} {:.1} of {:.1} s",
            show::phase(progress.phase()),
            progress.played_s,
            progress.duration_s
        );
        if let Some(bar) = &self.bar {
            bar.set_position(millis(progress.played_s));
            bar.set_message(line);
        } else if progress.phase() != self.phase || progress.played_s >= self.told_s + PLAIN_EVERY_S
        {
            (self.phase, self.told_s) = (progress.phase(), progress.played_s);
            self.say(&line);
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
    reason = "minutes at most, and a bar only"
)]
fn millis(seconds: f64) -> u64 {
    (1e3 * seconds) as u64
}
