//! The learner's progress, followed over its restarts.

use std::time::Duration;

use anyhow::Context as _;
use tandem_net::{AuthChannel, ClientConfig, within};
use tandem_proto::pb;
use tandem_proto::pb::learner_client::LearnerClient;
use tokio::sync::mpsc;
use tonic::{Status, Streaming};

/// How long the learner may take to answer that it can be watched.
const OPEN_DEADLINE: Duration = Duration::from_secs(5);
/// Pause before a learner that is away is called again.
const PAUSE: Duration = Duration::from_millis(200);
/// Messages that are not looked at yet. When it is full the learner skips some: only the latest counts.
const CAPACITY: usize = 1;

/// One message about the run.
pub(super) struct Heard {
    /// How many streams were opened before this message's: another number may be another process.
    pub(super) n_streams_before: u32,
    pub(super) progress: pb::Progress,
}

/// Follows the learner at `address` until the receiver is dropped; a learner that is away is called again and again.
pub(super) fn follow(address: &str) -> anyhow::Result<mpsc::Receiver<Heard>> {
    let link = ClientConfig::default().channel(address).context("cannot follow the learner")?;
    let (sender, receiver) = mpsc::channel(CAPACITY);
    tokio::spawn(async move {
        tokio::select! {
            () = follow_for_ever(LearnerClient::new(link), &sender) => (),
            () = sender.closed() => (),
        }
    });
    Ok(receiver)
}

async fn follow_for_ever(mut learner: LearnerClient<AuthChannel>, sender: &mpsc::Sender<Heard>) {
    for n_streams_before in 0.. {
        // What ended a stream is of no interest: whether the learner lives is for others to see.
        if let Ok(mut stream) = open(&mut learner).await {
            while let Ok(Some(progress)) = stream.message().await {
                if sender.send(Heard { n_streams_before, progress }).await.is_err() {
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
