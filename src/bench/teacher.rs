//! Latency and throughput of the teacher service on the loopback interface, with its ledger in a file, compared with an
//! echo service of the same messages. Both services run in this process, each on its own thread and runtime. The clients
//! share a third runtime.

use std::net::{Ipv4Addr, SocketAddr};
use std::thread;
use std::time::Duration;

use anyhow::Context as _;
use tandem_core::rng::{Stream, episode_rng, uniform};
use tandem_core::{Layout, StepQuery, Task};
use tandem_net::{AuthChannel, ClientConfig, ServerConfig};
use tandem_proto::pb::teacher_client::TeacherClient;
use tandem_proto::{encode_query, pb};
use tokio::net::TcpListener;
use tokio::task::JoinSet;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::Streaming;

use super::Figure;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{clock, policy_file, runtime};

mod echo;

/// Duration of a sample and number of samples. The best sample is printed, as the least disturbed one.
const SAMPLE: Duration = Duration::from_millis(500);
const N_SAMPLES: usize = 5;
/// Number of concurrent streams, each with its own connection and one pending request.
const N_STREAMS: u16 = 16;
/// Steps per request: two episodes in lock step, as a worker sends them.
const STEPS_PER_REQUEST: u64 = 2;
const ACCOUNT: &str = "bench";

/// Measures the teacher and the echo service alternately.
pub(super) fn teacher() -> Result<Vec<Figure>, Failed> {
    let policy = policy_file::shipped_teacher(Task::Push.name())?;
    let name = format!("tandem-bench-teacher-{}", std::process::id());
    let directory = std::env::temp_dir().join(name);
    let made = std::fs::create_dir_all(&directory);
    made.or_exit(Exit::TryAgain, || format!("cannot create {}", directory.display()))?;
    let ledger = directory.join("ledger.sqlite").to_string_lossy().into_owned();
    let config = tandem_teacher::Config { policy, critic: None, ledger };
    let figures = runtime::new().and_then(|runtime| runtime.block_on(measure(config)));
    drop(std::fs::remove_dir_all(&directory));
    figures.or_exit(Exit::TryAgain, || "cannot measure the teacher".to_owned())
}

async fn measure(config: tandem_teacher::Config) -> anyhow::Result<Vec<Figure>> {
    let teacher = Server::start(async move |listener, shutdown| {
        tandem_teacher::serve(config, listener, &ServerConfig::default(), shutdown)
            .await
            .map_err(Into::into)
    })?;
    let mut teacher_bench = Bench::new(teacher.address)?;
    let answer = teacher_bench.open_account().await?;
    let echo = Server::start(async move |listener, shutdown| {
        echo::serve(answer, listener, shutdown).await
    })?;
    let mut echo_bench = Bench::new(echo.address)?;
    for _ in 0..N_SAMPLES {
        teacher_bench.sample().await?;
        echo_bench.sample().await?;
    }
    let (of_teacher, of_echo) = (teacher_bench.end(), echo_bench.end());
    teacher.stop().await?;
    echo.stop().await?;
    Ok(figures(&of_teacher, &of_echo))
}

fn figures(teacher: &Best, echo: &Best) -> Vec<Figure> {
    let figure = |name: String, value, unit| Figure { name, value, unit };
    let mut figures = Vec::new();
    for (service, best) in [("teacher", teacher), ("grpc-echo", echo)] {
        for (call, latency) in [("unary", best.unary), ("stream", best.stream)] {
            figures.push(figure(format!("{service}/{call}/p50"), latency.p50_us, "us"));
            figures.push(figure(format!("{service}/{call}/p99"), latency.p99_us, "us"));
        }
        figures.push(figure(format!("{service}/{N_STREAMS}-streams"), best.steps_per_s, "steps/s"));
    }
    let over = |of: fn(&Best) -> f64| of(teacher) / of(echo);
    figures.push(figure(
        "teacher/unary/p50-over-echo".to_owned(),
        over(|b| b.unary.p50_us),
        "x echo",
    ));
    figures.push(figure(
        "teacher/stream/p50-over-echo".to_owned(),
        over(|b| b.stream.p50_us),
        "x echo",
    ));
    figures.push(figure(
        format!("teacher/{N_STREAMS}-streams-over-echo"),
        over(|b| b.steps_per_s),
        "x echo",
    ));
    figures
}

