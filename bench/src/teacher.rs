//! Latency and throughput of the teacher service on the loopback interface, compared with an echo service of the same
//! messages. Both services run in this process, each on its own thread and runtime. The clients share a third runtime.

use std::net::{Ipv4Addr, SocketAddr};
use std::thread;
use std::time::Duration;

use tandem_core::rng::{Stream, episode_rng, uniform};
use tandem_core::{Layout, StepQuery, Task};
use tandem_net::{AuthChannel, ClientConfig, ServerConfig};
use tandem_proto::pb::teacher_client::TeacherClient;
use tandem_proto::{encode_query, pb};
use tokio::net::TcpListener;
use tokio::runtime::{Builder, Runtime};
use tokio::task::JoinSet;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::Streaming;

use crate::{Clock, Error, Figure};

mod echo;

/// Duration of a sample and number of samples. The best sample is printed, as the least disturbed one.
const SAMPLE: Duration = Duration::from_millis(500);
const N_SAMPLES: usize = 5;
/// Number of concurrent streams, each with its own connection and one pending request.
const N_STREAMS: u16 = 16;
/// Steps per request: two episodes in lock step, as a worker sends them.
const STEPS_PER_REQUEST: u64 = 2;
const ACCOUNT: &str = "bench";

/// Measures the teacher service of `config` and the echo service alternately.
///
/// Opens an account in the ledger of `config`. Blocks for 15 s and must not be called inside a runtime.
///
/// # Errors
/// When a service cannot be started or a call fails.
pub fn measure(config: tandem_teacher::Config, clock: &Clock) -> Result<Vec<Figure>, Error> {
    runtime()?.block_on(measure_alternately(config, clock))
}

/// Creates a runtime with one thread for all sockets, as in the program.
fn runtime() -> Result<Runtime, Error> {
    Builder::new_current_thread().enable_all().build().map_err(Error::Start)
}

