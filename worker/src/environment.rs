//! The client of a server of environments.

use tandem_core::TaskSpec;
use tandem_core::text::shortened;
use tandem_core::work::EpisodeStart;
use tandem_net::{AuthChannel, MAX_MESSAGE_BYTES, Operation, Retrier, Retryability, within};
use tandem_proto::environment::{
    ResetReply, StepReply, decode_environment, decode_reset_reply, decode_step_reply, encode_reset,
    encode_step,
};
use tandem_proto::{DecodeError, pb};
use tonic::{Code, Status};

use crate::config::EnvironmentConfig;
use crate::error::Error;
use crate::player::{Failures, PeerRequest};
use crate::request_stream::RequestStream;

const PLAY: Operation =
    Operation { peer: "environment server", purpose: "play in the environments of the server" };
/// The largest number of characters of a server's own name in messages.
const MAX_NAME_CHARS: usize = 100;
/// The largest number of characters of the cause of a failure in reports.
const MAX_CAUSE_CHARS: usize = 200;

type Rpc = pb::environment_client::EnvironmentClient<AuthChannel>;

/// A server of environments and its task.
#[derive(Debug, Clone, PartialEq)]
pub struct ServedTask {
    /// The name of the server in messages: its address and program.
    pub server: String,
    /// The task of its environments.
    pub task: TaskSpec,
    /// The largest number of environments of a slot.
    pub max_environments: usize,
}

impl ServedTask {
    /// Checks that the server serves the run's task.
    ///
    /// # Errors
    /// Names the first field that differs.
    pub fn check(&self, run: &TaskSpec) -> Result<(), Error> {
        let Some(difference) = run.difference(&self.task) else { return Ok(()) };
        Err(Error::OtherTask { server: self.server.clone(), difference })
    }

    /// Checks that the server has an environment for each of the `needed` episodes of a slot.
    ///
    /// # Errors
    /// When it has fewer.
    pub fn check_room(&self, needed: usize) -> Result<(), Error> {
        if needed <= self.max_environments {
            return Ok(());
        }
        let (server, max) = (self.server.clone(), self.max_environments);
        Err(Error::TooFewEnvironments { server, max, needed })
    }
}

/// Waits for the server of `config` and returns its task.
///
/// # Errors
/// When the server cannot be started, does not answer after several attempts, or has an invalid task.
pub async fn describe_environments(config: EnvironmentConfig) -> Result<ServedTask, Error> {
    let mut environments = EnvironmentClient::new(config);
    loop {
        match environments.connect().await {
            Ok(server) => return Ok(server.served.clone()),
            Err(failure) => environments.recover(failure).await?,
        }
    }
}

/// The client of the server of a worker's environments, called over one stream.
///
/// A call that fails ends the slot; the caller [recovers](Self::recover) and plays the slot again from its start, which
/// gives the same episodes.
#[derive(Debug)]
pub(crate) struct EnvironmentClient {
    config: EnvironmentConfig,
    retrier: Retrier,
    /// Failures since a slot was played.
    n_failures: u32,
    /// Failures that were not reported yet.
    unreported: Failures,
    /// The name of the latest server in messages: its address and, once it is connected, its program; empty before the
    /// first attempt to connect.
    name: String,
    was_connected: bool,
    server: Option<Server>,
    stream: Option<PlayStream>,
    /// The episodes in play, by environment.
    episodes: Vec<u64>,
    /// The steps of these episodes so far.
    n_steps: usize,
}

#[derive(Debug)]
struct Server {
    client: Rpc,
    served: ServedTask,
}

/// A stream that steps `n` environments.
#[derive(Debug)]
struct PlayStream {
    n: usize,
    stream: RequestStream<pb::PlayRequest, pb::PlayResponse>,
}

/// The failure of a call.
#[derive(Debug)]
pub(crate) enum Failure {
    /// Another attempt may succeed.
    Transient(Status),
    /// No attempt can succeed.
    Final(Box<Error>),
}

