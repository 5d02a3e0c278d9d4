//! A running service with its clients, its clock and its arms.

use std::net::SocketAddr;
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

use tandem_bridge::cell_file::CellFile;
use tandem_bridge::injection::Injector;
use tandem_bridge::service::{BoxDriver, Config, Error, Reconnect, serve};
use tandem_bridge::work_cell::mico_cell;
use tandem_bridge::{Command, Driver, DriverError, Executor, Order, PairState, Settings};
use tandem_core::ArmIndex;
use tandem_kinematics::{ArmSample, Joints, Motion};
use tandem_net::ServerConfig;
use tandem_proto::pb;
use tandem_proto::pb::bridge_client::BridgeClient;
use tandem_trials::simulated::{Block, Drill};
use tandem_trials::{SimulatedConfig, SimulatedPair};
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;
use tonic::{Response, Status, Streaming};

use crate::service::clock::TestClock;

/// A time limit that even a busy machine keeps.
pub(crate) const DEADLINE: Duration = Duration::from_secs(120);

/// A fault of the driver.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Fault {
    None,
    /// An exchange fails; stopping works.
    Exchange,
    /// All communication fails.
    Dead,
    /// An exchange panics.
    Panic,
    /// An exchange blocks until the fault ends.
    Hang,
    /// The present connection never works again; new ones do.
    Lost,
    /// Commands are lost, and the last state is returned again and again.
    Silent,
    /// States contain NaN.
    Untrue,
    /// States show that a joint turns.
    Restless,
}

/// A simulated pair that a test can inspect and disturb.
pub(crate) struct Bench {
    pair: SimulatedPair,
    drill: Drill,
    fault: Fault,
    /// The number of stops outside of exchanges.
    n_stops: usize,
    newest: Order,
    last: Option<PairState>,
    /// The connection that works, counted from 0.
    connection: usize,
    /// The first command of the present connection.
    first: Option<Command>,
    /// The widest commanded opening of a gripper since it was last read.
    widest: f64,
}

/// The bench and the number of this connection to it.
#[derive(Clone)]
pub(crate) struct Tap(Arc<(Mutex<Bench>, Condvar)>, usize);

impl Tap {
    fn new(config: SimulatedConfig, injector: Injector, settings: &Settings) -> Self {
        let cell = mico_cell();
        let at = cell.ready(0.05).unwrap();
        let pair = SimulatedPair::new(cell, &at, 0.5, config);
        let drill = Drill::new(injector, settings);
        let (fault, newest) = (Fault::None, Order::Stop);
        let (n_stops, connection, last, first, widest) = (0, 0, None, None, 0.0);
        let bench = Bench { pair, drill, fault, n_stops, newest, last, connection, first, widest };
        Self(Arc::new((Mutex::new(bench), Condvar::new())), 0)
    }

    pub(crate) fn fail(&self, fault: Fault) {
        self.0.0.lock().unwrap().fault = fault;
        self.0.1.notify_all();
    }

    /// Creates a new connection if the previous one is lost.
    fn client_config(&self) -> Result<Self, DriverError> {
        let mut bench = self.0.0.lock().unwrap();
        if bench.fault != Fault::Lost {
            return Err(DriverError::Disconnected { what: "no response".into() });
        }
        (bench.fault, bench.first) = (Fault::None, None);
        bench.connection += 1;
        Ok(Self(Arc::clone(&self.0), bench.connection))
    }

    /// The number of new connections and the first command of the present one.
    pub(crate) fn dialled(&self) -> (usize, Option<Command>) {
        let bench = self.0.0.lock().unwrap();
        (bench.connection, bench.first.clone())
    }

    pub(crate) fn n_stops(&self) -> usize {
        self.0.0.lock().unwrap().n_stops
    }

    /// The newest command that has arrived.
    pub(crate) fn newest(&self) -> Order {
        self.0.0.lock().unwrap().newest.clone()
    }

    /// Returns the widest commanded opening since the last call.
    pub(crate) fn take_widest(&self) -> f64 {
        std::mem::take(&mut self.0.0.lock().unwrap().widest)
    }

    /// The true openings of the grippers and heights of the blocks, metres, arm by arm.
    pub(crate) fn held(&self) -> [(f64, f64); 2] {
        let bench = self.0.0.lock().unwrap();
        let objects = bench.pair.objects();
        [0, 1].map(|arm| (bench.pair.opening(ArmIndex(arm)), objects[arm].at_m.z))
    }

