//! A server of simulated environments, which fails at configured requests.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tandem_core::{Contacts, TaskSpec};
use tandem_net::ClientConfig;
use tandem_proto::environment::{
    PlayCommand, decode_play_request, encode_environment, encode_reset_reply, encode_step_reply,
};
use tandem_proto::pb;
use tandem_sim::{Env, WorldConfig};
use tandem_worker::EnvironmentConfig;
use tandem_worker::ports::{Simulator, VectorEnv as _};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

use super::{LAYOUT, Server, terms};

/// The failure of a request.
#[derive(Debug, Clone)]
pub(crate) enum Fault {
    /// The stream ends with this status.
    End(Status),
    /// The request gets no response.
    Hang,
    /// The reply is changed.
    Spoil(fn(&mut pb::PlayResponse)),
}

pub(crate) struct FakeEnvironments {
    task: TaskSpec,
    max_environments: usize,
    faults: BTreeMap<usize, Fault>,
    /// The faults occur again after this many requests.
    period: usize,
    n_requests: Arc<Mutex<usize>>,
}

impl Default for FakeEnvironments {
    fn default() -> Self {
        Self {
            task: LAYOUT.into(),
            max_environments: 2,
            faults: BTreeMap::new(),
            period: usize::MAX,
            n_requests: Arc::default(),
        }
    }
}

impl FakeEnvironments {
    pub(crate) fn serving(self, task: TaskSpec) -> Self {
        Self { task, ..self }
    }

    pub(crate) fn with_room_for(self, max_environments: usize) -> Self {
        Self { max_environments, ..self }
    }

    /// Adds a fault to the `nth` request, counted from 0 over all streams.
    pub(crate) fn with_fault(mut self, nth: usize, fault: Fault) -> Self {
        self.faults.insert(nth, fault);
        self
    }

    /// Repeats the faults every `period` requests.
    pub(crate) fn repeating(self, period: usize) -> Self {
        Self { period, ..self }
    }

    pub(crate) fn n_requests(&self) -> usize {
        *self.n_requests.lock().expect("no handler panics")
    }
}

/// Returns the configuration of a worker that plays on `server`.
pub(crate) fn played_on(server: &Server) -> EnvironmentConfig {
    EnvironmentConfig {
        server: Arc::new(format!("http://{}", server.address())),
        client: ClientConfig::default(),
        reply_timeout: Duration::from_secs(10),
        max_attempts: 3,
    }
}

/// The environments of one stream.
struct Session {
    task: TaskSpec,
    simulator: Simulator,
    n: Option<usize>,
}

impl Session {
    fn new(task: TaskSpec) -> Self {
        let world = Env::new(LAYOUT, &WorldConfig::from(terms().world)).expect("in range");
        Self { task, simulator: Simulator::new(world), n: None }
    }

    fn answer(&mut self, request: pb::PlayRequest) -> Result<pb::PlayResponse, Status> {
        let command = decode_play_request(request, self.n, &self.task)?;
        let n = self.n.unwrap_or(match &command {
            PlayCommand::Reset(resets) => resets.len(),
            PlayCommand::Step(_) => 0,
        });
        self.n = Some(n);
        let mut observations = vec![0.0; n * LAYOUT.n_observation()];
        let failed =
            |error: tandem_worker::ports::EnvironmentError| Status::internal(error.to_string());
        match command {
            PlayCommand::Reset(resets) => {
                let starts: Vec<_> = resets.into_iter().map(|(_, start)| start).collect();
                let mut goals = vec![0.0; n * LAYOUT.n_goal()];
                self.simulator.reset(&starts, &mut observations, &mut goals).map_err(failed)?;
                Ok(encode_reset_reply(&observations, &goals))
            }
            PlayCommand::Step(actions) => {
                let mut contacts = vec![Contacts::NONE; n];
                let stepped = self.simulator.step(&actions, &mut observations, &mut contacts);
                stepped.map_err(failed)?;
                Ok(encode_step_reply(&observations, &contacts))
            }
        }
    }
}

#[tonic::async_trait]
impl pb::environment_server::Environment for FakeEnvironments {
    type PlayStream = ReceiverStream<Result<pb::PlayResponse, Status>>;

    async fn describe(
        &self,
        _: Request<pb::DescribeEnvironmentRequest>,
    ) -> Result<Response<pb::EnvironmentDescription>, Status> {
        let description = encode_environment(&self.task, "fake 1.0", self.max_environments);
        Ok(Response::new(description))
    }

    async fn play(
        &self,
        request: Request<Streaming<pb::PlayRequest>>,
    ) -> Result<Response<Self::PlayStream>, Status> {
        let (responses, outgoing) = mpsc::channel(1);
        let (mut requests, n_requests) = (request.into_inner(), Arc::clone(&self.n_requests));
        let (faults, period) = (self.faults.clone(), self.period);
        let mut session = Session::new(self.task.clone());
        tokio::spawn(async move {
            while let Ok(Some(request)) = requests.message().await {
                let nth = {
                    let mut n_requests = n_requests.lock().expect("no handler panics");
                    *n_requests += 1;
                    *n_requests - 1
                };
                let mut response = session.answer(request);
                match faults.get(&(nth % period)) {
                    None => (),
                    Some(Fault::End(status)) => response = Err(status.clone()),
                    Some(Fault::Hang) => std::future::pending().await,
                    Some(Fault::Spoil(spoil)) => response.as_mut().into_iter().for_each(spoil),
                }
                let is_failed = response.is_err();
                if responses.send(response).await.is_err() || is_failed {
                    return;
                }
            }
        });
        Ok(Response::new(ReceiverStream::new(outgoing)))
    }
}
