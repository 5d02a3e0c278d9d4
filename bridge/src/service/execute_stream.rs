//! The stream of a motion: receives signs of life and sends progress.

use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use tandem_proto::{DecodeError, pb};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming};

use crate::executor::Token;
use crate::service::BridgeService;
use crate::service::error::Error;
use crate::service::execution::{AbandonOnDrop, Execution, Outcome};
use crate::service::messages::{self, decode_token};
use crate::service::snapshot::{MotionInfo, Snapshot};
use crate::service::thread::ArmsHandle;

/// The longest time until a client sends its start message.
const START_TIMEOUT: Duration = Duration::from_secs(10);
/// Time between two reports, seconds.
const REPORT_S: f64 = 0.05;
/// The largest number of characters of a motion's name.
const MAX_NAME_CHARS: usize = 80;
/// Reports that may wait for a client. Further ones are dropped.
const REPORT_CAPACITY: usize = 4;

type Requests = Streaming<pb::ExecuteRequest>;
type Responses = mpsc::Sender<Result<pb::ExecuteResponse, Status>>;

/// Starts the motion in the first of `requests`. Returns the stream of its progress.
pub(super) async fn begin(
    service: &BridgeService,
    mut requests: Requests,
    client: String,
) -> Result<ReceiverStream<Result<pb::ExecuteResponse, Status>>, Error> {
    let start = receive_start(&mut requests).await?;
    let token = decode_token("start.token", &start.token)?;
    let spec = service.decode("start.motion", start.motion)?;
    let speed = service.limited_speed(spec.speed);
    renew(&service.arms, token).await?;
    let checking = service.check_motion(spec, |checked| checked);
    let checked = while_alive(&service.arms, &mut requests, token, checking).await??;
    let duration_s = checked.motion().duration_s();
    let name: String = start.name.chars().take(MAX_NAME_CHARS).collect();
    let motion = MotionInfo { name, client, speed, duration_s };
    let execution = Arc::new(Execution::new(token, motion));
    let (guard, motion) = (AbandonOnDrop(Arc::clone(&execution)), Arc::clone(&execution.motion));
    let arms = service.arms.clone();
    arms.run(move |arms, now_s| arms.start(&execution, checked, now_s)).await?;
    let MotionInfo { name, client, .. } = &*motion;
    tracing::info!(name, client, duration_s, speed, "motion started");
    let (responses, reports) = mpsc::channel(REPORT_CAPACITY);
    tokio::spawn(run_stream(guard, duration_s, requests, arms, responses));
    Ok(ReceiverStream::new(reports))
}

/// Receives the first request, which must be the start message.
async fn receive_start(requests: &mut Requests) -> Result<pb::ExecuteStart, Error> {
    let first = tokio::time::timeout(START_TIMEOUT, requests.message()).await;
    match first {
        Ok(Ok(Some(pb::ExecuteRequest {
            request: Some(pb::execute_request::Request::Start(start)),
        }))) => Ok(start),
        Ok(Ok(Some(_))) => Err(DecodeError::new("start", "a message", "none").into()),
        Ok(Err(status)) => Err(Error::StreamBroken(status)),
        Ok(Ok(None)) | Err(_) => Err(Error::StreamEnded),
    }
}

async fn renew(arms: &ArmsHandle, token: Token) -> Result<(), Error> {
    arms.run(move |arms, now_s| arms.executor.renew(token, now_s)).await
}

/// Runs `work` to its end as long as the client's stream is alive.
async fn while_alive<T>(
    arms: &ArmsHandle,
    requests: &mut Requests,
    token: Token,
    work: impl Future<Output = T>,
) -> Result<T, Error> {
    tokio::pin!(work);
    loop {
        tokio::select! {
            done = &mut work => return Ok(done),
            request = requests.message() => {
                match request {
                    Ok(Some(request)) if is_sign_of_life(&request) => {}
                    Ok(Some(_)) => {
                        return Err(DecodeError::new("alive", "a message", "another one").into());
                    }
                    Ok(None) => return Err(Error::StreamEnded),
                    Err(status) => return Err(Error::StreamBroken(status)),
                }
                renew(arms, token).await?;
            }
        }
    }
}

fn is_sign_of_life(request: &pb::ExecuteRequest) -> bool {
    matches!(request.request, Some(pb::execute_request::Request::Alive(_)))
}

/// Forwards signs of life and reports progress until the end of the motion. A stream that ends, breaks or contains
/// anything but signs of life abandons the motion; the outcome is still sent if possible.
async fn run_stream(
    guard: AbandonOnDrop,
    duration_s: f64,
    mut requests: Requests,
    arms: ArmsHandle,
    responses: Responses,
) {
    let execution = &guard.0;
    let mut reporter = ProgressReporter::new(duration_s, execution.motion.speed);
    let mut snapshots = arms.watch();
    loop {
        tokio::select! {
            request = requests.message(), if !execution.is_abandoned() => {
                match request {
                    Ok(Some(request)) if is_sign_of_life(&request) => execution.mark_alive(),
                    _ => execution.abandon(),
                }
            }
            () = responses.closed() => return,
            changed = snapshots.changed() => {
                if changed.is_err() {
                    drop(responses.send(Err(Error::ShuttingDown.into())).await);
                    return;
                }
                let newest = Arc::clone(&snapshots.borrow_and_update());
                let progress = reporter.update(&newest, &arms);
                if let Some(outcome) = execution.outcome() {
                    drop(responses.send(Ok(reporter.last(&newest, &arms, outcome))).await);
                    return;
                }
                if let Some(progress) = progress {
                    // A client that reads slowly misses some reports.
                    responses.try_send(Ok(progress)).ok();
                }
            }
        }
    }
}

/// Builds the reports of one motion.
struct ProgressReporter {
    played_s: f64,
    duration_s: f64,
    speed: f64,
    reported_s: f64,
    phase: pb::BridgePhase,
}

impl ProgressReporter {
    fn new(duration_s: f64, speed: f64) -> Self {
        let (played_s, reported_s) = (0.0, f64::NEG_INFINITY);
        Self { played_s, duration_s, speed, reported_s, phase: pb::BridgePhase::Unspecified }
    }

    /// Returns a report of `newest` if one is due.
    fn update(&mut self, newest: &Snapshot, arms: &ArmsHandle) -> Option<pb::ExecuteResponse> {
        let progress = newest.progress?;
        self.played_s = progress.played_s;
        let phase = messages::phase(newest.phase);
        if phase == self.phase && newest.now_s - self.reported_s < REPORT_S {
            return None;
        }
        (self.reported_s, self.phase) = (newest.now_s, phase);
        Some(pb::ExecuteResponse { progress: Some(self.progress(newest, arms)), outcome: None })
    }

    /// Returns the last report, with the outcome.
    fn last(
        &mut self,
        newest: &Snapshot,
        arms: &ArmsHandle,
        outcome: &Outcome,
    ) -> pb::ExecuteResponse {
        match outcome {
            Outcome::Done => {
                self.played_s = self.duration_s;
                tracing::info!("motion done");
            }
            Outcome::Stopped(stop) => tracing::info!(%stop, "motion stopped"),
        }
        pb::ExecuteResponse {
            progress: Some(self.progress(newest, arms)),
            outcome: Some(messages::outcome(outcome)),
        }
    }

    fn progress(&self, newest: &Snapshot, arms: &ArmsHandle) -> pb::MotionProgress {
        pb::MotionProgress {
            phase: messages::phase(newest.phase).into(),
            played_s: self.played_s,
            duration_s: self.duration_s,
            speed: self.speed,
            arms: messages::arms(newest, arms.checker.cell()),
        }
    }
}