    /// The true joint angles.
    pub(crate) fn angles(&self) -> [Joints; 2] {
        let bench = self.0.0.lock().unwrap();
        [0, 1].map(|arm| *bench.pair.angles(ArmIndex(arm)))
    }
}

impl Driver for Tap {
    fn period_s(&self) -> f64 {
        tandem_trials::simulated::PERIOD_S
    }

    fn exchange(&mut self, command: &Command) -> Result<PairState, DriverError> {
        let bench = self.0.0.lock().unwrap();
        let mut bench = self.0.1.wait_while(bench, |bench| bench.fault == Fault::Hang).unwrap();
        if self.1 != bench.connection {
            return Err(DriverError::Disconnected { what: "this connection is lost".into() });
        }
        match bench.fault {
            Fault::None | Fault::Hang => {
                bench.first.get_or_insert_with(|| command.clone());
                bench.newest = command.order.clone();
                if let Order::Move(arms) = &command.order {
                    let openings = arms.iter().map(|arm| arm.opening);
                    bench.widest = openings.fold(bench.widest, f64::max);
                }
                let Bench { pair, drill, .. } = &mut *bench;
                drill.apply(pair);
                let state = drill.delayed(pair.exchange(command)?);
                bench.last = Some(state.clone());
                Ok(state)
            }
            Fault::Silent => Ok(bench.last.clone().expect("an exchange before the fault")),
            fault @ (Fault::Untrue | Fault::Restless) => {
                let mut state = bench.pair.exchange(command)?;
                match fault {
                    Fault::Untrue => state.arms[0].angles[0] = f64::NAN,
                    _ => state.arms[0].velocities[0] = 0.1,
                }
                Ok(state)
            }
            Fault::Exchange | Fault::Dead | Fault::Lost => {
                Err(DriverError::Disconnected { what: "the test pulled the plug".into() })
            }
            Fault::Panic => {
                drop(bench);
                panic!("a bug, as the test wants it")
            }
        }
    }

    fn stop(&mut self) -> Result<(), DriverError> {
        let mut bench = self.0.0.lock().unwrap();
        if bench.fault == Fault::Dead {
            return Err(DriverError::Disconnected { what: "the test pulled the plug".into() });
        }
        bench.n_stops += 1;
        bench.pair.stop()
    }
}

/// Settings for which no client is too slow.
pub(crate) fn patient() -> Settings {
    Settings { owner_hold_s: 1e6, owner_stop_s: 1e6, lease_s: 1e6, ..Settings::default() }
}

fn seeded() -> SimulatedConfig {
    SimulatedConfig { seed: 1, ..SimulatedConfig::default() }
}

/// A running service.
pub(crate) struct Rig {
    pub(crate) client: BridgeClient<Channel>,
    pub(crate) clock: Arc<TestClock>,
    pub(crate) tap: Tap,
    pub(crate) shutdown: CancellationToken,
    pub(crate) served: JoinHandle<Result<(), Error>>,
    address: SocketAddr,
}

/// A running motion with its signs of life and progress.
pub(crate) struct Playing {
    pub(crate) signs: mpsc::Sender<pb::ExecuteRequest>,
    pub(crate) responses: Streaming<pb::ExecuteResponse>,
}

impl Rig {
    pub(crate) async fn new(settings: Settings) -> Self {
        Self::bounded(settings, 1.0).await
    }

    /// A service that can reconnect to its arms.
    pub(crate) async fn dialling(settings: Settings) -> Self {
        Self::start(settings, 1.0, seeded(), |tap| {
            let tap = tap.clone();
            Some(Arc::new(move || tap.client_config().map(|tap| Box::new(tap) as BoxDriver)))
        })
        .await
    }

    /// A service whose arms have a block each.
    pub(crate) async fn with_blocks(settings: Settings, blocks: Vec<Block>) -> Self {
        Self::start(settings, 1.0, SimulatedConfig { blocks, ..seeded() }, |_| None).await
    }

    /// A service that plays nothing faster than `speed`.
    pub(crate) async fn bounded(settings: Settings, speed: f64) -> Self {
        Self::start(settings, speed, seeded(), |_| None).await
    }

