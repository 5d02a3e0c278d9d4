//! Arms behind Kinova's ROS 1 driver (`kinova-ros`), by way of rosbridge's websocket.
//!
//! Two nodes, one an arm, and one rosbridge. Below a node's name the driver uses (types, units and behaviour as of kinova-ros in
//! February 2023, read in its `kinova_arm.cpp`, `kinova_comm.cpp` and `kinova_fingers_action.cpp`):
//!
//! | name | type | what |
//! |---|---|---|
//! | `in/joint_velocity` | `kinova_msgs/JointVelocity` | published, and heard again: degrees per second; `joint7`, which the arms lack, carries the command's number in millionths |
//! | `out/joint_state` | `sensor_msgs/JointState` | heard: radians, radians per second, newton metres; fingers as joints |
//! | `fingers_action/finger_positions/goal`, `…/result` | `kinova_msgs/SetFingersPositionAction…` | published and heard: turns of the fingers |
//! | `in/stop`, `in/start` | `kinova_msgs/Stop`, `kinova_msgs/Start` | called; `in/stop` empties the arm's queue as well |
//!
//! `in/clear_trajectories` is not called: `in/stop` does the same and more, and the answer of the former means nothing (its handler
//! ends without one).
//!
//! **Velocities** are published once per exchange and arm, and at no other time. The arms want them at 100 Hz exactly: less often moves them
//! slower, more often fills a queue of 2000 in the arm, which is played to its end. A velocity that cannot be written at once is an error and not kept.
//!
//! **Nothing may pile up** in rosbridge either, because a burst of velocities is played to its end. The driver therefore hears its own
//! velocities: a command counts as done ([`PairState::newest_command`]) when those of all arms were published in ROS. An
//! executor stops when commands are too long under way, and cannot be reset while any is. A velocity that is heard and not the driver's own ends
//! the connection: somebody else is moving the arm.
//!
//! **To stop** nothing is published any more, and `in/stop` is called. The arm stops because nothing comes (the dead-man's switch:
//! a killed process publishes nothing), and the service keeps everybody else from moving it. With the first
//! [`Order::Move`] after a stop, which an executor gives only after a reset, `in/start` is called, and velocities are
//! published when it has answered. That takes kinova-ros some 50 ms in which it tells no states; [`settings`]
//! allow for that.
//!
//! **Grippers** move only while their arms stand, see [`FingerSettings`]. A motion should rest for a second where it opens or closes a gripper.
//!
//! **States.** A state of the pair is new when both arms have told anew, and has the older one's stamp. The arms do not tell faults. Efforts count as torques only where [`KinovaRosConfig::reports_torques`] says
//! that they are without the arm's own weight.
//!
//! A driver is for one connection. Whatever cannot be understood, a service that refuses or does not answer, and a lost connection end it: the
//! arms are told to stop if they still can be, and every later exchange fails with that first error. Going on takes a new
//! connection and a reset.

use std::time::Duration;

use crate::driver::{ArmCommand, Command, Driver, DriverError, Order, PairState};
use crate::executor::Settings;
use crate::kinova_ros::link::Link;
use crate::kinova_ros::merge::Merge;
use crate::kinova_ros::node::{Arm, Control, MOST_UNDER_WAY, Service};
use crate::kinova_ros::protocol::{Heard, Reading};

pub use fingers::FingerSettings;

mod fingers;
mod link;
mod merge;
mod node;
mod protocol;

/// Time from one exchange to the next, seconds. The arms take velocities at this rate and no other.
pub const PERIOD_S: f64 = 0.01;
/// Slices of the time in which the first state has to come.
const N_FIRST_WAITS: u32 = 100;