impl EnvironmentClient {
    /// Creates a client, which connects on its first call.
    pub(crate) fn new(config: EnvironmentConfig) -> Self {
        Self {
            config,
            retrier: Retrier::new(EnvironmentConfig::BACKOFF, PLAY),
            n_failures: 0,
            unreported: Failures::default(),
            name: String::new(),
            was_connected: false,
            server: None,
            stream: None,
            episodes: Vec::new(),
            n_steps: 0,
        }
    }

    /// Waits for the server, checks that it serves the given task, and returns the largest number of environments per
    /// stream.
    pub(crate) async fn check(&mut self, task: &TaskSpec) -> Result<usize, Error> {
        loop {
            match self.connect().await {
                Ok(server) => {
                    server.served.check(task)?;
                    return Ok(server.served.max_environments);
                }
                Err(failure) => self.recover(failure).await?,
            }
        }
    }

    /// Answers a request of a rollout. Returns true if the rollout still waits for the response.
    pub(crate) async fn answer(
        &mut self,
        request: PeerRequest,
        task: &TaskSpec,
    ) -> Result<bool, Failure> {
        Ok(match request {
            PeerRequest::Reset(starts, response) => {
                response.send(self.reset(&starts, task).await?).is_ok()
            }
            PeerRequest::Step(actions, response) => {
                response.send(self.step(&actions, task).await?).is_ok()
            }
            PeerRequest::Advice(..) => false,
        })
    }

    /// Starts episodes, one per environment.
    pub(crate) async fn reset(
        &mut self,
        starts: &[EpisodeStart],
        task: &TaskSpec,
    ) -> Result<ResetReply, Failure> {
        self.episodes = starts.iter().map(|start| start.number).collect();
        self.n_steps = 0;
        let n = starts.len();
        let reply = self.exchange(n, encode_reset(starts), task).await?;
        decode_reset_reply(&reply, n, task).map_err(|error| self.invalid(error))
    }

    /// Executes actions, shape `[n, n_action]`.
    pub(crate) async fn step(
        &mut self,
        actions: &[f32],
        task: &TaskSpec,
    ) -> Result<StepReply, Failure> {
        self.n_steps += 1;
        let n = self.episodes.len();
        let reply = self.exchange(n, encode_step(actions), task).await?;
        decode_step_reply(&reply, n, task).map_err(|error| self.invalid(error))
    }

    /// Records that a slot was played. Returns the failures since the previous one.
    pub(crate) async fn succeed(&mut self) -> Failures {
        self.n_failures = 0;
        self.retrier.settle(Ok(())).await;
        std::mem::take(&mut self.unreported)
    }

    /// Waits before the next attempt after a failure.
    ///
    /// # Errors
    /// When no attempt can succeed, or too many have failed since a slot was played.
    pub(crate) async fn recover(&mut self, failure: Failure) -> Result<(), Error> {
        (self.server, self.stream) = (None, None);
        let status = match failure {
            Failure::Transient(status) => status,
            Failure::Final(error) => return Err(*error),
        };
        self.n_failures += 1;
        // Further attempts belong to the same failure, such as a server that is away.
        if self.n_failures == 1 {
            self.unreported.n += 1;
            let message = status.message().replace(char::is_control, " ");
            let cause = shortened(&message, MAX_CAUSE_CHARS);
            self.unreported.latest = format!("{}: {cause}", self.name);
        }
        if self.n_failures >= self.config.max_attempts {
            let (server, n_failures) = (self.name.clone(), self.n_failures);
            return Err(Error::EnvironmentFailed { server, n_failures, status });
        }
        self.retrier.settle(Err::<(), _>(status)).await;
        Ok(())
    }

