//! The service on the loopback interface.

use std::time::Duration;

use tandem_core::rng::{Stream, episode_rng, uniform};
use tandem_core::work::EpisodeStart;
use tandem_core::{EpisodeKind, Layout, Task, WorldSettings};
use tandem_environment::{Config, serve};
use tandem_net::{AuthChannel, ClientConfig, ServerConfig, Token};
use tandem_proto::environment::{
    decode_environment, decode_reset_reply, decode_step_reply, encode_reset, encode_step,
};
use tandem_proto::pb;
use tandem_proto::pb::environment_client::EnvironmentClient;
use tandem_sim::{Env, WorldConfig};
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status, Streaming};

const PUSH: Layout = Layout::new(Task::Push, 2);

/// A running service.
struct Service {
    address: String,
    shutdown: CancellationToken,
}

impl Service {
    async fn start(layout: Layout, max_environments: usize, server_config: ServerConfig) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("loopback");
        let address = listener.local_addr().expect("bound").to_string();
        let config = Config { layout, max_environments, server: "tandem test".to_owned() };
        let shutdown = CancellationToken::new();
        let stop = shutdown.clone();
        tokio::spawn(async move { serve(config, listener, &server_config, stop).await });
        Self { address, shutdown }
    }

    fn client(&self) -> EnvironmentClient<AuthChannel> {
        let channel = ClientConfig::default().channel(&self.address).expect("an address");
        EnvironmentClient::new(channel)
    }

    async fn play(&self) -> Play {
        let (requests, outgoing) = mpsc::channel(1);
        let mut client = self.client();
        let responses = client.play(ReceiverStream::new(outgoing)).await.expect("accepted");
        Play { requests, responses: responses.into_inner() }
    }
}

/// An open stream.
struct Play {
    requests: mpsc::Sender<pb::PlayRequest>,
    responses: Streaming<pb::PlayResponse>,
}

impl Play {
    async fn ask(&mut self, request: pb::PlayRequest) -> Result<pb::PlayResponse, Status> {
        self.requests.send(request).await.expect("open");
        self.responses.message().await.map(|response| response.expect("a response"))
    }
}

fn start(number: u64, kind: EpisodeKind, substeps: u32) -> EpisodeStart {
    let world = WorldSettings { grasped_start_prob: 0.5, substeps, ..WorldSettings::default() };
    EpisodeStart { number, seed: 9, kind, world }
}

fn actions(layout: Layout, number: u64, step: u64) -> Vec<f32> {
    let mut rng = episode_rng(step, number, Stream::Exploration);
    (0..layout.n_action()).map(|_| uniform(&mut rng, -1.0, 1.0)).collect()
}

/// Simulates the beginning of an episode in this process; returns its goal and its observations.
fn simulate(layout: Layout, start: EpisodeStart, n_steps: u64) -> (Vec<f32>, Vec<Vec<f32>>) {
    let config = WorldConfig { substeps: start.world.substeps, ..WorldConfig::default() };
    let mut env = Env::new(layout, &config).expect("in range");
    let mut rng = episode_rng(start.seed, start.number, Stream::Reset);
    env.reset(&mut rng, start.world.for_kind(start.kind));
    let mut observation = vec![0.0; layout.n_observation()];
    env.observe(&mut observation);
    let goal = env.goal().to_vec();
    let mut observations = vec![observation.clone()];
    for step in 0..n_steps {
        env.step(&actions(layout, start.number, step)).expect("finite");
        env.observe(&mut observation);
        observations.push(observation.clone());
    }
    (goal, observations)
}

#[tokio::test]
async fn episodes_have_the_bits_of_a_simulation_in_this_process() {
    const N_STEPS: u64 = 20;
    for layout in [PUSH, Layout::new(Task::PickAndPlace, 1)] {
        let service = Service::start(layout, 8, ServerConfig::default()).await;
        let (task, mut play) = (layout.into(), service.play().await);
        // Several slots in a row, with other physics in between.
        for (first, substeps) in [(0, 20), (3, 10), (6, 20)] {
            let kinds = [EpisodeKind::Training, EpisodeKind::Evaluation, EpisodeKind::Training];
            let starts: Vec<EpisodeStart> =
                (first..).zip(kinds).map(|(number, kind)| start(number, kind, substeps)).collect();
            let expected: Vec<_> =
                starts.iter().map(|start| simulate(layout, *start, N_STEPS)).collect();
            let reply = play.ask(encode_reset(&starts)).await.expect("reset");
            let reply = decode_reset_reply(&reply, 3, &task).expect("valid");
            let goals: Vec<f32> = expected.iter().flat_map(|(goal, _)| goal.clone()).collect();
            assert_eq!(reply.goals, goals);
            let rows = |step: usize| -> Vec<f32> {
                expected.iter().flat_map(|(_, rows)| rows[step].clone()).collect()
            };
            assert_eq!(reply.observations, rows(0));
            for step in 0..N_STEPS {
                let actions: Vec<f32> =
                    starts.iter().flat_map(|start| actions(layout, start.number, step)).collect();
                let reply = play.ask(encode_step(&actions)).await.expect("stepped");
                let reply = decode_step_reply(&reply, 3, &task).expect("valid");
                let bits = |row: &[f32]| row.iter().map(|it| it.to_bits()).collect::<Vec<u32>>();
                let step = usize::try_from(step).expect("few") + 1;
                assert_eq!(bits(&reply.observations), bits(&rows(step)), "step {step}");
            }
        }
        service.shutdown.cancel();
    }
}

