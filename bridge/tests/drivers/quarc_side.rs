//! A stand-in for the Simulink model: a stream server that reads commands, sends states and brakes as required.

use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use tandem_bridge::quarc::arm_side::ArmSide;
use tandem_bridge::quarc::codec::{COMMAND_LEN, STATE_LEN, decode_command, from_bytes, to_bytes};
use tandem_bridge::{Command, Driver as _, Order, PairState};

use crate::drivers::rig::{PERIOD_S, SharedPair};

/// A fault of the states that are sent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Fault {
    /// Half of a vector and no further data.
    Short,
    /// A vector that lacks its last number.
    Narrow,
    /// The number at this index has this value.
    Number(usize, f64),
    /// The sequence jumps.
    Jump,
    /// The connection is closed.
    Close,
    /// No states are sent.
    Mute,
    /// A state is sent in two packets.
    Split,
    /// Two states are sent at once.
    Twice,
}

/// The arms' side.
pub(crate) struct Side {
    pub(crate) address: SocketAddr,
    pub(crate) pair: SharedPair,
    pub(crate) fault: Arc<Mutex<Option<Fault>>>,
    /// The number of ended connections after which the arms were without commands for a while.
    pub(crate) n_ended: Arc<AtomicUsize>,
    /// The commands of all connections.
    pub(crate) commands: Arc<Mutex<Vec<Command>>>,
}

impl Side {
    /// Listens on a free port.
    pub(crate) fn new(pair: &SharedPair) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let side = Self {
            address: listener.local_addr().unwrap(),
            pair: Arc::clone(pair),
            fault: Arc::default(),
            n_ended: Arc::default(),
            commands: Arc::default(),
        };
        let model = Model {
            pair: Arc::clone(&side.pair),
            fault: Arc::clone(&side.fault),
            commands: Arc::clone(&side.commands),
            side: ArmSide::new(PERIOD_S),
        };
        let n_ended = Arc::clone(&side.n_ended);
        thread::spawn(move || serve(&listener, model, &n_ended));
        side
    }

    pub(crate) fn begin(&self, fault: Fault) {
        *self.fault.lock().unwrap() = Some(fault);
    }

    pub(crate) fn end(&self) {
        *self.fault.lock().unwrap() = None;
    }

    pub(crate) fn n_ended(&self) -> usize {
        self.n_ended.load(Ordering::SeqCst)
    }
}

/// Serves one peer after the other. Sampling continues without a peer.
fn serve(listener: &TcpListener, mut model: Model, n_ended: &AtomicUsize) {
    for stream in listener.incoming() {
        model.side.set_connected(true);
        model.talk(stream.unwrap());
        model.side.set_connected(false);
        for _ in 0..20 {
            model.pair.lock().unwrap().skip_period();
        }
        n_ended.fetch_add(1, Ordering::SeqCst);
    }
}

struct Model {
    pair: SharedPair,
    fault: Arc<Mutex<Option<Fault>>>,
    commands: Arc<Mutex<Vec<Command>>>,
    side: ArmSide,
}

impl Model {
    fn talk(&mut self, mut stream: TcpStream) {
        stream.set_nodelay(true).unwrap();
        let mut number = 0;
        self.side.sample(true);
        let state = self.pair.lock().unwrap().skip_period();
        if !self.send(&mut stream, state) {
            return;
        }
        let mut bytes = [0; 8 * COMMAND_LEN];
        while stream.read_exact(&mut bytes).is_ok() {
            let vector = from_bytes(&bytes);
            self.side.receive(&vector).unwrap();
            let command = decode_command(&vector).unwrap();
            self.commands.lock().unwrap().push(command.clone());
            if command.number == number && command.order == Order::Stop {
                // Arrives next to the commands, between two samples.
                self.pair.lock().unwrap().stop().unwrap();
                continue;
            }
            number = command.number;
            let command = self.side.sample(true);
            let state = self.pair.lock().unwrap().exchange(&command).unwrap();
            if !self.send(&mut stream, state) {
                return;
            }
        }
    }

    /// Sends a state with the present fault. Returns true to continue.
    fn send(&mut self, stream: &mut TcpStream, state: PairState) -> bool {
        let fault = *self.fault.lock().unwrap();
        let mut vector = self.encode(state);
        match fault {
            Some(Fault::Number(idx, value)) => vector[idx] = value,
            Some(Fault::Jump) => vector[1] += 3.0,
            _ => {}
        }
        let mut bytes = to_bytes(&vector);
        match fault {
            Some(Fault::Close) => return false,
            Some(Fault::Mute) => return true,
            Some(Fault::Short) => {
                *self.fault.lock().unwrap() = Some(Fault::Mute);
                bytes.truncate(100);
            }
            Some(Fault::Narrow) => bytes.truncate(bytes.len() - 8),
            Some(Fault::Split) => {
                if stream.write_all(&bytes[..100]).is_err() {
                    return false;
                }
                thread::sleep(Duration::from_millis(1));
                bytes.drain(..100);
            }
            Some(Fault::Twice) => {
                let later = self.pair.lock().unwrap().skip_period();
                bytes.extend(to_bytes(&self.encode(later)));
            }
            _ => {}
        }
        stream.write_all(&bytes).is_ok()
    }

    fn encode(&mut self, state: PairState) -> [f64; STATE_LEN] {
        let vector = self.side.encode(state).unwrap();
        self.side.sent();
        vector
    }
}
