//! A stand-in for rosbridge and two nodes of kinova-ros: follows velocities only while they are published, moves
//! fingers by goals, and serves `in/stop` and `in/start`.
//!
//! The nodes are ideal unless a test makes their calls slow ([`Side::slow_calls`]): they handle every message at once
//! and report the arms' state every period. With slow calls a node works as Kinova's does: one thread handles
//! velocities and the status timer in turn, each call of the arm's interface takes a while, and the newest velocity
//! replaces one that waits.

use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread;
use std::time::Duration;

use serde_json::{Value, json};
use tandem_bridge::{Command, Driver as _, Order, PairState};
use tandem_kinematics::Joints;
use tungstenite::{Message, WebSocket};

use crate::drivers::rig::SharedPair;

mod node;
pub(crate) use node::{Fault, Node};

pub(crate) const NODES: [&str; 2] = ["/left/m1n4s200_driver", "/right/m1n4s200_driver"];
/// The duration of `in/start` in periods, in which a node does nothing else.
const START_PERIODS: u32 = 5;
/// The same of `in/home_arm`.
const HOMING_PERIODS: u32 = 20;
/// Calls of the arm's interface in `statusTimer`: angles, command, rates, torques, twice the tool, its command, its
/// force, and the fingers twice.
const STATUS_CALLS: u64 = 9;
/// A period, microseconds.
const PERIOD_US: u64 = 10_000;
/// The initial time of ROS' clock, seconds.
const EPOCH_S: u64 = 1_700_000_000;

/// The arms' side.
#[derive(Clone)]
pub(crate) struct Side {
    pub(crate) address: SocketAddr,
    ros: Arc<Mutex<Ros>>,
}

pub(crate) struct Ros {
    pub(crate) nodes: [Node; 2],
    pub(crate) pair: SharedPair,
    pub(crate) fault: Option<Fault>,
    /// Periods between two states.
    pub(crate) every: u64,
    /// The time of a call of the arm's interface and the interval of the status timer, microseconds; `None` for ideal
    /// nodes.
    slow_us: Option<[u64; 2]>,
    /// True if the test advances time instead of a thread.
    by_hand: bool,
    socket: Option<WebSocket<TcpStream>>,
    subscribed: Vec<String>,
    n_passes: u64,
    before: Option<PairState>,
}

impl Side {
    pub(crate) fn new(pair: &SharedPair) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let opening = pair.lock().unwrap().skip_period().arms[0].opening;
        let node = || Node { opening, ..Node::default() };
        let ros = Ros {
            nodes: [node(), node()],
            pair: Arc::clone(pair),
            fault: None,
            every: 1,
            slow_us: None,
            by_hand: false,
            socket: None,
            subscribed: Vec::new(),
            n_passes: 0,
            before: None,
        };
        let side = Self { address: listener.local_addr().unwrap(), ros: Arc::new(Mutex::new(ros)) };
        let served = side.clone();
        thread::spawn(move || served.serve(&listener));
        side
    }

    /// Serves one peer after the other. Time advances by itself until the test takes over.
    fn serve(&self, listener: &TcpListener) {
        for stream in listener.incoming() {
            let Ok(socket) = tungstenite::accept(stream.unwrap()) else { continue };
            socket.get_ref().set_nodelay(true).unwrap();
            socket.get_ref().set_nonblocking(true).unwrap();
            let mut ros = self.ros();
            (ros.socket, ros.by_hand) = (Some(socket), false);
            drop(ros);
            let serves = |ros: MutexGuard<'_, Ros>| !ros.by_hand && ros.socket.is_some();
            while serves(self.ros()) {
                self.pass();
                thread::sleep(Duration::from_millis(1));
            }
        }
    }

    pub(crate) fn ros(&self) -> MutexGuard<'_, Ros> {
        self.ros.lock().unwrap()
    }

    pub(crate) fn take_over(&self) {
        self.ros().by_hand = true;
    }

    /// Gives the nodes one thread, calls that take `call_us`, and status timers of `status_us`, microseconds. The timers
    /// of the two nodes expire at different times.
    pub(crate) fn slow_calls(&self, call_us: u64, status_us: u64) {
        let mut ros = self.ros();
        ros.slow_us = Some([call_us, status_us]);
        let now_us = ros.n_passes * PERIOD_US;
        for (node, phase) in ros.nodes.iter_mut().zip([0, 3]) {
            (node.free_us, node.status_us) = (now_us, now_us + phase * status_us / 8);
        }
    }

    pub(crate) fn begin(&self, fault: Fault) {
        self.ros().fault = Some(fault);
    }

    /// Simulates a period. Returns true if both arms have published a state.
    pub(crate) fn pass(&self) -> bool {
        self.ros().pass()
    }
}

