//! The learner's progress, followed across its restarts.

use std::time::Duration;

use anyhow::Context as _;
use tandem_net::{AuthChannel, ClientConfig, within};
use tandem_proto::pb;
use tandem_proto::pb::learner_client::LearnerClient;
use tokio::sync::mpsc;
use tonic::{Status, Streaming};

/// Timeout of opening a stream of progress.
const OPEN_DEADLINE: Duration = Duration::from_secs(5);
/// Pause before an unreachable learner is called again.
const PAUSE: Duration = Duration::from_millis(200);
/// Capacity of the queue of messages. While it is full, the learner skips messages: only the latest one matters.
const CAPACITY: usize = 1;

/// A message about the run.
pub(super) struct ProgressUpdate {
    /// Number of the stream that delivered the message. A new stream may come from a new process.
    pub(super) stream: u32,
    pub(super) progress: pb::Progress,
}

/// Follows the learner at `address` until the receiver is dropped, and reconnects while the learner is unreachable.
pub(super) fn follow(address: &str) -> anyhow::Result<mpsc::Receiver<ProgressUpdate>> {
    let link = ClientConfig::default().channel(address).context("cannot follow the learner")?;
    let (sender, receiver) = mpsc::channel(CAPACITY);
    tokio::spawn(async move {
        tokio::select! {
            () = follow_streams(LearnerClient::new(link), &sender) => (),
            () = sender.closed() => (),
        }
    });
    Ok(receiver)
}

async fn follow_streams(
    mut learner: LearnerClient<AuthChannel>,
    sender: &mpsc::Sender<ProgressUpdate>,
) {
    for stream_idx in 0.. {
        // The reason for the end of a stream does not matter: `RunProcesses` checks whether the learner runs.
        if let Ok(mut stream) = open(&mut learner).await {
            while let Ok(Some(progress)) = stream.message().await {
                if sender.send(ProgressUpdate { stream: stream_idx, progress }).await.is_err() {
                    return;
                }
            }
        }
        tokio::time::sleep(PAUSE).await;
    }
}

async fn open(learner: &mut LearnerClient<AuthChannel>) -> Result<Streaming<pb::Progress>, Status> {
    let opened = within(OPEN_DEADLINE, learner.watch(pb::WatchRequest {})).await?;
    Ok(opened.into_inner())
}