#[tokio::test]
async fn a_later_reset_restarts_some_environments_and_leaves_the_others() {
    let service = Service::start(PUSH, 8, ServerConfig::default()).await;
    let (task, mut play) = (PUSH.into(), service.play().await);
    let starts = [0, 1].map(|number| start(number, EpisodeKind::Training, 10));
    play.ask(encode_reset(&starts)).await.expect("reset");
    let both = |step| [actions(PUSH, 0, step), actions(PUSH, 1, step)].concat();
    play.ask(encode_step(&both(0))).await.expect("stepped");
    let mut second_only = encode_reset(&starts);
    if let Some(pb::play_request::Command::Reset(reset)) = &mut second_only.command {
        reset.environments.remove(0);
    }
    let reply = play.ask(second_only).await.expect("reset");
    let reply = decode_reset_reply(&reply, 1, &task).expect("one row");
    assert_eq!(reply.observations, simulate(PUSH, starts[1], 0).1[0]);
    let step = [actions(PUSH, 0, 1), actions(PUSH, 1, 0)].concat();
    let reply = play.ask(encode_step(&step)).await.expect("stepped");
    let reply = decode_step_reply(&reply, 2, &task).expect("valid");
    let expected = [&simulate(PUSH, starts[0], 2).1[2][..], &simulate(PUSH, starts[1], 1).1[1][..]];
    assert_eq!(reply.observations, expected.concat());
    service.shutdown.cancel();
}

#[tokio::test]
async fn a_malformed_request_ends_its_stream_and_no_other() {
    let service = Service::start(PUSH, 8, ServerConfig::default()).await;
    let starts = [start(0, EpisodeKind::Training, 10)];
    let mut healthy = service.play().await;
    healthy.ask(encode_reset(&starts)).await.expect("reset");
    let mut infinite = actions(PUSH, 0, 0);
    infinite[4] = f32::NAN;
    let cases = [
        (encode_step(&infinite), "step.actions[4]: expected a number in [-1, 1], got NaN"),
        (encode_step(&[2.0; 6]), "step.actions[0]: expected a number in [-1, 1], got 2"),
        (encode_step(&[0.0; 5]), "step.actions: expected 6 numbers, got 5 numbers"),
        (pb::PlayRequest::default(), "command: expected a message, got none"),
        (encode_reset(&[starts[0]; 2]), "reset.environments: expected 1 to 1 environments, got 2"),
        (
            encode_reset(&[start(0, EpisodeKind::Training, 5)]),
            "reset: world.substeps is 5, expected a number from 10 to 80",
        ),
    ];
    for (request, message) in cases {
        let mut play = service.play().await;
        play.ask(encode_reset(&starts)).await.expect("reset");
        let refused = play.ask(request).await.expect_err("refused");
        assert_eq!((refused.code(), refused.message()), (Code::InvalidArgument, message));
        let next = play.responses.message().await;
        assert!(next.is_ok_and(|next| next.is_none()), "the stream has ended");
        healthy.ask(encode_step(&actions(PUSH, 0, 0))).await.expect("undisturbed");
    }
    service.shutdown.cancel();
}

#[tokio::test]
async fn all_streams_together_have_a_limited_number_of_environments() {
    let service = Service::start(PUSH, 3, ServerConfig::default()).await;
    let starts = |n: u64| (0..n).map(|it| start(it, EpisodeKind::Training, 10)).collect::<Vec<_>>();
    let mut first = service.play().await;
    first.ask(encode_reset(&starts(2))).await.expect("room for two");
    first.ask(encode_reset(&starts(2))).await.expect("the same room");
    let mut second = service.play().await;
    let refused = second.ask(encode_reset(&starts(2))).await.expect_err("no room");
    let expected = "no room for 2 environments: 1 of 3 are free";
    assert_eq!((refused.code(), refused.message()), (Code::ResourceExhausted, expected));
    drop(first);
    let freed = async {
        while service.play().await.ask(encode_reset(&starts(3))).await.is_err() {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(Duration::from_secs(20), freed).await.expect("the room is free again");
    service.shutdown.cancel();
}

#[tokio::test]
async fn the_description_names_task_server_and_limit() {
    let service = Service::start(PUSH, 3, ServerConfig::default()).await;
    let described = service.client().describe(pb::DescribeEnvironmentRequest {}).await;
    let description = decode_environment(described.expect("answered").into_inner());
    let description = description.expect("valid");
    assert_eq!(description.task, PUSH.into());
    assert_eq!((description.server.as_str(), description.max_environments), ("tandem test", 3));
    service.shutdown.cancel();
}

#[tokio::test]
async fn a_service_with_a_token_refuses_calls_without_it() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("token");
    std::fs::write(&path, "0123456789abcdef0123456789abcdef\n").expect("writes");
    let token = Token::read(&path).expect("a token");
    let service = Service::start(PUSH, 3, ServerConfig::default().with_token(token)).await;
    let (_requests, outgoing) = mpsc::channel::<pb::PlayRequest>(1);
    let refused = service.client().play(ReceiverStream::new(outgoing)).await;
    assert_eq!(refused.expect_err("no token").code(), Code::Unauthenticated);
    service.shutdown.cancel();
}

#[tokio::test]
async fn a_shutdown_ends_open_streams() {
    let service = Service::start(PUSH, 3, ServerConfig::default()).await;
    let mut play = service.play().await;
    play.ask(encode_reset(&[start(0, EpisodeKind::Training, 10)])).await.expect("reset");
    service.shutdown.cancel();
    let ended = tokio::time::timeout(Duration::from_secs(20), play.responses.message()).await;
    let status = ended.expect("soon").expect_err("the server is gone");
    assert_eq!(status.code(), Code::Unavailable);
}
