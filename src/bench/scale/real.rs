//! Rounds of real worker processes.

use std::time::Duration;

use anyhow::Context as _;
use tandem_core::layout::EPISODE_STEPS;
use tandem_learner::Clock;
use tandem_net::ClientConfig;
use tandem_proto::pb;
use tandem_proto::pb::learner_client::LearnerClient;
use tonic::Streaming;

use super::ROLLOUTS;
use super::children::{self, Place, Process, Service};
use super::row::{Reading, Rounds, Row};

/// A learner that is to be given workers.
pub(super) struct Stage<'a> {
    pub(super) place: &'a Place,
    pub(super) learner: &'a Service,
    pub(super) n_slots: usize,
}

impl Stage<'_> {
    /// Starts workers, measures `n_rounds` rounds from the end of one that all of them were in, and ends them.
    pub(super) async fn run(
        &self,
        n_workers: usize,
        n_rounds: u16,
        clock: &Clock,
    ) -> anyhow::Result<Row> {
        let name = |idx| format!("{n_workers}-{idx}");
        let start = |idx| children::worker(self.place, &self.learner.address, &name(idx));
        let mut workers = (0..n_workers).map(start).collect::<anyhow::Result<Vec<Process>>>()?;
        let pids: Vec<u32> = workers.iter().map(|worker| worker.pid).collect();
        let learner = self.learner.process.pid;
        let mut marks = Marks::of(&self.learner.address, clock).await?;
        marks.all_joined(&format!("{n_workers}-"), n_workers).await?;
        marks.next().await?;
        let mut began = vec![marks.next().await?];
        let before = Reading::take(clock(), learner, &pids);
        for _ in 0..n_rounds {
            began.push(marks.next().await?);
        }
        let after = Reading::take(clock(), learner, &pids);
        let env_steps = self.n_slots * ROLLOUTS * EPISODE_STEPS;
        let rounds = Rounds { env_steps, began };
        let named = (format!("workers-{n_workers}"), n_workers);
        let row = Row::between((&before, &after), named, &rounds, learner);
        anyhow::ensure!(workers.iter_mut().all(Process::is_alive), "a worker has ended by itself");
        let ending = workers.into_iter().map(|worker| tokio::spawn(worker.end()));
        for ended in ending.collect::<Vec<_>>() {
            ended.await?;
        }
        Ok(row)
    }
}

/// The ends of rounds, as the learner tells of them.
struct Marks<'a> {
    progress: Streaming<pb::Progress>,
    round: Option<u64>,
    clock: &'a Clock,
}

impl<'a> Marks<'a> {
    async fn of(learner: &str, clock: &'a Clock) -> anyhow::Result<Self> {
        let mut client = LearnerClient::new(ClientConfig::default().channel(learner)?);
        let progress = client.watch(pb::WatchRequest {}).await?.into_inner();
        Ok(Self { progress, round: None, clock })
    }

    /// Waits until `n` workers are there whose names begin with `prefix`.
    async fn all_joined(&mut self, prefix: &str, n: usize) -> anyhow::Result<()> {
        loop {
            let progress = self.message().await?;
            let ours = progress.workers.iter().filter(|worker| worker.name.starts_with(prefix));
            if ours.count() >= n {
                self.round = Some(progress.round);
                return Ok(());
            }
        }
    }

    /// When the next round has ended.
    async fn next(&mut self) -> anyhow::Result<Duration> {
        loop {
            let round = self.message().await?.round;
            if self.round.replace(round).is_some_and(|before| round > before) {
                return Ok((self.clock)());
            }
        }
    }

    async fn message(&mut self) -> anyhow::Result<pb::Progress> {
        self.progress.message().await?.context("the learner has ended")
    }
}