    /// Sends one request and waits for its response.
    async fn exchange(
        &mut self,
        n: usize,
        request: pb::PlayRequest,
        task: &TaskSpec,
    ) -> Result<pb::PlayResponse, Failure> {
        let stream = self.stream.take().filter(|open| open.n == n).map(|open| open.stream);
        let reply_timeout = self.config.reply_timeout;
        let Server { client, served } = self.connect().await?;
        // The server may have been replaced since the last call.
        served.check(task).map_err(|error| Failure::Final(Box::new(error)))?;
        served.check_room(n).map_err(|error| Failure::Final(Box::new(error)))?;
        let exchange =
            RequestStream::exchange(PLAY.peer, stream, request, |requests| client.play(requests));
        let exchanged = within(reply_timeout, exchange).await;
        let (response, stream) = exchanged.map_err(|status| self.play_failure(status))?;
        self.stream = Some(PlayStream { n, stream });
        Ok(response)
    }

    /// Connects to the server, unless it is connected.
    async fn connect(&mut self) -> Result<&mut Server, Failure> {
        let server = match self.server.take() {
            Some(server) => server,
            None => self.open_server().await?,
        };
        Ok(self.server.insert(server))
    }

    async fn open_server(&mut self) -> Result<Server, Failure> {
        let address = match self.n_failures {
            0 => self.config.server.address(),
            _ => self.config.server.address_after_failure(),
        };
        let address = match address.await {
            Ok(address) => address,
            // A command that has worked before may work again.
            Err(error) if self.was_connected => {
                return Err(Failure::Transient(Status::unavailable(error.to_string())));
            }
            Err(error) => return Err(Failure::Final(Box::new(error.into()))),
        };
        self.name.clone_from(&address);
        let channel = self.config.client.channel(&address).map_err(|source| {
            Failure::Final(Box::new(Error::Address { role: "environment server", source }))
        })?;
        let mut client = Rpc::new(channel)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        let describe = client.describe(pb::DescribeEnvironmentRequest {});
        let described = within(self.config.reply_timeout, describe).await;
        let description = described.map_err(|status| self.failure(status))?.into_inner();
        let description = decode_environment(description).map_err(|source| {
            let (server, reply) = (self.name.clone(), "Describe".to_owned());
            Failure::Final(Box::new(Error::InvalidReply { server, reply, source }))
        })?;
        let program: String = description.server.chars().take(MAX_NAME_CHARS).collect();
        self.name = format!("{address} ({program})");
        tracing::info!(server = self.name, "environment server connected");
        self.was_connected = true;
        let served = ServedTask {
            server: self.name.clone(),
            task: description.task,
            max_environments: description.max_environments,
        };
        Ok(Server { client, served })
    }

    fn failure(&self, status: Status) -> Failure {
        match Retryability::of(status.code()) {
            Retryability::Transient => Failure::Transient(status),
            Retryability::NotFound | Retryability::Final => {
                let server = self.name.clone();
                Failure::Final(Box::new(Error::EnvironmentRefused { server, status }))
            }
        }
    }

    /// The failure of a request to play. A server that answers with `DATA_LOSS` would do so again.
    fn play_failure(&self, status: Status) -> Failure {
        match status.code() {
            Code::DataLoss => {
                let (server, reply) = (self.name.clone(), self.latest_request());
                Failure::Final(Box::new(Error::EpisodeLost { server, reply, status }))
            }
            _ => self.failure(status),
        }
    }

    /// The failure of a server whose reply no environment of the task can give. It would give it again.
    fn invalid(&self, source: DecodeError) -> Failure {
        let (server, reply) = (self.name.clone(), self.latest_request());
        Failure::Final(Box::new(Error::InvalidReply { server, reply, source }))
    }

    /// Describes the latest request to play, from which the seeds of its episodes follow.
    fn latest_request(&self) -> String {
        match self.n_steps {
            0 => format!("the reset of episodes {:?}", self.episodes),
            step => format!("step {step} of episodes {:?}", self.episodes),
        }
    }
}
