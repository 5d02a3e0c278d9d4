//! Arms behind Kinova's ROS 1 driver (`kinova-ros`), through rosbridge's websocket.
//!
//! There are two nodes, one per arm, and one rosbridge. The driver uses the following names below a node's name. Types,
//! units and behaviour are those of kinova-ros in February 2023 (`kinova_arm.cpp`, `kinova_comm.cpp`,
//! `kinova_fingers_action.cpp`).
//!
//! | name | type | use |
//! |---|---|---|
//! | `in/joint_velocity` | `kinova_msgs/JointVelocity` | published and subscribed: degrees per second |
//! | `out/joint_state` | `sensor_msgs/JointState` | subscribed: rad, rad/s, N m; fingers as joints |
//! | `fingers_action/finger_positions/goal` | `kinova_msgs/SetFingersPositionActionGoal` | published: turns of the fingers |
//! | `fingers_action/finger_positions/result` | `kinova_msgs/SetFingersPositionActionResult` | subscribed |
//! | `joints_action/joint_angles/goal` | `kinova_msgs/ArmJointAnglesActionGoal` | published: degrees |
//! | `joints_action/joint_angles/result` | `kinova_msgs/ArmJointAnglesActionResult` | subscribed |
//! | `out/joint_command` | `kinova_msgs/JointAngles` | subscribed: the arm's own command, degrees |
//! | `/rosout` | `rosgraph_msgs/Log` | subscribed: errors of the two nodes |
//! | `in/home_arm` | `kinova_msgs/HomeArm` | called by [`home`] only |
//! | `in/stop`, `in/start` | `kinova_msgs/Stop`, `kinova_msgs/Start` | called; `in/stop` also empties the arm's queue |
//!
//! `joint7` of a velocity, which the arms lack, carries the command's number in millionths. `in/clear_trajectories` is
//! not called: `in/stop` includes its effect, and its response is meaningless because its handler returns none.
//!
//! **Velocities** are published once per exchange and arm, and at no other time. The arms require exactly 100 Hz: a
//! lower rate slows them down, and a higher one fills a queue of 2000 entries in the arm, all of which are executed. A
//! velocity that cannot be written at once is an error and is discarded.
//!
//! **No backlog** may form in rosbridge either, because the arm would execute all of it. The driver therefore
//! subscribes to its own velocities: a command has taken effect ([`PairState::newest_command`]) once the velocities of
//! all arms were published in ROS. An executor stops if commands are in flight for too long, and cannot be reset while
//! there are any. A velocity of another publisher ends the connection.
//!
//! **Velocities that the arm misses** show in its motion only, see `following.rs`: an arm that turns by less than 65 %
//! of what its velocities ask for ends the connection.
//!
//! **To stop**, the driver ceases to publish and calls `in/stop`. The arm stops because it receives no velocities, also
//! when the process is killed, and the service prevents other clients from moving it. On the first [`Order::Move`]
//! after a stop, which an executor sends only after a reset, the driver calls `in/start` and publishes velocities after
//! its response. kinova-ros reports no states for about 50 ms meanwhile; [`settings`] allows for that.
//!
//! **Grippers** move only while their arms are stationary, see [`FingerSettings`], and after the arm was switched to
//! angular control, see `preparation.rs`. A motion should pause for a second where it opens or closes a gripper.
//!
//! **States.** A state of the pair is new once both arms have reported, and has the older time stamp. The arms report
//! no faults: an error in a node's log, a service that fails and silence stop the arms. [`Efforts`] tells how efforts
//! become torques.
//!
//! A driver serves one connection. A malformed message, a service that fails or does not respond, and a lost connection
//! end it: the driver stops the arms if it still can, and every later exchange returns that first error. To continue,
//! create a new driver and reset the executor.

use std::time::Duration;

use tandem_kinematics::Joints;