/// How to reach the arms.
#[derive(Debug, Clone, PartialEq)]
pub struct KinovaRosConfig {
    /// Where rosbridge listens: `host:port` or `ws://host:port`. Its own default port is 9090.
    pub address: String,
    /// The arms, in the order of the cell.
    pub arms: [KinovaArm; 2],
    /// How long to wait for the connection, and then for the first state. Default 3 s each.
    pub connect_timeout: Duration,
    /// Exchanges within which a service has to answer. Default 100.
    pub answer_exchanges: u32,
    /// What the stamps of the two arms' states may be apart, seconds. Default 0.1.
    pub skew_s: f64,
    /// Whether the nodes have `torque_parameters/publish_torque_with_gravity_compensation` set, so that efforts are torques
    /// beyond those that carry the arm. Default false: torques are not used.
    pub reports_torques: bool,
    /// When grippers get goals.
    pub fingers: FingerSettings,
}

/// An arm's names in ROS.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KinovaArm {
    /// The driver's node, `/left/m1n4s200_driver`: topics and services are below it.
    pub node: String,
    /// What the names of its joints begin with, `m1n4s200_`: the node's parameter `robot_name`, or else its type, and `_`.
    pub joint_prefix: String,
}

impl KinovaArm {
    /// A `m1n4s200` whose driver is the node `node`.
    #[must_use]
    pub fn mico(node: impl Into<String>) -> Self {
        Self { node: node.into(), joint_prefix: "m1n4s200_".into() }
    }
}

impl KinovaRosConfig {
    /// Defaults for two `m1n4s200` behind rosbridge at `address`, under `/left/m1n4s200_driver` and
    /// `/right/m1n4s200_driver`.
    #[must_use]
    pub fn at(address: impl Into<String>) -> Self {
        Self {
            address: address.into(),
            arms: ["left", "right"].map(|side| KinovaArm::mico(format!("/{side}/m1n4s200_driver"))),
            connect_timeout: Duration::from_secs(3),
            answer_exchanges: 100,
            skew_s: 0.1,
            reports_torques: false,
            fingers: FingerSettings::default(),
        }
    }
}

/// Settings of the executor to begin with. They allow for states that come at 40 Hz (what a USB connection gives), for
/// the 50 ms of `in/start` and for 60 ms through rosbridge; reaction and lag are guesses until somebody has measured the arms.
#[must_use]
pub fn settings() -> Settings {
    Settings {
        reaction_s: 0.080,
        lag_s: 0.050,
        state_hold_s: 0.030,
        state_stop_s: 0.150,
        command_s: 0.060,
        ..Settings::default()
    }
}

/// The arms behind one rosbridge.
#[derive(Debug)]
pub struct KinovaRosDriver {
    config: KinovaRosConfig,
    link: Link,
    arms: Vec<Arm>,
    merge: Merge,
    newest: PairState,
    /// Number of the last command.
    number: u64,
    /// Names for calls and goals.
    n_ids: u64,
    /// Why the connection has ended.
    failure: Option<DriverError>,
}