impl Ros {
    /// Returns true if a peer is connected.
    pub(crate) fn connected(&mut self) -> bool {
        self.hear();
        self.socket.is_some()
    }

    fn pass(&mut self) -> bool {
        self.hear();
        let commands = self.nodes.each_mut().map(|node| node.command());
        let stopped = self.nodes.iter().all(|node| node.stopped);
        let order = if stopped { Order::Stop } else { Order::Move(commands.to_vec()) };
        if let Some(slow_us) = self.slow_us {
            self.spin(slow_us);
        }
        self.n_passes += 1;
        let command = Command { number: self.n_passes, order };
        let state = self.pair.lock().unwrap().exchange(&command).unwrap();
        self.end_goals(&state);
        self.finish_starts();
        let starting = self.nodes.iter().any(|node| node.starting.is_some());
        let due = self.n_passes.is_multiple_of(self.every) && !starting && self.slow_us.is_none();
        let published = due && self.socket.is_some() && self.publish(&state);
        self.before = Some(state);
        published
    }

    /// The nodes' threads work until the end of the period. A status is that of the last period's end.
    fn spin(&mut self, [call_us, status_us]: [u64; 2]) {
        let end_us = (self.n_passes + 1) * PERIOD_US;
        for arm in 0..NODES.len() {
            loop {
                let node = &mut self.nodes[arm];
                let now_us = node.free_us.max(self.n_passes * PERIOD_US);
                if now_us >= end_us || node.starting.is_some() {
                    break;
                }
                // Both wait in one queue: whichever was handled last has to wait.
                if node.status_us <= now_us && !(node.status_last && node.waiting.is_some()) {
                    node.free_us = now_us + STATUS_CALLS * call_us;
                    node.status_us = (node.status_us + status_us).max(now_us);
                    node.status_last = true;
                    node.n_states += 1;
                    if let Some(state) = self.before.clone() {
                        self.tell_arm(arm, &state);
                    }
                } else if let Some(rates) = node.waiting.take() {
                    node.free_us = now_us + call_us;
                    node.status_last = false;
                    node.n_taken += 1;
                    node.points.push_back(rates);
                } else if node.status_us < end_us && node.status_us > now_us {
                    node.free_us = node.status_us;
                } else {
                    break;
                }
            }
        }
    }

    /// Reads all messages that have arrived.
    fn hear(&mut self) {
        while let Some(socket) = &mut self.socket {
            match socket.read() {
                Ok(Message::Text(text)) => self.obey(&serde_json::from_str(&text).unwrap()),
                Ok(_) => {}
                Err(tungstenite::Error::Io(error))
                    if error.kind() == std::io::ErrorKind::WouldBlock =>
                {
                    return;
                }
                Err(_) => {
                    self.socket = None;
                    self.subscribed.clear();
                }
            }
        }
    }

    fn obey(&mut self, message: &Value) {
        let topic = message["topic"].as_str().or(message["service"].as_str()).unwrap();
        if topic == "/rosout" {
            self.subscribed.push(topic.to_owned());
            return;
        }
        let arm = NODES.iter().position(|node| topic.starts_with(node)).unwrap();
        let name = topic[NODES[arm].len() + 1..].to_owned();
        let node = &mut self.nodes[arm];
        if let Some(id) = message.pointer("/msg/goal_id/id").and_then(Value::as_str)
            && !node.goal_ids.insert((name.clone(), id.to_owned()))
        {
            return;
        }
        match (message["op"].as_str().unwrap(), name.as_str()) {
            ("advertise", _) => assert_eq!(message["queue_size"], 1),
            ("subscribe", _) => {
                // A queue of states would deliver old ones first. No velocity may be dropped.
                let expected = u32::from(name != "in/joint_velocity");
                assert_eq!(message["queue_length"], expected);
                self.subscribed.push(topic.to_owned());
            }
            ("publish", "in/joint_velocity") => {
                let rate = |joint: usize| message["msg"][format!("joint{}", joint + 1)].as_f64();
                assert!((4..7).all(|joint| rate(joint).unwrap().abs() <= 0.001), "{message}");
                assert!(!node.stopped, "a velocity for a stopped arm");
                node.n_velocities += 1;
                if self.fault == Some(Fault::Drops) && node.n_velocities.is_multiple_of(10) {
                    return;
                }
                node.n_while_busy += usize::from(node.goal.is_some());
                let rates = Joints::from_fn(4, |joint| rate(joint).unwrap().to_radians());
                if self.slow_us.is_some() {
                    node.waiting = Some(rates);
                } else {
                    node.rates = Some(rates);
                }
                if self.fault != Some(Fault::Lags) && self.subscribed.iter().any(|t| t == topic) {
                    self.say(message);
                }
            }
            ("publish", "fingers_action/finger_positions/goal") => {
                let fingers = &message["msg"]["goal"]["fingers"];
                node.goals.push(fingers.clone());
                node.opening = 1.0 - fingers["finger1"].as_f64().unwrap() / 6400.0;
                let id = message["msg"]["goal_id"]["id"].as_str().unwrap();
                assert!(node.goal.replace((id.to_owned(), 0)).is_none(), "a goal was replaced");
                assert!(node.is_angular, "a finger goal with a Cartesian point");
            }
            ("publish", "joints_action/joint_angles/goal") => self.hold_angles(arm, message),
            ("call_service", _) => self.serve(arm, &name, &message["id"]),
            _ => panic!("{message}"),
        }
    }