use crate::driver::{ArmCommand, Command, Driver, DriverError, Order, PairState};
use crate::executor::Settings;
use crate::kinova_ros::merge::StateMerger;
use crate::kinova_ros::node::{ArmNode, Control, MAX_IN_FLIGHT, Service};
use crate::kinova_ros::preparation::Preparation;
use crate::kinova_ros::protocol::{ArmDecoder, RosMessage};
use crate::kinova_ros::websocket::RosbridgeSocket;

pub use config::{Efforts, KinovaArm, KinovaRosConfig};
pub use fingers::FingerSettings;
pub use homing::{HomingError, home};

mod config;
mod efforts;
mod fingers;
mod following;
mod homing;
mod merge;
mod node;
mod preparation;
mod protocol;
mod stopping;
mod websocket;

/// Time from one exchange to the next, seconds. The arms take velocities at this rate only.
pub const PERIOD_S: f64 = 0.01;
/// The topic of the arm's own joint command, below a node's name.
const COMMAND_TOPIC: &str = "out/joint_command";
/// The topics of the action for joint angles, below a node's name.
const ANGLES_GOAL: &str = "joints_action/joint_angles/goal";
const ANGLES_RESULT: &str = "joints_action/joint_angles/result";
/// The topic of all nodes' logs.
const LOG_TOPIC: &str = "/rosout";
/// Number of waits in the time limit of the first state.
const N_FIRST_WAITS: u32 = 100;

/// Returns initial settings of the executor. They allow for states at 10 Hz whose arms report at different times, for
/// the 50 ms of `in/start` and for 60 ms through rosbridge. Reaction and lag are estimates until they are measured on
/// the arms.
#[must_use]
pub fn settings() -> Settings {
    Settings {
        // A pair's state is new with the later arm's report; the other arm's may be a report older.
        reaction_s: 0.180,
        lag_s: 0.050,
        state_hold_s: 0.130,
        state_stop_s: 0.250,
        command_s: 0.060,
        ..Settings::default()
    }
}

/// The driver of the arms behind one rosbridge.
#[derive(Debug)]
pub struct KinovaRosDriver {
    config: KinovaRosConfig,
    socket: RosbridgeSocket,
    arms: Vec<ArmNode>,
    merge: StateMerger,
    newest: PairState,
    /// The number of the last command.
    number: u64,
    /// Counts the identifiers of calls and goals.
    n_ids: u64,
    /// The time stamp of the first state, seconds. No other connection has the same one.
    first_stamp_s: f64,
    /// True while the connection only listens: a failure stops no arm, since another program may be moving it.
    is_passive: bool,
    /// The error that ended the connection.
    failure: Option<DriverError>,
}

impl KinovaRosDriver {
    /// Connects to rosbridge and waits for the first state of both arms. Neither moves nor stops the arms.
    ///
    /// # Errors
    /// Returns an error if the address does not respond or an arm reports no state.
    pub fn connect(config: KinovaRosConfig) -> Result<Self, DriverError> {
        let address = config.address.trim_start_matches("ws://").trim_end_matches('/');
        let socket = RosbridgeSocket::connect(address, config.connect_timeout)?;
        let arm = |arm: &KinovaArm| ArmNode::new(&arm.node, config.fingers);
        let arms: Vec<ArmNode> = config.arms.iter().map(arm).collect();
        let merge = StateMerger::new(arms.len(), config.skew_s);
        let newest = PairState { sequence: 0, stamp_s: 0.0, newest_command: None, arms: vec![] };
        let mut driver = Self {
            config,
            socket,
            arms,
            merge,
            newest,
            number: 0,
            n_ids: 0,
            first_stamp_s: 0.0,
            is_passive: false,
            failure: None,
        };
        driver.register_topics()?;
        let slice = driver.config.connect_timeout / N_FIRST_WAITS;
        for _ in 0..N_FIRST_WAITS {
            if driver.receive(slice)? {
                driver.first_stamp_s = driver.newest.stamp_s;
                return Ok(driver);
            }
        }
        let nodes: Vec<&str> = driver.arms.iter().map(|arm| arm.node.as_str()).collect();
        let what = format!(
            "no out/joint_state of both {} within {:?}: do the nodes run, under these names?",
            nodes.join(" and "),
            driver.config.connect_timeout
        );
        Err(DriverError::Disconnected { what })
    }