/// A service on its own thread and runtime, as in the program.
struct Server {
    address: SocketAddr,
    shutdown: CancellationToken,
    thread: thread::JoinHandle<anyhow::Result<()>>,
}

impl Server {
    fn start<F>(
        serve: impl FnOnce(TcpListener, CancellationToken) -> F + Send + 'static,
    ) -> anyhow::Result<Self>
    where
        F: Future<Output = anyhow::Result<()>>,
    {
        let listener = std::net::TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?;
        listener.set_nonblocking(true)?;
        let address = listener.local_addr()?;
        let shutdown = CancellationToken::new();
        let ended = shutdown.clone();
        let thread = thread::spawn(move || {
            runtime::new()?.block_on(async { serve(TcpListener::from_std(listener)?, ended).await })
        });
        Ok(Self { address, shutdown, thread })
    }

    /// Ends the service. Meanwhile, this runtime closes the connections that were dropped before.
    async fn stop(self) -> anyhow::Result<()> {
        self.shutdown.cancel();
        let joined = tokio::task::spawn_blocking(|| self.thread.join()).await?;
        joined.map_err(|_panic| anyhow::anyhow!("the service panicked"))?
    }
}

/// Latencies of calls, in microseconds.
#[derive(Debug, Clone, Copy)]
struct Latency {
    p50_us: f64,
    p99_us: f64,
}

impl Latency {
    const WORST: Self = Self { p50_us: f64::INFINITY, p99_us: f64::INFINITY };

    fn of(mut times: Vec<Duration>) -> Self {
        times.sort_unstable();
        let at = |share: usize| {
            times.get(times.len() * share / 100).map_or(f64::INFINITY, |t| 1e6 * t.as_secs_f64())
        };
        Self { p50_us: at(50), p99_us: at(99) }
    }

    fn min(self, other: Self) -> Self {
        Self { p50_us: self.p50_us.min(other.p50_us), p99_us: self.p99_us.min(other.p99_us) }
    }
}

/// The best samples so far.
struct Best {
    unary: Latency,
    stream: Latency,
    steps_per_s: f64,
}

/// Clients of one service.
struct Bench {
    client: TeacherClient<AuthChannel>,
    requests: Requests,
    streams: Vec<(TeacherClient<AuthChannel>, Requests)>,
    best: Best,
}

impl Bench {
    /// Creates clients of the service at `address`, which connect at their first call. Must be called inside a runtime.
    fn new(address: SocketAddr) -> anyhow::Result<Self> {
        let client_config = ClientConfig::default();
        let connect = || client_config.channel(&address.to_string()).map(TeacherClient::new);
        let streams = (1..=N_STREAMS).map(|idx| Ok((connect()?, Requests::new(idx))));
        Ok(Self {
            client: connect()?,
            requests: Requests::new(0),
            streams: streams.collect::<anyhow::Result<_>>()?,
            best: Best { unary: Latency::WORST, stream: Latency::WORST, steps_per_s: 0.0 },
        })
    }

    /// Opens the account and returns a typical response.
    async fn open_account(&mut self) -> anyhow::Result<pb::AdviseResponse> {
        let terms = pb::OpenAccountRequest {
            name: ACCOUNT.to_owned(),
            budget: 1_000_000_000,
            strategy: "mc-q:0.1".to_owned(),
        };
        self.client.open_account(terms).await?;
        Ok(self.client.advise(self.requests.next()).await?.into_inner())
    }

    /// Disconnects the clients and returns the best samples.
    fn end(self) -> Best {
        self.best
    }

    /// Takes one more sample of each quantity.
    async fn sample(&mut self) -> anyhow::Result<()> {
        let unary = self.unary().await?;
        self.best.unary = self.best.unary.min(unary);
        let stream = Self::stream(self.client.clone(), &mut self.requests).await?;
        self.best.stream = self.best.stream.min(Latency::of(stream));
        let steps_per_s = self.many_streams().await?;
        self.best.steps_per_s = self.best.steps_per_s.max(steps_per_s);
        Ok(())
    }

