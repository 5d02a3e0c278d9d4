//! Rounds of real worker processes.

use std::time::Duration;

use anyhow::Context as _;
use tandem_bench::Clock;
use tandem_core::layout::EPISODE_STEPS;
use tandem_net::ClientConfig;
use tandem_proto::pb;
use tandem_proto::pb::learner_client::LearnerClient;
use tonic::Streaming;

use super::ROLLOUTS;
use super::row::{Reading, Rounds, Row};
use super::workspace::{Process, Service, Workspace};

/// Measures rounds of real workers of one learner.
pub(super) struct RealWorkerBench<'a> {
    pub(super) workspace: &'a Workspace,
    pub(super) learner: &'a Service,
    pub(super) n_slots: usize,
}

impl RealWorkerBench<'_> {
    /// Starts workers, measures `n_rounds` rounds after one in which all of them took part, and ends the workers.
    pub(super) async fn run(
        &self,
        n_workers: usize,
        n_rounds: u16,
        clock: &Clock,
    ) -> anyhow::Result<Row> {
        let name = |idx| format!("{n_workers}-{idx}");
        let start = |idx| self.workspace.worker(&self.learner.address, &name(idx));
        let mut workers = (0..n_workers).map(start).collect::<anyhow::Result<Vec<Process>>>()?;
        let pids: Vec<u32> = workers.iter().map(|worker| worker.pid).collect();
        let learner = self.learner.process.pid;
        let mut round_ends = RoundEnds::of(&self.learner.address, clock).await?;
        round_ends.all_joined(&format!("{n_workers}-"), n_workers).await?;
        round_ends.next().await?;
        let mut starts = vec![round_ends.next().await?];
        let before = Reading::take(clock(), learner, &pids);
        for _ in 0..n_rounds {
            starts.push(round_ends.next().await?);
        }
        let after = Reading::take(clock(), learner, &pids);
        let env_steps = self.n_slots * ROLLOUTS * EPISODE_STEPS;
        let rounds = Rounds { env_steps, starts };
        let named = (format!("workers-{n_workers}"), n_workers);
        let row = Row::between((&before, &after), named, &rounds, learner);
        anyhow::ensure!(workers.iter_mut().all(Process::is_alive), "a worker has ended");
        let ending = workers.into_iter().map(|worker| tokio::spawn(worker.end()));
        for ended in ending.collect::<Vec<_>>() {
            ended.await?;
        }
        Ok(row)
    }
}

/// The ends of rounds, from the learner's progress.
struct RoundEnds<'a> {
    progress: Streaming<pb::Progress>,
    round: Option<u64>,
    clock: &'a Clock,
}

impl<'a> RoundEnds<'a> {
    async fn of(learner: &str, clock: &'a Clock) -> anyhow::Result<Self> {
        let mut client = LearnerClient::new(ClientConfig::default().channel(learner)?);
        let progress = client.watch(pb::WatchRequest {}).await?.into_inner();
        Ok(Self { progress, round: None, clock })
    }

    /// Waits until `n` workers have joined whose names begin with `prefix`.
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

    /// Waits for the end of the next round and returns its time.
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