    /// Returns the newest state, and waits at most `timeout` for a new one. Sends no command, so it suits arms that are
    /// only monitored.
    ///
    /// # Errors
    /// As [`Driver::exchange`].
    pub fn listen(&mut self, timeout: Duration) -> Result<PairState, DriverError> {
        self.unless_failed(|driver| {
            driver.receive(timeout)?;
            Ok(driver.state(driver.number))
        })
    }

    /// Advertises and subscribes to the topics of all arms.
    fn register_topics(&mut self) -> Result<(), DriverError> {
        for arm in &self.arms {
            let velocity = arm.velocity_topic();
            let kind = "kinova_msgs/JointVelocity";
            let state = arm.topic("out/joint_state");
            let goal = "kinova_msgs/SetFingersPositionActionGoal";
            let result = "kinova_msgs/SetFingersPositionActionResult";
            self.socket.send(protocol::advertise(&velocity, kind))?;
            self.socket.send(protocol::subscribe_to_all(&velocity, kind))?;
            self.socket.send(protocol::advertise(&arm.goal_topic(), goal))?;
            self.socket.send(protocol::subscribe(&arm.result_topic(), result))?;
            self.socket.send(protocol::subscribe(&state, "sensor_msgs/JointState"))?;
            let commanded = arm.topic(COMMAND_TOPIC);
            self.socket.send(protocol::subscribe(&commanded, "kinova_msgs/JointAngles"))?;
            let goal = "kinova_msgs/ArmJointAnglesActionGoal";
            let result = "kinova_msgs/ArmJointAnglesActionResult";
            self.socket.send(protocol::advertise(&arm.topic(ANGLES_GOAL), goal))?;
            self.socket.send(protocol::subscribe(&arm.topic(ANGLES_RESULT), result))?;
        }
        self.socket.send(protocol::subscribe_to_all(LOG_TOPIC, "rosgraph_msgs/Log"))
    }

    /// Runs `action` unless the connection has failed. An error ends the connection and is kept.
    fn unless_failed<T>(
        &mut self,
        action: impl FnOnce(&mut Self) -> Result<T, DriverError>,
    ) -> Result<T, DriverError> {
        if let Some(failure) = &self.failure {
            return Err(failure.clone());
        }
        action(self).inspect_err(|failure| {
            let n_stopped = if self.is_passive { 0 } else { self.arms.len() };
            for arm in 0..n_stopped {
                self.stop_arm(arm).ok();
            }
            self.await_stops();
            self.socket.close();
            self.failure = Some(failure.clone());
        })
    }

    /// Receives all waiting messages, and waits once if they complete no state. Returns true if there is a new state.
    fn receive(&mut self, timeout: Duration) -> Result<bool, DriverError> {
        if self.drain()? {
            return Ok(true);
        }
        if timeout.is_zero() {
            return Ok(false);
        }
        self.socket.wait(timeout)?;
        self.drain()
    }

    fn drain(&mut self) -> Result<bool, DriverError> {
        let Self { socket, arms, merge, config, .. } = self;
        socket.drain(|message| handle(message, arms, merge, config))?;
        let Some(state) = self.merge.take()? else { return Ok(false) };
        self.newest = state;
        Ok(true)
    }

    /// Calls a service of an arm's node.
    fn call_service(&mut self, arm: usize, service: Service) -> Result<(), DriverError> {
        let id = self.next_id();
        let topic = self.arms[arm].topic(service.name());
        self.arms[arm].control = Control::Pending { id: id.clone(), service, n: 0 };
        self.socket.send(protocol::call(&id, &topic))
    }