    /// Measures single calls, one after another.
    async fn unary(&mut self) -> anyhow::Result<Latency> {
        let (start, mut times) = (clock::now(), Vec::new());
        while start.elapsed() < SAMPLE {
            let request = self.requests.next();
            let sent_at = clock::now();
            self.client.advise(request).await?;
            times.push(sent_at.elapsed());
        }
        Ok(Latency::of(times))
    }

    /// Measures requests on one stream, one after another.
    async fn stream(
        client: TeacherClient<AuthChannel>,
        requests: &mut Requests,
    ) -> anyhow::Result<Vec<Duration>> {
        let mut stream = AdviceStream::open(client).await?;
        let (start, mut times) = (clock::now(), Vec::new());
        while start.elapsed() < SAMPLE {
            let request = requests.next();
            let sent_at = clock::now();
            stream.ask(request).await?;
            times.push(sent_at.elapsed());
        }
        Ok(times)
    }

    /// Measures the steps per second of all streams together.
    async fn many_streams(&mut self) -> anyhow::Result<f64> {
        let (start, mut asking) = (clock::now(), JoinSet::new());
        for (client, mut requests) in self.streams.drain(..) {
            asking.spawn(async move {
                let times = Self::stream(client.clone(), &mut requests).await?;
                anyhow::Ok(((client, requests), times.len() as u64))
            });
        }
        let mut n_requests = 0;
        while let Some(asked) = asking.join_next().await {
            let (stream, n_asked) = asked??;
            self.streams.push(stream);
            n_requests += n_asked;
        }
        let n_steps = STEPS_PER_REQUEST * n_requests;
        Ok(n_steps as f64 / start.elapsed().as_secs_f64())
    }
}

/// A stream with one pending request.
struct AdviceStream {
    requests: tokio::sync::mpsc::Sender<pb::AdviseRequest>,
    responses: Streaming<pb::AdviseResponse>,
}

impl AdviceStream {
    async fn open(mut client: TeacherClient<AuthChannel>) -> anyhow::Result<Self> {
        let (requests, receiver) = tokio::sync::mpsc::channel(1);
        let responses = client.advise_stream(ReceiverStream::new(receiver)).await?.into_inner();
        Ok(Self { requests, responses })
    }

    async fn ask(&mut self, request: pb::AdviseRequest) -> anyhow::Result<pb::AdviseResponse> {
        self.requests.send(request).await.context("the stream has ended")?;
        self.responses.message().await?.context("the stream has ended")
    }
}

/// Generates requests about two episodes in lock step, then about the next two.
struct Requests {
    request: pb::AdviseRequest,
}

impl Requests {
    /// Creates a generator whose episode numbers differ from those of other generators.
    fn new(generator_idx: u16) -> Self {
        let layout = Layout::new(Task::Push, 2);
        let mut rng = episode_rng(u64::from(generator_idx), 0, Stream::Exploration);
        let mut numbers = |n: usize| (0..n).map(|_| uniform(&mut rng, -0.3, 0.3)).collect();
        let first = u64::from(generator_idx) << 32;
        let steps = (0..STEPS_PER_REQUEST).map(|rollout| {
            encode_query(&StepQuery {
                episode: first + rollout,
                step: 0,
                observation: numbers(layout.n_observation()),
                goal: numbers(layout.n_goal()),
                proposed_action: numbers(layout.n_action()),
                judged_action: None,
                payer: None,
            })
        });
        Self { request: pb::AdviseRequest { account: ACCOUNT.to_owned(), steps: steps.collect() } }
    }

    fn next(&mut self) -> pb::AdviseRequest {
        for step in &mut self.request.steps {
            step.step += 1;
            if step.step >= 50 {
                step.step = 0;
                step.episode += STEPS_PER_REQUEST;
            }
        }
        self.request.clone()
    }
}