    /// Handles a goal of joint angles, which must be those of the arm.
    fn hold_angles(&mut self, arm: usize, message: &Value) {
        let angle =
            |joint: usize| message["msg"]["goal"]["angles"][format!("joint{}", joint + 1)].as_f64();
        let goal = Joints::from_fn(4, |joint| angle(joint).unwrap().to_radians());
        let at = self.before.as_ref().unwrap().arms[arm].angles;
        assert!(goal.largest_difference(&at) < 1e-6, "the goal moves the arm");
        self.nodes[arm].is_angular = true;
        let id = &message["msg"]["goal_id"]["id"];
        let status = if self.fault == Some(Fault::Aborts) { 4 } else { 3 };
        let msg = json!({"status": {"goal_id": {"id": id}, "status": status, "text": ""}});
        let topic = format!("{}/joints_action/joint_angles/result", NODES[arm]);
        self.say(&json!({"op": "publish", "topic": topic, "msg": msg}));
    }

    fn serve(&mut self, arm: usize, name: &str, id: &Value) {
        let node = &mut self.nodes[arm];
        *node.calls.entry(name.to_owned()).or_default() += 1;
        let refused = self.fault
            == Some(match name {
                "in/stop" => Fault::Refuses("stop"),
                "in/start" => Fault::Refuses("start"),
                _ => Fault::Refuses("home_arm"),
            });
        if self.fault == Some(Fault::NoAnswers) {
            return;
        }
        match name {
            "in/stop" if !refused => (node.stopped, node.starting, node.goal) = (true, None, None),
            "in/start" if !refused => {
                node.starting = Some((id.clone(), START_PERIODS));
                return;
            }
            "in/home_arm" if !refused => {
                // Kinova's node reports success in this case as well.
                assert!(!node.stopped, "a stopped arm does not home");
                (node.starting, node.homing) = (Some((id.clone(), HOMING_PERIODS)), true);
                return;
            }
            "in/stop" | "in/start" | "in/home_arm" => {}
            _ => panic!("no service {name}"),
        }
        self.answer(arm, name, id, !refused);
    }

    fn answer(&mut self, arm: usize, name: &str, id: &Value, result: bool) {
        let values = if result { json!({}) } else { json!("Could not stop the control API") };
        let service = format!("{}/{name}", NODES[arm]);
        self.say(&json!({
            "op": "service_response", "id": id, "service": service, "values": values,
            "result": result,
        }));
    }

    fn finish_starts(&mut self) {
        for arm in 0..NODES.len() {
            let Some((id, n)) = self.nodes[arm].starting.take() else { continue };
            if n > 1 {
                self.nodes[arm].starting = Some((id, n - 1));
            } else {
                let node = &mut self.nodes[arm];
                node.stopped = false;
                node.is_angular = false;
                let name =
                    if std::mem::take(&mut node.homing) { "in/home_arm" } else { "in/start" };
                self.answer(arm, name, &id, true);
            }
        }
    }

    /// Ends goals whose fingers have arrived or stall.
    fn end_goals(&mut self, state: &PairState) {
        for (arm, name) in NODES.iter().enumerate() {
            let node = &mut self.nodes[arm];
            let Some((id, n)) = &mut node.goal else { continue };
            *n += 1;
            if (state.arms[arm].opening - node.opening).abs() < 0.01 || *n > 300 {
                let msg = json!({"status": {"goal_id": {"id": id}, "status": 3, "text": ""}});
                node.goal = None;
                let topic = format!("{name}/fingers_action/finger_positions/result");
                self.say(&json!({"op": "publish", "topic": topic, "msg": msg}));
            }
        }
    }