async fn measure_alternately(
    config: tandem_teacher::Config,
    clock: &Clock,
) -> Result<Vec<Figure>, Error> {
    let teacher = Server::start(async move |listener, shutdown| {
        Ok(tandem_teacher::serve(config, listener, &ServerConfig::default(), shutdown).await?)
    })?;
    let mut teacher_bench = Bench::new(teacher.address, clock)?;
    let answer = teacher_bench.open_account().await?;
    let echo = Server::start(async move |listener, shutdown| {
        echo::serve(answer, listener, shutdown).await
    })?;
    let mut echo_bench = Bench::new(echo.address, clock)?;
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
    let mut figures = Vec::new();
    for (service, best) in [("teacher", teacher), ("grpc-echo", echo)] {
        for (call, latency) in [("unary", best.unary), ("stream", best.stream)] {
            figures.push(Figure::new(format!("{service}/{call}/p50"), latency.p50_us, "us"));
            figures.push(Figure::new(format!("{service}/{call}/p99"), latency.p99_us, "us"));
        }
        figures.push(Figure::new(
            format!("{service}/{N_STREAMS}-streams"),
            best.steps_per_s,
            "steps/s",
        ));
    }
    let over = |of: fn(&Best) -> f64| of(teacher) / of(echo);
    figures.push(Figure::new("teacher/unary/p50-over-echo", over(|b| b.unary.p50_us), "x echo"));
    figures.push(Figure::new("teacher/stream/p50-over-echo", over(|b| b.stream.p50_us), "x echo"));
    figures.push(Figure::new(
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
    thread: thread::JoinHandle<Result<(), Error>>,
}

impl Server {
    fn start<F>(
        serve: impl FnOnce(TcpListener, CancellationToken) -> F + Send + 'static,
    ) -> Result<Self, Error>
    where
        F: Future<Output = Result<(), Error>>,
    {
        let listener =
            std::net::TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).map_err(Error::Start)?;
        listener.set_nonblocking(true).map_err(Error::Start)?;
        let address = listener.local_addr().map_err(Error::Start)?;
        let shutdown = CancellationToken::new();
        let ended = shutdown.clone();
        let thread = thread::spawn(move || {
            runtime()?.block_on(async {
                let listener = TcpListener::from_std(listener).map_err(Error::Start)?;
                serve(listener, ended).await
            })
        });
        Ok(Self { address, shutdown, thread })
    }

    /// Ends the service. Meanwhile, this runtime closes the connections that were dropped before.
    async fn stop(self) -> Result<(), Error> {
        self.shutdown.cancel();
        let joined = tokio::task::spawn_blocking(|| self.thread.join()).await;
        joined.map_err(|_panic| Error::Panicked)?.map_err(|_panic| Error::Panicked)?
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
struct Bench<'a> {
    clock: &'a Clock,
    client: TeacherClient<AuthChannel>,
    requests: Requests,
    streams: Vec<(TeacherClient<AuthChannel>, Requests)>,
    best: Best,
}

impl<'a> Bench<'a> {
    /// Creates clients of the service at `address`, which connect at their first call. Must be called inside a runtime.
    fn new(address: SocketAddr, clock: &'a Clock) -> Result<Self, Error> {
        let client_config = ClientConfig::default();
        let connect = || client_config.channel(&address.to_string()).map(TeacherClient::new);
        let streams = (1..=N_STREAMS).map(|idx| Ok((connect()?, Requests::new(idx))));
        Ok(Self {
            clock,
            client: connect()?,
            requests: Requests::new(0),
            streams: streams.collect::<Result<_, Error>>()?,
            best: Best { unary: Latency::WORST, stream: Latency::WORST, steps_per_s: 0.0 },
        })
    }

    /// Opens the account and returns a typical response.
    async fn open_account(&mut self) -> Result<pb::AdviseResponse, Error> {
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
    async fn sample(&mut self) -> Result<(), Error> {
        let unary = self.unary().await?;
        self.best.unary = self.best.unary.min(unary);
        let stream = stream(self.client.clone(), &mut self.requests, self.clock).await?;
        self.best.stream = self.best.stream.min(Latency::of(stream));
        let steps_per_s = self.many_streams().await?;
        self.best.steps_per_s = self.best.steps_per_s.max(steps_per_s);
        Ok(())
    }

    /// Measures single calls, one after another.
    async fn unary(&mut self) -> Result<Latency, Error> {
        let (start, mut times) = ((self.clock)(), Vec::new());
        while (self.clock)() - start < SAMPLE {
            let request = self.requests.next();
            let sent_at = (self.clock)();
            self.client.advise(request).await?;
            times.push((self.clock)() - sent_at);
        }
        Ok(Latency::of(times))
    }

    /// Measures the steps per second of all streams together.
    async fn many_streams(&mut self) -> Result<f64, Error> {
        let (start, mut asking) = ((self.clock)(), JoinSet::new());
        for (client, mut requests) in self.streams.drain(..) {
            let clock = self.clock.clone();
            asking.spawn(async move {
                let times = stream(client.clone(), &mut requests, &clock).await?;
                Ok::<_, Error>(((client, requests), times.len() as u64))
            });
        }
        let mut n_requests = 0;
        while let Some(asked) = asking.join_next().await {
            let (stream, n_asked) = asked.map_err(|_panic| Error::Panicked)??;
            self.streams.push(stream);
            n_requests += n_asked;
        }
        let n_steps = STEPS_PER_REQUEST * n_requests;
        Ok(n_steps as f64 / ((self.clock)() - start).as_secs_f64())
    }
}

/// Measures requests on one stream, one after another.
async fn stream(
    client: TeacherClient<AuthChannel>,
    requests: &mut Requests,
    clock: &Clock,
) -> Result<Vec<Duration>, Error> {
    let mut stream = AdviceStream::open(client).await?;
    let (start, mut times) = (clock(), Vec::new());
    while clock() - start < SAMPLE {
        let request = requests.next();
        let sent_at = clock();
        stream.ask(request).await?;
        times.push(clock() - sent_at);
    }
    Ok(times)
}

/// A stream with one pending request.
struct AdviceStream {
    requests: tokio::sync::mpsc::Sender<pb::AdviseRequest>,
    responses: Streaming<pb::AdviseResponse>,
}

impl AdviceStream {
    async fn open(mut client: TeacherClient<AuthChannel>) -> Result<Self, Error> {
        let (requests, receiver) = tokio::sync::mpsc::channel(1);
        let responses = client.advise_stream(ReceiverStream::new(receiver)).await?.into_inner();
        Ok(Self { requests, responses })
    }

    async fn ask(&mut self, request: pb::AdviseRequest) -> Result<pb::AdviseResponse, Error> {
        self.requests.send(request).await.map_err(|_closed| Error::StreamEnded)?;
        self.responses.message().await?.ok_or(Error::StreamEnded)
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
        Self {
            request: pb::AdviseRequest {
                account: ACCOUNT.to_owned(),
                steps: steps.collect(),
                ..Default::default()
            },
        }
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