    /// Stops an arm, unless that was requested already.
    fn stop_arm(&mut self, arm: usize) -> Result<(), DriverError> {
        self.arms[arm].fingers.stop();
        self.arms[arm].preparation = None;
        self.arms[arm].following.clear();
        if self.arms[arm].is_stopping() {
            return Ok(());
        }
        self.call_service(arm, Service::Stop)
    }

    /// Forwards a command to an arm. Returns true if its velocities were published.
    fn drive(
        &mut self,
        arm: usize,
        number: u64,
        command: &ArmCommand,
    ) -> Result<bool, DriverError> {
        if !(0.0..=1.0).contains(&command.opening) {
            let what = format!("opening {}, expected 0 to 1", command.opening);
            return Err(DriverError::Refused { what });
        }
        match self.arms[arm].control {
            Control::Unknown => {
                let what = "a new connection has to start with an order to stop".into();
                Err(DriverError::Refused { what })
            }
            Control::Pending { .. } => Ok(false),
            Control::Stopped => self.call_service(arm, Service::Start).map(|()| false),
            Control::Started => self.publish(arm, number, command),
        }
    }

    /// Publishes velocities, or a goal of the fingers. Returns true if it published velocities.
    fn publish(
        &mut self,
        arm: usize,
        number: u64,
        command: &ArmCommand,
    ) -> Result<bool, DriverError> {
        let topic = self.arms[arm].velocity_topic();
        let velocities = protocol::velocities(&topic, number, &command.velocities)?;
        let stationary_radps = self.config.fingers.stationary_radps;
        let stationary = command.velocities.iter().all(|rate| rate.abs() <= stationary_radps);
        if let Some(step) = self.arms[arm].preparation.take() {
            return self.prepare_fingers(arm, step).map(|()| false);
        }
        if let Some(opening) = self.arms[arm].fingers.next(command.opening, stationary) {
            let sequence = self.newest.sequence;
            self.arms[arm].preparation = Some(Preparation::Settling { opening, sequence, n: 0 });
            return Ok(false);
        }
        if self.arms[arm].fingers.is_overdue() {
            let what = format!("{} does not end", self.arms[arm].goal_topic());
            return Err(DriverError::Refused { what });
        }
        if self.arms[arm].fingers.busy() {
            return Ok(false);
        }
        if self.arms[arm].in_flight.len() >= MAX_IN_FLIGHT {
            let what =
                format!("rosbridge holds {MAX_IN_FLIGHT} velocities and does not publish them");
            return Err(DriverError::Disconnected { what });
        }
        self.arms[arm].in_flight.push_back((number, command.velocities));
        self.socket.send(velocities)?;
        Ok(true)
    }

    /// Returns the newest state with the number of the newest command that was published for all arms; `number` is the
    /// last command.
    fn state(&self, number: u64) -> PairState {
        let oldest = self.arms.iter().filter_map(|arm| arm.in_flight.front());
        let newest = oldest.map(|(number, _)| number - 1).min().unwrap_or(number);
        PairState { newest_command: Some(newest), ..self.newest.clone() }
    }

    /// Returns an identifier that no call or goal of this or an earlier connection has. Nodes outlive connections, and
    /// actionlib ignores a goal whose identifier it knows.
    fn next_id(&mut self) -> String {
        self.n_ids += 1;
        format!("tandem-{:.6}-{}", self.first_stamp_s, self.n_ids)
    }
}

impl Driver for KinovaRosDriver {
    fn period_s(&self) -> f64 {
        PERIOD_S
    }