impl KinovaRosDriver {
    /// Dials rosbridge and waits for the first state of both arms. Moves and stops nothing.
    ///
    /// # Errors
    /// Says which address does not answer, or which arm does not tell where it is.
    pub fn connect(config: KinovaRosConfig) -> Result<Self, DriverError> {
        let address = config.address.trim_start_matches("ws://").trim_end_matches('/');
        let link = Link::connect(address, config.connect_timeout)?;
        let arm = |arm: &KinovaArm| Arm::new(&arm.node, config.fingers);
        let arms: Vec<Arm> = config.arms.iter().map(arm).collect();
        let merge = Merge::new(arms.len(), config.skew_s);
        let newest = PairState { sequence: 0, stamp_s: 0.0, newest_command: None, arms: vec![] };
        let mut driver =
            Self { config, link, arms, merge, newest, number: 0, n_ids: 0, failure: None };
        driver.introduce()?;
        let slice = driver.config.connect_timeout / N_FIRST_WAITS;
        for _ in 0..N_FIRST_WAITS {
            if driver.receive(slice)? {
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

    /// Returns the newest state, and waits for at most `patience` when it is known already. Sends nothing: for looking at arms that
    /// nobody commands.
    ///
    /// # Errors
    /// As an exchange.
    pub fn listen(&mut self, patience: Duration) -> Result<PairState, DriverError> {
        self.unless_failed(|driver| {
            driver.receive(patience)?;
            Ok(driver.state(driver.number))
        })
    }

    /// Says what will be published and what shall be heard.
    fn introduce(&mut self) -> Result<(), DriverError> {
        for arm in &self.arms {
            let velocity = arm.velocity_topic();
            let kind = "kinova_msgs/JointVelocity";
            let state = arm.topic("out/joint_state");
            let goal = "kinova_msgs/SetFingersPositionActionGoal";
            let result = "kinova_msgs/SetFingersPositionActionResult";
            self.link.say(protocol::advertise(&velocity, kind))?;
            self.link.say(protocol::subscribe_to_all(&velocity, kind))?;
            self.link.say(protocol::advertise(&arm.goal_topic(), goal))?;
            self.link.say(protocol::subscribe(&arm.result_topic(), result))?;
            self.link.say(protocol::subscribe(&state, "sensor_msgs/JointState"))?;
        }
        Ok(())
    }

    /// Does something that ends the connection when it fails.
    fn unless_failed<T>(
        &mut self,
        act: impl FnOnce(&mut Self) -> Result<T, DriverError>,
    ) -> Result<T, DriverError> {
        if let Some(failure) = &self.failure {
            return Err(failure.clone());
        }
        act(self).inspect_err(|failure| {
            for arm in 0..self.arms.len() {
                self.halt(arm).ok();
            }
            self.link.close();
            self.failure = Some(failure.clone());
        })
    }

    /// Takes what has come; waits once when that is no new state. Says whether there is one.
    fn receive(&mut self, patience: Duration) -> Result<bool, DriverError> {
        if self.drain()? {
            return Ok(true);
        }
        if patience.is_zero() {
            return Ok(false);
        }
        self.link.wait(patience)?;
        self.drain()
    }

    fn drain(&mut self) -> Result<bool, DriverError> {
        let Self { link, arms, merge, config, .. } = self;
        link.drain(|heard| take(heard, arms, merge, config))?;
        let Some(state) = self.merge.take()? else { return Ok(false) };
        self.newest = state;
        Ok(true)
    }

    /// Calls a service of an arm's node.
    fn ask(&mut self, arm: usize, service: Service) -> Result<(), DriverError> {
        let id = self.next_id();
        let topic = self.arms[arm].topic(service.name());
        self.arms[arm].control = Control::Asked { id: id.clone(), service, n: 0 };
        self.link.say(protocol::call(&id, &topic))
    }

    /// Stops an arm, unless that was asked for already.
    fn halt(&mut self, arm: usize) -> Result<(), DriverError> {
        self.arms[arm].fingers.stop();
        if self.arms[arm].asked_to_stop() {
            return Ok(());
        }
        self.ask(arm, Service::Stop)
    }

    /// Hands on what an arm shall do.
    fn drive(&mut self, arm: usize, number: u64, command: &ArmCommand) -> Result<(), DriverError> {
        if !(0.0..=1.0).contains(&command.opening) {
            let what = format!("opening {}, expected 0 to 1", command.opening);
            return Err(DriverError::Refused { what });
        }
        match self.arms[arm].control {
            Control::Unknown => {
                let what = "a new connection has to begin with an order to stop".into();
                Err(DriverError::Refused { what })
            }
            Control::Asked { .. } => Ok(()),
            Control::Stopped => self.ask(arm, Service::Start),
            Control::Started => self.publish(arm, number, command),
        }
    }

    /// Publishes velocities, or a goal for the fingers.
    fn publish(
        &mut self,
        arm: usize,
        number: u64,
        command: &ArmCommand,
    ) -> Result<(), DriverError> {
        let topic = self.arms[arm].velocity_topic();
        let velocities = protocol::velocities(&topic, number, &command.velocities)?;
        let standing_radps = self.config.fingers.standing_radps;
        let stands = command.velocities.iter().all(|rate| rate.abs() <= standing_radps);
        if let Some(opening) = self.arms[arm].fingers.next(command.opening, stands) {
            let id = self.next_id();
            let turns = reading(&self.config, arm).turns(opening);
            self.link.say(protocol::finger_goal(&self.arms[arm].goal_topic(), &id, turns))?;
            self.arms[arm].fingers.sent(id);
        }
        if self.arms[arm].fingers.busy() {
            return Ok(());
        }
        if self.arms[arm].under_way.len() >= MOST_UNDER_WAY {
            let what =
                format!("rosbridge holds {MOST_UNDER_WAY} velocities and does not publish them");
            return Err(DriverError::Disconnected { what });
        }
        self.arms[arm].under_way.push_back((number, command.velocities));
        self.link.say(velocities)
    }

    /// The newest state, and the newest command of which all is done when `number` was the last one.
    fn state(&self, number: u64) -> PairState {
        let oldest = self.arms.iter().filter_map(|arm| arm.under_way.front());
        let newest = oldest.map(|(under_way, _)| under_way - 1).min().unwrap_or(number);
        PairState { newest_command: Some(newest), ..self.newest.clone() }
    }

    fn next_id(&mut self) -> String {
        self.n_ids += 1;
        format!("tandem-{}", self.n_ids)
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
                Order::Stop => (0..driver.arms.len()).try_for_each(|arm| driver.halt(arm))?,
                Order::Move(commands) => {
                    let (got, expected) = (commands.len(), driver.arms.len());
                    if got != expected {
                        return Err(DriverError::Shape { got, expected });
                    }
                    for (arm, command) in commands.iter().enumerate() {
                        driver.drive(arm, number, command)?;
                    }
                }
            }
            driver.receive(Duration::ZERO)?;
            let most = driver.config.answer_exchanges;
            driver.arms.iter_mut().try_for_each(|arm| arm.await_answer(most))?;
            driver.number = number;
            Ok(driver.state(number))
        })
    }