    async fn start(
        settings: Settings,
        speed: f64,
        config: SimulatedConfig,
        reconnect: fn(&Tap) -> Option<Reconnect>,
    ) -> Self {
        let listener = TcpListener::bind(SocketAddr::from(([127, 0, 0, 1], 0))).await.unwrap();
        let address = listener.local_addr().unwrap();
        let injector = Injector::default();
        let tap = Tap::new(config, injector.clone(), &settings);
        let clock = Arc::new(TestClock::default());
        let executor = Executor::new(mico_cell(), Box::new(tap.clone()) as _, settings).unwrap();
        let shutdown = CancellationToken::new();
        let config = Config {
            driver: "sim".to_owned(),
            version: "0.0.0-test".to_owned(),
            speed,
            clock: clock.clone(),
            reconnect: reconnect(&tap),
            cell: CellFile::default(),
            timings: CellFile::default().timings(&settings),
            cell_name: String::new(),
            // Arms that can lose their connection are real ones.
            injector: reconnect(&tap).is_none().then_some(injector),
            prepare_thread: None,
            secret: [7; 32],
        };
        let ends = shutdown.clone();
        let served = tokio::spawn(async move {
            serve(executor, config, listener, &ServerConfig::default(), ends).await
        });
        let client = connect(address);
        Self { client, clock, tap, shutdown, served, address }
    }

    /// Returns a client with a separate connection.
    pub(crate) async fn stranger(&self) -> BridgeClient<Channel> {
        connect(self.address)
    }

    pub(crate) async fn acquire(&mut self) -> String {
        let answer = self.client.acquire(pb::AcquireRequest::default()).await.unwrap();
        answer.into_inner().token
    }

    /// Acquires and resets the arms.
    pub(crate) async fn ready(&mut self) -> String {
        let token = self.acquire().await;
        self.reset(&token).await.unwrap();
        token
    }

    /// Resets the arms as soon as their states are good.
    pub(crate) async fn reset(&mut self, token: &str) -> Result<(), Status> {
        let deadline = tokio::time::sleep(DEADLINE);
        tokio::pin!(deadline);
        loop {
            let reset = self.client.reset(pb::ResetRequest { token: token.to_owned() });
            match reset.await {
                // The newest state may be older than the end of a fault.
                Err(status) if is_passing(status.message()) => {}
                reset => return reset.map(|_| ()),
            }
            assert!(!deadline.is_elapsed(), "the arms do not get well");
        }
    }

    pub(crate) async fn status(&mut self) -> pb::BridgeStatusResponse {
        self.client.status(pb::BridgeStatusRequest {}).await.unwrap().into_inner()
    }

    /// Waits until the status meets a condition.
    pub(crate) async fn eventually(
        &mut self,
        wanted: impl Fn(&pb::BridgeStatusResponse) -> bool,
    ) -> pb::BridgeStatusResponse {
        let deadline = tokio::time::sleep(DEADLINE);
        tokio::pin!(deadline);
        loop {
            let status = self.status().await;
            if wanted(&status) {
                return status;
            }
            assert!(!deadline.is_elapsed(), "{status:?}");
        }
    }

    pub(crate) async fn execute(
        &mut self,
        token: &str,
        motion: pb::MotionRequest,
    ) -> Result<Playing, Status> {
        let (signs, requests) = mpsc::channel(8);
        let start = pb::ExecuteStart {
            token: token.to_owned(),
            motion: Some(motion),
            ..Default::default()
        };
        signs.send(request(pb::execute_request::Request::Start(start))).await.unwrap();
        let responses = self.client.execute(ReceiverStream::new(requests)).await;
        responses.map(Response::into_inner).map(|responses| Playing { signs, responses })
    }

    /// Starts a motion that takes minutes.
    pub(crate) async fn moving(&mut self, token: &str) -> Playing {
        let mut playing = self.execute(token, slow()).await.unwrap();
        while playing.next().await.unwrap().progress.unwrap().played_s <= 0.0 {}
        playing
    }

    /// Asserts that the drives have braked and nothing moves.
    pub(crate) async fn assert_nothing_moves(&mut self) {
        let since_s = self.status().await.now_s;
        self.eventually(|status| status.now_s > since_s + 0.5).await;
        let before = self.tap.angles();
        self.eventually(|status| status.now_s > since_s + 2.5).await;
        let moved = before.iter().zip(self.tap.angles()).map(|(a, b)| a.largest_difference(&b));
        assert!(moved.fold(0.0, f64::max) < 1e-6, "{before:?} {:?}", self.tap.angles());
        assert_eq!(self.tap.newest(), Order::Stop);
    }
}

