//! A server of a task that is not built-in: points that move to their goals.

use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::Duration;

use tandem_core::rng::{Stream as RandomStream, episode_rng, uniform};
use tandem_core::task::{ArmDescription, Manipulation, Norm, Reflection};
use tandem_core::work::EpisodeStart;
use tandem_core::{TaskDescription, TaskSpec};
use tandem_proto::environment::{
    PlayCommand, decode_play_request, encode_environment, encode_reset_reply, encode_step_reply,
};
use tandem_proto::pb;
use tandem_proto::pb::environment_server::{Environment, EnvironmentServer};
use tokio::sync::mpsc;
use tokio_stream::wrappers::{ReceiverStream, TcpListenerStream};
use tokio_util::sync::CancellationToken;
use tonic::transport::Server;
use tonic::transport::server::Router;
use tonic::{Request, Response, Status, Streaming};

/// Distance that a point moves per step at most, along each axis.
const STEP: f32 = 0.2;

/// Returns the task of two points in the plane, one for each arm, whose numbers alternate: x1, x2, y1, y2.
pub(crate) fn two_arms() -> TaskSpec {
    let arm = |arm_idx: usize| {
        let own = vec![arm_idx, arm_idx + 2];
        ArmDescription {
            observation: own.clone(),
            goal: own.clone(),
            action: own,
            position: Vec::new(),
            lateral: Vec::new(),
            hand: Vec::new(),
        }
    };
    let description = TaskDescription {
        name: "lab/reach".to_owned(),
        n_observation: 4,
        n_goal: 4,
        n_action: 4,
        achieved_goal: vec![0, 1, 2, 3],
        episode_steps: 10,
        tolerance: 0.25,
        norm: Norm::Euclidean,
        interchangeable_arms: true,
        reports_contacts: false,
        origin_distance: 0.0,
        recombination_gap: 0.0,
        base: 0.0,
        contact_distances: Vec::new(),
        observation_bound: vec![3.0; 4],
        goal_bound: vec![1.0; 4],
        manipulation: Manipulation::default(),
        reflection: Reflection::default(),
        arms: vec![arm(0), arm(1)],
    };
    TaskSpec::new(description).expect("consistent")
}

/// Returns the task of one of the points.
pub(crate) fn one_arm() -> TaskSpec {
    two_arms().single_arm().expect("the arms have no common numbers")
}

/// The behaviour of a server, which can change while it serves.
#[derive(Debug)]
struct Behaviour {
    task: TaskSpec,
    /// Requests to play that are still answered; later ones wait.
    n_answered: usize,
    sends_nan: bool,
}

/// A server of environments in this process, which ends when this value is dropped.
pub(crate) struct ReachServer {
    pub(crate) address: String,
    behaviour: Arc<Mutex<Behaviour>>,
    _serving: Serving,
}

/// A thread that serves until this value is dropped.
pub(crate) struct Serving {
    pub(crate) address: String,
    shutdown: CancellationToken,
    thread: Option<JoinHandle<()>>,
}

/// Serves the services that `add` adds on a free port.
pub(crate) fn serve(add: impl FnOnce(&mut Server) -> Router + Send + 'static) -> Serving {
    let shutdown = CancellationToken::new();
    let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = listener.local_addr().expect("bound").to_string();
    listener.set_nonblocking(true).expect("a socket");
    let stop = shutdown.clone();
    let thread = std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        runtime.expect("a runtime").block_on(async {
            let listener = tokio::net::TcpListener::from_std(listener).expect("a socket");
            let router = add(&mut Server::builder());
            tokio::select! {
                served = router.serve_with_incoming(TcpListenerStream::new(listener)) => {
                    served.expect("serves");
                }
                () = stop.cancelled() => (),
            }
        });
    });
    Serving { address, shutdown, thread: Some(thread) }
}

impl Drop for Serving {
    fn drop(&mut self) {
        self.shutdown.cancel();
        if let Some(thread) = self.thread.take() {
            thread.join().ok();
        }
    }
}

impl ReachServer {
    pub(crate) fn start(task: TaskSpec) -> Self {
        let behaviour = Behaviour { task, n_answered: usize::MAX, sends_nan: false };
        let behaviour = Arc::new(Mutex::new(behaviour));
        let service = EnvironmentServer::new(Service { behaviour: behaviour.clone() });
        let serving = serve(|router| router.add_service(service));
        Self { address: serving.address.clone(), behaviour, _serving: serving }
    }

