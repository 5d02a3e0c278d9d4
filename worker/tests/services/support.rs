//! Fake services and the small run that they serve.

pub(crate) mod environment;
pub(crate) mod learner;
pub(crate) mod teacher;

use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;

use tandem_core::rng::{Stream, episode_rng, uniform};
use tandem_core::work::{EpisodeExploration, EpisodeOrder, PublishedActor, RunTerms, SlotOrder};
use tandem_core::{AdviceTerms, EpisodeKind, Exploration, Layout, Task, WorldSettings};
use tandem_net::{Router, ServerConfig, ServerConfigError};
use tandem_proto::pb::environment_server::EnvironmentServer;
use tandem_proto::pb::learner_server::LearnerServer;
use tandem_proto::pb::teacher_server::TeacherServer;
use tokio::runtime::Runtime;
use tokio_util::sync::CancellationToken;

use environment::FakeEnvironments;
use learner::FakeLearner;
use teacher::FakeTeacher;

pub(crate) const LAYOUT: Layout = Layout::new(Task::Push, 2);

pub(crate) fn terms() -> RunTerms {
    RunTerms {
        run: "run-7".to_owned(),
        task: LAYOUT.into(),
        account: Some("run".to_owned()),
        advice: AdviceTerms::default(),
        exploration: Exploration {
            noise_std: 0.2,
            random_action_prob: 0.3,
            sticky_random_mean_steps: 4.0,
            joint_random_actions: false,
        },
        world: WorldSettings { substeps: 10, ..WorldSettings::default() },
        symmetrized_evaluation: false,
    }
}

/// Returns the orders of two training slots, in which episode 3 is not advised, and of one evaluation slot with later
/// parameters, in which episode 1 is recorded.
pub(crate) fn orders() -> Vec<SlotOrder> {
    let slot = |slot, parameter_version, kind, numbers: [u64; 2]| SlotOrder {
        slot,
        parameter_version,
        kind,
        episodes: numbers.map(|number| order(number, kind)).to_vec(),
    };
    vec![
        slot(0, 1, EpisodeKind::Training, [0, 1]),
        slot(1, 1, EpisodeKind::Training, [2, 3]),
        slot(2, 2, EpisodeKind::Evaluation, [0, 1]),
    ]
}

fn order(number: u64, kind: EpisodeKind) -> EpisodeOrder {
    let is_training = kind == EpisodeKind::Training;
    EpisodeOrder {
        number,
        seed: 21,
        advised: is_training && number != 3,
        exploration: EpisodeExploration::Noise,
        record: !is_training && number == 1,
        advised_steps: None,
    }
}

/// Returns a small network whose weights are determined by its version.
pub(crate) fn actor(version: u64) -> PublishedActor {
    let (n_inputs, n_hidden) = (LAYOUT.n_observation() + LAYOUT.n_goal(), 8);
    let n_parameters = (n_inputs + 1) * n_hidden + (n_hidden + 1) * LAYOUT.n_action();
    let mut rng = episode_rng(0, version, Stream::Initialisation);
    PublishedActor {
        version,
        n_hidden,
        n_hidden_layers: 1,
        actor: (0..n_parameters).map(|_| uniform(&mut rng, -0.3, 0.3)).collect(),
        observation_mean: vec![0.0; LAYOUT.n_observation()],
        observation_std: vec![1.0; LAYOUT.n_observation()],
        goal_mean: vec![0.0; LAYOUT.n_goal()],
        goal_std: vec![1.0; LAYOUT.n_goal()],
        gate: None,
    }
}

/// A service on its own runtime, which can be killed like a process.
pub(crate) struct Server {
    runtime: Option<Runtime>,
    address: SocketAddr,
}

impl Server {
    pub(crate) fn learner(learner: &Arc<FakeLearner>) -> Self {
        Self::learner_on(TcpListener::bind("127.0.0.1:0").expect("loopback"), learner)
    }

    pub(crate) fn learner_on(listener: TcpListener, learner: &Arc<FakeLearner>) -> Self {
        let service = LearnerServer::from_arc(Arc::clone(learner));
        Self::serve(listener, async {
            ServerConfig::default().router(service, tandem_proto::FILE_DESCRIPTOR_SET).await
        })
    }

    pub(crate) fn teacher(teacher: &Arc<FakeTeacher>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("loopback");
        let service = TeacherServer::from_arc(Arc::clone(teacher));
        Self::serve(listener, async {
            ServerConfig::default().router(service, tandem_proto::FILE_DESCRIPTOR_SET).await
        })
    }

    pub(crate) fn environments(environments: &Arc<FakeEnvironments>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("loopback");
        let service = EnvironmentServer::from_arc(Arc::clone(environments));
        Self::serve(listener, async {
            ServerConfig::default().router(service, tandem_proto::FILE_DESCRIPTOR_SET).await
        })
    }

    fn serve(
        listener: TcpListener,
        router: impl Future<Output = Result<Router, ServerConfigError>> + Send + 'static,
    ) -> Self {
        let address = listener.local_addr().expect("bound");
        listener.set_nonblocking(true).expect("can be set");
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
        let runtime = runtime.expect("a runtime");
        runtime.spawn(async move {
            let listener = tokio::net::TcpListener::from_std(listener).expect("within a runtime");
            let router = router.await.expect("valid");
            tandem_net::serve(router, listener, CancellationToken::new()).await
        });
        Self { runtime: Some(runtime), address }
    }

    pub(crate) fn address(&self) -> String {
        self.address.to_string()
    }

    /// Closes all connections at once and returns a new listener on the same address.
    pub(crate) fn kill(mut self) -> TcpListener {
        let runtime = self.runtime.take().expect("taken once, here");
        std::thread::spawn(move || drop(runtime)).join().expect("no panic");
        TcpListener::bind(self.address).expect("the port is still free")
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}