impl Playing {
    /// Sends a sign of life, which has no effect after the end.
    pub(crate) async fn alive(&self) {
        let alive = pb::execute_request::Request::Alive(pb::SignOfLife {});
        self.signs.send(request(alive)).await.ok();
    }

    pub(crate) async fn next(&mut self) -> Result<pb::ExecuteResponse, Status> {
        let next = tokio::time::timeout(DEADLINE, self.responses.message()).await.unwrap();
        next.map(|response| response.expect("an outcome comes before the end"))
    }

    /// Returns the last response and all phases before it.
    pub(crate) async fn last(
        &mut self,
    ) -> Result<(pb::ExecuteResponse, Vec<pb::BridgePhase>), Status> {
        let mut phases = Vec::new();
        loop {
            let response = self.next().await?;
            let phase = response.progress.as_ref().unwrap().phase();
            if phases.last() != Some(&phase) {
                phases.push(phase);
            }
            if response.outcome.is_some() {
                assert!(
                    self.responses.message().await.unwrap().is_none(),
                    "nothing after the outcome"
                );
                return Ok((response, phases));
            }
        }
    }

    /// Returns the cause of the motion's stop.
    pub(crate) async fn stopped(&mut self) -> pb::BridgeStop {
        let (last, _) = self.last().await.unwrap();
        match last.outcome.unwrap().outcome.unwrap() {
            pb::motion_outcome::Outcome::Stopped(stop) => stop,
            done @ pb::motion_outcome::Outcome::Done(_) => panic!("{done:?}"),
        }
    }
}

/// Returns whether a reset with this refusal may succeed later.
fn is_passing(refusal: &str) -> bool {
    let passing = ["good states", "still move", "not confirmed", "stopped meanwhile"];
    refusal.starts_with("arm ") || passing.iter().any(|part| refusal.contains(part))
}

fn connect(address: SocketAddr) -> BridgeClient<Channel> {
    let endpoint = Channel::from_shared(format!("http://{address}")).unwrap();
    BridgeClient::new(endpoint.connect_lazy())
}

pub(crate) fn request(request: pb::execute_request::Request) -> pb::ExecuteRequest {
    pb::ExecuteRequest { request: Some(request) }
}

/// The initial positions of the tools, and positions further up and towards the middle; metres.
pub(crate) const READY_M: [[f64; 3]; 2] = [[-0.12, 0.0, 0.095], [0.12, 0.0, 0.095]];
pub(crate) const UP_M: [[f64; 3]; 2] = [[-0.10, 0.02, 0.115], [0.10, -0.02, 0.115]];

/// A motion of both tools from their present positions through `places`.
pub(crate) fn through(places: &[[[f64; 3]; 2]], speed: f64) -> pb::MotionRequest {
    let arm = |at_m: &[f64; 3]| pb::ArmWayPoint { tool_in_world_m: at_m.to_vec(), opening: 0.8 };
    let waypoints = pb::WayPoints {
        way_points: places
            .iter()
            .map(|arms| pb::BridgeWayPoint { arms: arms.iter().map(arm).collect() })
            .collect(),
        step_s: 0.04,
        from_here: true,
    };
    pb::MotionRequest { motion: Some(pb::motion_request::Motion::WayPoints(waypoints)), speed }
}

/// A motion up and back that takes minutes.
pub(crate) fn slow() -> pb::MotionRequest {
    through(&[UP_M, READY_M, UP_M, READY_M], 0.005)
}

/// A joint motion at its own speed.
pub(crate) fn joint_request(motion: &Motion) -> pb::MotionRequest {
    let sample = |sample: &ArmSample| pb::JointSample {
        angles_rad: sample.angles.to_vec(),
        velocities_radps: sample.velocities.to_vec(),
        opening: sample.gripper_opening,
    };
    let samples =
        |arm: &Vec<ArmSample>| pb::ArmMotion { samples: arm.iter().map(sample).collect() };
    let arms = motion.arms.iter().map(samples).collect();
    let joints = pb::JointMotion { period_s: motion.period_s, arms };
    pb::MotionRequest { motion: Some(pb::motion_request::Motion::JointMotion(joints)), speed: 1.0 }
}
