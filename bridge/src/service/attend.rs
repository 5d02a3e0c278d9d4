//! The stream of a motion: signs of life come in, progress goes out.

use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use tandem_proto::{DecodeError, pb};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming};

use crate::executor::Token;
use crate::service::BridgeService;
use crate::service::error::{Error, status};
use crate::service::execution::{Attended, Execution, Outcome};
use crate::service::messages::{self, decode_token};
use crate::service::thread::{ArmsHandle, Snapshot};

/// How long a client may take to say what it wants.
const GREETING: Duration = Duration::from_secs(10);
/// Time from one report to the next, seconds.
const REPORT_S: f64 = 0.05;
/// Reports that wait for a client; further ones are left out.
const REPORTS: usize = 4;

type Requests = Streaming<pb::ExecuteRequest>;
type Told = mpsc::Sender<Result<pb::ExecuteResponse, Status>>;

/// Starts what the first of `requests` asks for; gives what is told of it until its end.
pub(super) async fn begin(
    service: &BridgeService,
    mut requests: Requests,
) -> Result<ReceiverStream<Result<pb::ExecuteResponse, Status>>, Error> {
    let start = first(&mut requests).await?;
    let token = decode_token("start.token", &start.token)?;
    let wanted = service.decode("start.motion", start.motion)?;
    let speed = service.bounded(wanted.speed);
    let execution = Arc::new(Execution::new(token, speed));
    let attended = Attended(Arc::clone(&execution));
    renew(&service.arms, token).await?;
    let checking = service.check_motion(wanted, |checked| checked);
    let checked = while_heard(&service.arms, &mut requests, token, checking).await??;
    let duration_s = checked.motion().duration_s();
    let arms = service.arms.clone();
    arms.run(move |arms, now_s| arms.start(&execution, checked, now_s)).await?;
    tracing::info!(duration_s, speed, "a motion begins");
    let (told, reports) = mpsc::channel(REPORTS);
    tokio::spawn(attend(attended, duration_s, requests, arms, told));
    Ok(ReceiverStream::new(reports))
}

/// The first request, which has to say what is wanted.
async fn first(requests: &mut Requests) -> Result<pb::ExecuteStart, Error> {
    let first = tokio::time::timeout(GREETING, requests.message()).await;
    match first {
        Ok(Ok(Some(pb::ExecuteRequest {
            request: Some(pb::execute_request::Request::Start(start)),
        }))) => Ok(start),
        Ok(Ok(Some(_))) => Err(DecodeError::new("start", "a message", "none").into()),
        Ok(Err(status)) => Err(Error::Broken(status)),
        Ok(Ok(None)) | Err(_) => Err(Error::Left),
    }
}

async fn renew(arms: &ArmsHandle, token: Token) -> Result<(), Error> {
    arms.run(move |arms, now_s| arms.executor.renew(token, now_s)).await
}

/// What `work` gives, while the client is heard of.
async fn while_heard<T>(
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
                if !is_alive(request) {
                    return Err(Error::Left);
                }
                renew(arms, token).await?;
            }
        }
    }
}

/// Whether what came is a sign of life.
fn is_alive(request: Result<Option<pb::ExecuteRequest>, Status>) -> bool {
    let request = request.ok().flatten().and_then(|request| request.request);
    matches!(request, Some(pb::execute_request::Request::Alive(_)))
}

/// Hears the client and tells it how the motion goes on, until its end. The client has left when its stream ends, breaks
/// or brings anything but signs of life; the outcome is told all the same where it can be.
async fn attend(
    attended: Attended,
    duration_s: f64,
    mut requests: Requests,
    arms: ArmsHandle,
    told: Told,
) {
    let execution = &attended.0;
    let mut report = Report::new(duration_s, execution.speed);
    let mut snapshots = arms.watch();
    loop {
        tokio::select! {
            request = requests.message(), if !execution.is_left() => {
                if is_alive(request) { execution.hear() } else { execution.leave() }
            }
            () = told.closed() => return,
            changed = snapshots.changed() => {
                if changed.is_err() {
                    drop(told.send(Err(status(&Error::Ended))).await);
                    return;
                }
                let newest = Arc::clone(&snapshots.borrow_and_update());
                let progress = report.look(&newest, &arms);
                if let Some(outcome) = execution.outcome() {
                    drop(told.send(Ok(report.last(&newest, &arms, outcome))).await);
                    return;
                }
                if let Some(progress) = progress {
                    // A client that is slow to read misses some.
                    told.try_send(Ok(progress)).ok();
                }
            }
        }
    }
}

/// What was told of a motion, and when.
struct Report {
    played_s: f64,
    duration_s: f64,
    speed: f64,
    told_s: f64,
    phase: pb::BridgePhase,
}

impl Report {
    fn new(duration_s: f64, speed: f64) -> Self {
        let (played_s, told_s) = (0.0, f64::NEG_INFINITY);
        Self { played_s, duration_s, speed, told_s, phase: pb::BridgePhase::Unspecified }
    }

    /// What to tell of `newest`, when it is time.
    fn look(&mut self, newest: &Snapshot, arms: &ArmsHandle) -> Option<pb::ExecuteResponse> {
        let progress = newest.progress?;
        self.played_s = progress.played_s;
        let phase = messages::phase(newest.phase);
        if phase == self.phase && newest.now_s - self.told_s < REPORT_S {
            return None;
        }
        (self.told_s, self.phase) = (newest.now_s, phase);
        Some(pb::ExecuteResponse { progress: Some(self.progress(newest, arms)), outcome: None })
    }

    /// What to tell at the end.
    fn last(
        &mut self,
        newest: &Snapshot,
        arms: &ArmsHandle,
        outcome: &Outcome,
    ) -> pb::ExecuteResponse {
        match outcome {
            Outcome::Done => {
                self.played_s = self.duration_s;
                tracing::info!("the motion is done");
            }
            Outcome::Stopped(stop) => tracing::info!(%stop, "the motion was stopped"),
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