    /// Publishes the states of the arms. Returns true if both were published.
    fn publish(&mut self, state: &PairState) -> bool {
        match self.fault {
            Some(Fault::Close) => {
                self.socket = None;
                return false;
            }
            Some(Fault::Complains) => {
                self.say(&json!({"op": "status", "level": "error", "msg": "no such type"}));
            }
            Some(Fault::Stranger) => {
                let joints = (1..=7).map(|joint| (format!("joint{joint}"), json!(4.0)));
                let msg: serde_json::Map<String, Value> = joints.collect();
                let topic = format!("{}/in/joint_velocity", NODES[0]);
                self.say(&json!({"op": "publish", "topic": topic, "msg": msg}));
            }
            Some(Fault::Logs) => {
                let msg = json!({"level": 8, "name": NODES[1], "msg": "Could not get the angles"});
                self.say(&json!({"op": "publish", "topic": "/rosout", "msg": msg}));
                // Warnings, and errors of other nodes, do not stop the arms.
            }
            Some(Fault::Again) => {
                let before = self.before.clone().unwrap();
                for state in [state, &before] {
                    self.tell_arm(0, state);
                    self.tell_arm(1, state);
                }
            }
            _ => {}
        }
        let n = match self.fault {
            Some(Fault::Silent(n)) => 2 - n,
            _ => 2,
        };
        for arm in 0..n {
            self.tell_arm(arm, state);
        }
        // States whose stamps are far apart do not form a new sample.
        n == 2 && self.fault != Some(Fault::Clock)
    }

    fn tell_arm(&mut self, arm: usize, state: &PairState) {
        let topic = format!("{}/out/joint_state", NODES[arm]);
        if !self.subscribed.contains(&topic) {
            return;
        }
        let reading = &state.arms[arm];
        let late_s = if arm == 1 && self.fault == Some(Fault::Clock) { 2 } else { 0 };
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "some seconds")]
        let nanos = (state.stamp_s * 1e9).round() as u64;
        let stamp = json!({"secs": EPOCH_S + late_s + nanos / 1_000_000_000, "nsecs": nanos % 1_000_000_000});
        let names =
            ["joint_1", "joint_2", "joint_3", "joint_4", "joint_finger_1", "joint_finger_2"];
        let names = names.iter().chain(&["joint_finger_tip_1", "joint_finger_tip_2"]);
        let prefix = if self.fault == Some(Fault::Names) { "j2n4s300_" } else { "m1n4s200_" };
        let finger = ((1.0 - reading.opening) * 6400.0 * 80.0 / 6800.0).to_radians();
        let positions = reading.angles.iter().copied().chain([finger, finger, 0.0, 0.0]);
        let rates = reading.velocities.iter().copied().chain([0.0; 4]);
        let effort_nm = if arm == 0 && self.fault == Some(Fault::Presses) { 15.0 } else { 9.0 };
        let off = if arm == 1 && self.fault == Some(Fault::Elsewhere) { 3.0 } else { 0.0 };
        let commanded = (1..=7).map(|joint| {
            let angle = reading.angles.get(joint - 1).map_or(0.0, |angle| angle.to_degrees());
            (format!("joint{joint}"), json!(angle + off))
        });
        let commanded: serde_json::Map<String, Value> = commanded.collect();
        let command_topic = format!("{}/out/joint_command", NODES[arm]);
        self.say(&json!({"op": "publish", "topic": command_topic, "msg": commanded}));
        let mut msg = json!({
            "header": {"seq": 0, "stamp": stamp, "frame_id": ""},
            "name": names.map(|name| format!("{prefix}{name}")).collect::<Vec<_>>(),
            "position": positions.collect::<Vec<_>>(),
            "velocity": rates.collect::<Vec<_>>(),
            "effort": [0.0, effort_nm, 4.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        });
        if matches!(self.fault, Some(Fault::Null | Fault::Nan)) {
            msg["position"][1] = Value::Null;
        }
        let text = json!({"op": "publish", "topic": topic, "msg": msg}).to_string();
        let nan = self.fault == Some(Fault::Nan);
        self.say_text(if nan { text.replace("null", "NaN") } else { text });
    }

    fn say(&mut self, message: &Value) {
        self.say_text(message.to_string());
    }

    fn say_text(&mut self, text: String) {
        if let Some(socket) = &mut self.socket {
            // A closed connection is detected by the next read.
            socket.send(Message::text(text)).ok();
        }
    }
}