    fn exchange(&mut self, command: &Command) -> Result<PairState, DriverError> {
        let number = command.number;
        self.unless_failed(|driver| {
            match &command.order {
                Order::Stop => (0..driver.arms.len()).try_for_each(|arm| driver.stop_arm(arm))?,
                Order::Move(commands) => {
                    let (got, expected) = (commands.len(), driver.arms.len());
                    if got != expected {
                        return Err(DriverError::Shape { got, expected });
                    }
                    for (arm, command) in commands.iter().enumerate() {
                        let published = driver.drive(arm, number, command)?;
                        let share = if published { 1.0 } else { 0.0 };
                        let sent = Joints::from_fn(command.velocities.len(), |joint| {
                            share * command.velocities[joint]
                        });
                        driver.arms[arm].following.push_velocities(&sent);
                    }
                }
            }
            driver.receive(Duration::ZERO)?;
            let max_exchanges = driver.config.answer_exchanges;
            driver.arms.iter_mut().try_for_each(|arm| arm.count_exchange(max_exchanges))?;
            driver.number = number;
            Ok(driver.state(number))
        })
    }

    fn stop(&mut self) -> Result<(), DriverError> {
        self.unless_failed(|driver| (0..driver.arms.len()).try_for_each(|arm| driver.stop_arm(arm)))
    }

    fn disconnect(&mut self, reason: &DriverError) {
        self.unless_failed(|_| Err::<(), _>(reason.clone())).ok();
    }

    /// Returns true if every node has answered the call of `in/stop`.
    fn confirms_stop(&self) -> bool {
        self.failure.is_none() && self.arms.iter().all(|arm| arm.control == Control::Stopped)
    }
}

/// Handles a message of rosbridge.
fn handle(
    message: RosMessage,
    arms: &mut [ArmNode],
    merge: &mut StateMerger,
    config: &KinovaRosConfig,
) -> Result<(), DriverError> {
    match message {
        RosMessage::Publish { topic, msg } if topic == LOG_TOPIC => {
            arms.iter().try_for_each(|arm| arm.handle_log(&msg))
        }
        RosMessage::Publish { topic, msg } => {
            for (idx, arm) in arms.iter_mut().enumerate() {
                if topic == arm.topic("out/joint_state") {
                    let state = decoder(config, idx).joint_state(&msg);
                    let mut state = state.map_err(|error| with_node(error, &arm.node))?;
                    if let Efforts::Changes { mean_s } = config.efforts {
                        arm.mean_efforts.subtract(mean_s, &mut state);
                    }
                    arm.handle_state(state.stamp_s, &state.reading.angles)?;
                    merge.push(idx, state);
                } else if topic == arm.velocity_topic() {
                    arm.handle_velocity(&msg)?;
                } else if topic == arm.topic(COMMAND_TOPIC) {
                    arm.commanded = protocol::joint_degrees(&msg);
                } else if topic == arm.topic(ANGLES_RESULT) {
                    arm.handle_angles_result(&msg)?;
                } else if topic == arm.result_topic()
                    && let Some(id) = protocol::ended_goal(&msg)
                {
                    arm.fingers.goal_ended(id);
                }
            }
            Ok(())
        }
        RosMessage::ServiceResponse { id, result, values } => {
            let values = values.to_string();
            arms.iter_mut().try_for_each(|arm| arm.handle_response(&id, result, &values))
        }
        RosMessage::Error(what) => Err(DriverError::Refused { what: format!("rosbridge: {what}") }),
        RosMessage::Other => Ok(()),
    }
}

/// Returns the decoder of an arm's messages.
fn decoder(config: &KinovaRosConfig, arm: usize) -> ArmDecoder<'_> {
    ArmDecoder {
        prefix: &config.arms[arm].joint_prefix,
        shut_turns: config.fingers.shut_turns,
        reports_torques: config.efforts != Efforts::Unused,
    }
}

/// Adds the name of the node to a malformed message's error.
fn with_node(error: DriverError, node: &str) -> DriverError {
    match error {
        DriverError::Malformed { what } => {
            DriverError::Malformed { what: format!("{node}: {what}") }
        }
        error => error,
    }
}
