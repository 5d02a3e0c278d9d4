//! A stand-in for rosbridge and two nodes of kinova-ros: follows velocities only while they are published, moves
//! fingers by goals, and serves `in/stop` and `in/start`.

use std::collections::BTreeMap;
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread;
use std::time::Duration;

use serde_json::{Value, json};
use tandem_bridge::{ArmCommand, Command, Driver as _, Order, PairState};
use tandem_kinematics::Joints;
use tungstenite::{Message, WebSocket};

use crate::drivers::rig::SharedPair;

pub(crate) const NODES: [&str; 2] = ["/left/m1n4s200_driver", "/right/m1n4s200_driver"];
/// The duration of `in/start` in periods, in which a node does nothing else.
const START_PERIODS: u32 = 5;
/// The initial time of ROS' clock, seconds.
const EPOCH_S: u64 = 1_700_000_000;

/// A fault of the arms' side.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Fault {
    /// A position is `null`.
    Null,
    /// A position is `NaN`, which is not JSON.
    Nan,
    /// The joints have other names.
    Names,
    /// The connection is closed.
    Close,
    /// This many arms report nothing.
    Silent(usize),
    /// Every state is sent twice, followed by the previous one.
    Again,
    /// The second arm's clock is two seconds ahead.
    Clock,
    /// A service fails.
    Refuses(&'static str),
    /// Services do not respond.
    NoAnswers,
    /// rosbridge reports an error.
    Complains,
    /// rosbridge does not publish velocities.
    Lags,
    /// rosbridge drops some velocities, as a queue of length 1 does.
    Drops,
    /// Another node moves the first arm.
    Stranger,
}

/// The arms' side.
#[derive(Clone)]
pub(crate) struct Side {
    pub(crate) address: SocketAddr,
    ros: Arc<Mutex<Ros>>,
}

/// An arm's node.
#[derive(Default)]
pub(crate) struct Node {
    pub(crate) stopped: bool,
    /// The velocities of this period, radians per second.
    rates: Option<Joints>,
    opening: f64,
    goal: Option<(String, u32)>,
    /// The pending call of `in/start` and the periods until its response.
    starting: Option<(Value, u32)>,
    /// Messages with velocities.
    pub(crate) n_velocities: usize,
    /// Velocities that arrived while the fingers moved.
    pub(crate) n_while_busy: usize,
    /// Goals for the fingers, in turns.
    pub(crate) goals: Vec<Value>,
    /// The number of calls of a service.
    pub(crate) calls: BTreeMap<String, usize>,
}

pub(crate) struct Ros {
    pub(crate) nodes: [Node; 2],
    pub(crate) pair: SharedPair,
    pub(crate) fault: Option<Fault>,
    /// Periods between two states.
    pub(crate) every: u64,
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
            while !self.ros().by_hand {
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
        self.n_passes += 1;
        let command = Command { number: self.n_passes, order };
        let state = self.pair.lock().unwrap().exchange(&command).unwrap();
        self.end_goals(&state);
        self.finish_starts();
        let starting = self.nodes.iter().any(|node| node.starting.is_some());
        let due = self.n_passes.is_multiple_of(self.every) && !starting;
        let published = due && self.socket.is_some() && self.publish(&state);
        self.before = Some(state);
        published
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
        let arm = NODES.iter().position(|node| topic.starts_with(node)).unwrap();
        let name = topic[NODES[arm].len() + 1..].to_owned();
        let node = &mut self.nodes[arm];
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
                node.rates = Some(Joints::from_fn(4, |joint| rate(joint).unwrap().to_radians()));
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
            }
            ("call_service", _) => self.serve(arm, &name, &message["id"]),
            _ => panic!("{message}"),
        }
    }

    fn serve(&mut self, arm: usize, name: &str, id: &Value) {
        let node = &mut self.nodes[arm];
        *node.calls.entry(name.to_owned()).or_default() += 1;
        let refused =
            self.fault == Some(Fault::Refuses(if name == "in/stop" { "stop" } else { "start" }));
        if self.fault == Some(Fault::NoAnswers) {
            return;
        }
        match name {
            "in/stop" if !refused => (node.stopped, node.starting, node.goal) = (true, None, None),
            "in/start" if !refused => {
                node.starting = Some((id.clone(), START_PERIODS));
                return;
            }
            "in/stop" | "in/start" => {}
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
                self.nodes[arm].stopped = false;
                self.answer(arm, "in/start", &id, true);
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
        let mut msg = json!({
            "header": {"seq": 0, "stamp": stamp, "frame_id": ""},
            "name": names.map(|name| format!("{prefix}{name}")).collect::<Vec<_>>(),
            "position": positions.collect::<Vec<_>>(),
            "velocity": rates.collect::<Vec<_>>(),
            "effort": [0.0, 9.0, 4.0, 0.0, 0.0, 0.0, 0.0, 0.0],
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

impl Node {
    /// The command of the arm for the coming period: no motion without a velocity.
    fn command(&mut self) -> ArmCommand {
        let rates = self.rates.take().filter(|_| !self.stopped);
        ArmCommand {
            velocities: rates.unwrap_or_else(|| Joints::from_fn(4, |_| 0.0)),
            opening: self.opening.clamp(0.0, 1.0),
        }
    }
}