    fn stop(&mut self) -> Result<(), DriverError> {
        self.unless_failed(|driver| (0..driver.arms.len()).try_for_each(|arm| driver.halt(arm)))
    }
}

/// Takes what rosbridge says.
fn take(
    heard: Heard,
    arms: &mut [Arm],
    merge: &mut Merge,
    config: &KinovaRosConfig,
) -> Result<(), DriverError> {
    match heard {
        Heard::Message { topic, msg } => {
            for (idx, arm) in arms.iter_mut().enumerate() {
                if topic == arm.topic("out/joint_state") {
                    let told = reading(config, idx).joint_state(&msg);
                    merge.note(idx, told.map_err(|error| of_node(error, &arm.node))?);
                } else if topic == arm.velocity_topic() {
                    arm.published(&msg)?;
                } else if topic == arm.result_topic()
                    && let Some(id) = protocol::ended_goal(&msg)
                {
                    arm.fingers.ended(id);
                }
            }
            Ok(())
        }
        Heard::Answer { id, result, values } => {
            let values = values.to_string();
            arms.iter_mut().try_for_each(|arm| arm.answered(&id, result, &values))
        }
        Heard::Complaint(what) => Err(DriverError::Refused { what: format!("rosbridge: {what}") }),
        Heard::Other => Ok(()),
    }
}

/// How to read what an arm tells.
fn reading(config: &KinovaRosConfig, arm: usize) -> Reading<'_> {
    Reading {
        prefix: &config.arms[arm].joint_prefix,
        shut_turns: config.fingers.shut_turns,
        reports_torques: config.reports_torques,
    }
}

/// The same error, and whose it is.
fn of_node(error: DriverError, node: &str) -> DriverError {
    match error {
        DriverError::Malformed { what } => {
            DriverError::Malformed { what: format!("{node}: {what}") }
        }
        error => error,
    }
}