    /// Serves another task from now on.
    pub(crate) fn set_task(&self, task: TaskSpec) {
        self.behaviour().task = task;
    }

    /// Answers `n` more requests to play, and no others until this is called again.
    pub(crate) fn answer_only(&self, n: usize) {
        self.behaviour().n_answered = n;
    }

    /// Returns whether a request to play waits.
    pub(crate) fn is_holding(&self) -> bool {
        self.behaviour().n_answered == 0
    }

    /// Sends observations that are not numbers from now on.
    pub(crate) fn send_nan(&self) {
        self.behaviour().sends_nan = true;
    }

    fn behaviour(&self) -> MutexGuard<'_, Behaviour> {
        self.behaviour.lock().expect("no thread panics")
    }
}

struct Service {
    behaviour: Arc<Mutex<Behaviour>>,
}

/// The points of one stream.
struct Points {
    task: TaskSpec,
    n: Option<usize>,
    /// Shape `[n, n_observation]`.
    positions: Vec<f32>,
}

impl Points {
    fn answer(&mut self, request: pb::PlayRequest) -> Result<pb::PlayResponse, Status> {
        match decode_play_request(request, self.n, &self.task)? {
            PlayCommand::Reset(resets) => {
                let starts: Vec<EpisodeStart> =
                    resets.into_iter().map(|(_, start)| start).collect();
                self.n = Some(starts.len());
                let drawn = starts.iter().map(|start| self.drawn(start));
                let (positions, goals): (Vec<_>, Vec<_>) = drawn.unzip();
                self.positions = positions.concat();
                Ok(encode_reset_reply(&self.positions, &goals.concat()))
            }
            PlayCommand::Step(actions) => {
                for (position, action) in self.positions.iter_mut().zip(actions) {
                    *position = (*position + STEP * action).clamp(-3.0, 3.0);
                }
                // The task reports no contacts.
                Ok(encode_step_reply(&self.positions, &[]))
            }
        }
    }

    /// Draws the positions and the goals of an episode.
    fn drawn(&self, start: &EpisodeStart) -> (Vec<f32>, Vec<f32>) {
        let mut rng = episode_rng(start.seed, start.number, RandomStream::Reset);
        let mut draw = |n: usize| (0..n).map(|_| uniform(&mut rng, -0.7, 0.7)).collect::<Vec<_>>();
        (draw(self.task.n_observation()), draw(self.task.n_goal()))
    }
}

#[tonic::async_trait]
impl Environment for Service {
    type PlayStream = ReceiverStream<Result<pb::PlayResponse, Status>>;

    async fn describe(
        &self,
        _: Request<pb::DescribeEnvironmentRequest>,
    ) -> Result<Response<pb::EnvironmentDescription>, Status> {
        let behaviour = self.behaviour.lock().expect("no thread panics");
        Ok(Response::new(encode_environment(&behaviour.task, "reach 1.0", 64)))
    }

    async fn play(
        &self,
        request: Request<Streaming<pb::PlayRequest>>,
    ) -> Result<Response<Self::PlayStream>, Status> {
        let (responses, outgoing) = mpsc::channel(1);
        let (mut requests, behaviour) = (request.into_inner(), self.behaviour.clone());
        let task = behaviour.lock().expect("no thread panics").task.clone();
        let mut points = Points { task, n: None, positions: Vec::new() };
        tokio::spawn(async move {
            while let Ok(Some(request)) = requests.message().await {
                let sends_nan = permission(&behaviour).await;
                let mut response = points.answer(request);
                if let (Ok(response), true) = (&mut response, sends_nan) {
                    response.observations[..4].copy_from_slice(&f32::NAN.to_le_bytes());
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

/// Waits until the server may answer another request; returns whether it sends NaN.
async fn permission(behaviour: &Mutex<Behaviour>) -> bool {
    loop {
        {
            let mut behaviour = behaviour.lock().expect("no thread panics");
            if behaviour.n_answered > 0 {
                behaviour.n_answered -= 1;
                return behaviour.sends_nan;
            }
        }
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}
