//! `tandem bridge arms`: the simulated pair as a process of its own, behind the protocol of a Simulink model.
//!
//! The process plays the part of real arms: it moves on when the bridge hangs, and its drives brake by themselves when
//! the bridge is killed. `docs/drivers.md`, section QUARC, has the rules that the model follows.

use std::io::{self, ErrorKind, Read as _};
use std::net::{SocketAddr, TcpListener, TcpStream};

use tandem_bridge::quarc::arm_side::{ArmSide, VectorSender};
use tandem_bridge::quarc::codec::{COMMAND_LEN, from_bytes, to_bytes};
use tandem_bridge::service::Clock as _;
use tandem_bridge::{Driver as _, DriverError, PairState};
use tandem_trials::SimulatedPair;
use tandem_trials::simulated::PERIOD_S;
use tokio_util::sync::CancellationToken;

use super::cell::Cell;
use super::{arms, priority, runtime};
use crate::cli::{ArmsServeArgs, DriverName};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{clock, output, signals};

/// Bytes of a command.
const COMMAND_BYTES: usize = COMMAND_LEN * size_of::<f64>();
/// Samples without a command after which a connection that has sent commands is closed: 1 s.
const IDLE_SAMPLES: u32 = 100;
/// Highest speed of a joint at rest, radians per second.
const REST_RADPS: f64 = 1e-3;

/// Runs the arms until the process is interrupted.
pub(super) fn serve(args: &ArmsServeArgs) -> Result<(), Failed> {
    let cell = Cell::load(args.cell.as_deref())?;
    let settings = cell.settings(DriverName::Sim);
    let pair = arms::simulated(args.seed, &cell.file, &settings)?;
    let listener = TcpListener::bind(args.listen).and_then(|listener| {
        listener.set_nonblocking(true)?;
        Ok((listener.local_addr()?, listener))
    });
    let cannot = || format!("cannot listen on {}", args.listen);
    let (address, listener) = listener.or_exit(Exit::TryAgain, cannot)?;
    output::print(format_args!("listening on {address}"))?;
    let runtime = runtime().or_exit(Exit::TryAgain, String::new)?;
    runtime.block_on(async move {
        let interrupted = signals::shutdown_token(false)?;
        let model = Model {
            pair,
            listener,
            side: ArmSide::new(PERIOD_S),
            peer: None,
            has_obeyed: false,
            is_tripped: true,
            is_told: false,
        };
        let running = tokio::task::spawn_blocking(move || model.run(&interrupted));
        running.await.or_exit(Exit::Bug, String::new)?
    })
}

/// The arms and their connection.
struct Model {
    pair: SimulatedPair,
    listener: TcpListener,
    side: ArmSide,
    peer: Option<Peer>,
    /// True if the drives have ever obeyed a bridge.
    has_obeyed: bool,
    /// True if the drives have braked by themselves.
    is_tripped: bool,
    /// True once a line has reported that the arms are at rest after that.
    is_told: bool,
}

/// A connected bridge.
struct Peer {
    stream: TcpStream,
    address: SocketAddr,
    received: Vec<u8>,
    sender: VectorSender,
    /// True if a command has arrived.
    has_command: bool,
    /// Samples since the last command.
    n_idle: u32,
}

impl Model {
    fn run(mut self, interrupted: &CancellationToken) -> Result<(), Failed> {
        priority::raise_if_permitted();
        let clock = clock::BridgeClock::new();
        let mut at_s = clock.now_s();
        while !interrupted.is_cancelled() {
            // After a pause of the whole machine, simulated time continues from there.
            at_s = (at_s + PERIOD_S).max(clock.now_s() - 10.0 * PERIOD_S);
            clock.sleep_until(at_s);
            self.accept()?;
            self.sample()?;
        }
        Ok(())
    }

    /// Accepts a bridge if none is connected.
    fn accept(&mut self) -> Result<(), Failed> {
        if self.peer.is_some() {
            return Ok(());
        }
        let Ok((stream, address)) = self.listener.accept() else { return Ok(()) };
        if stream.set_nonblocking(true).and_then(|()| stream.set_nodelay(true)).is_err() {
            return Ok(());
        }
        self.peer = Some(Peer {
            stream,
            address,
            received: Vec::new(),
            sender: VectorSender::default(),
            has_command: false,
            n_idle: 0,
        });
        self.side.set_connected(true);
        self.tell(format_args!("connected: {address}"))
    }

    /// Passes a sample: takes the commands that have arrived, simulates a period and sends the state.
    fn sample(&mut self) -> Result<(), Failed> {
        let n_commands = match self.receive() {
            Ok((n_commands, None)) => n_commands,
            Ok((n_commands, Some(fault))) => {
                self.tell(format_args!("a malformed command: {fault}"))?;
                n_commands
            }
            Err(why) => {
                self.disconnect(&why)?;
                0
            }
        };
        let command = self.side.sample(true);
        // The pair's own drives also brake if no command arrives.
        let state = if n_commands > 0 || self.side.is_tripped() != self.is_tripped {
            self.pair.exchange(&command).or_exit(Exit::Bug, String::new)?
        } else {
            self.pair.skip_period()
        };
        self.tell_drives()?;
        match self.send(state) {
            Ok(()) => Ok(()),
            Err(why) => self.disconnect(&why),
        }
    }

    /// Takes the commands that have arrived. Returns their number, and what was wrong with one if its predecessors were
    /// good.
    fn receive(&mut self) -> io::Result<(usize, Option<String>)> {
        let Some(peer) = &mut self.peer else { return Ok((0, None)) };
        let commands = peer.arrived()?;
        let mut fault = None;
        for command in &commands {
            let was_tripped = self.side.is_tripped();
            if let Err(DriverError::Malformed { what }) = self.side.receive(&from_bytes(command))
                && !was_tripped
            {
                fault = Some(what);
            }
        }
        Ok((commands.len(), fault))
    }

    /// Sends a state, or drops it if the connection takes no more.
    fn send(&mut self, state: PairState) -> io::Result<()> {
        let Some(peer) = &mut self.peer else { return Ok(()) };
        let vector = to_bytes(&self.side.encode(state).map_err(io::Error::other)?);
        if peer.sender.send(&mut peer.stream, &vector)? {
            self.side.sent();
        }
        Ok(())
    }

    fn disconnect(&mut self, why: &io::Error) -> Result<(), Failed> {
        let Some(peer) = self.peer.take() else { return Ok(()) };
        self.side.set_connected(false);
        self.tell(format_args!("disconnected: {}: {why}", peer.address))
    }

    /// Tells when the drives brake by themselves and when the arms are at rest after that.
    fn tell_drives(&mut self) -> Result<(), Failed> {
        let was_tripped = std::mem::replace(&mut self.is_tripped, self.side.is_tripped());
        // Before a bridge has connected, drives without commands are no event.
        self.has_obeyed |= !self.is_tripped;
        if !(self.is_tripped && self.has_obeyed) {
            self.is_told = false;
            return Ok(());
        }
        if !was_tripped {
            self.tell("the drives brake by themselves")?;
        }
        if self.is_at_rest() && !std::mem::replace(&mut self.is_told, true) {
            self.tell("the arms are at rest")?;
        }
        Ok(())
    }

    fn is_at_rest(&self) -> bool {
        let arms = 0..self.pair.cell().arms.len();
        let mut rates = arms.flat_map(|arm| {
            self.pair.velocities(tandem_core::ArmIndex(arm)).iter().copied().collect::<Vec<_>>()
        });
        rates.all(|rate| rate.abs() <= REST_RADPS)
    }

    /// Prints an event with the time of the arms.
    fn tell(&self, what: impl std::fmt::Display) -> Result<(), Failed> {
        output::print(format_args!("{:.2} s: {what}", self.pair.time_s()))
    }
}

impl Peer {
    /// Returns the bytes of each command that has arrived whole since the last call. An idle connection ends.
    fn arrived(&mut self) -> io::Result<Vec<Vec<u8>>> {
        let mut bytes = [0; 8 * COMMAND_BYTES];
        loop {
            match self.stream.read(&mut bytes) {
                Ok(0) => return Err(ErrorKind::ConnectionReset.into()),
                Ok(n) => self.received.extend_from_slice(&bytes[..n]),
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        let n_whole = self.received.len() / COMMAND_BYTES * COMMAND_BYTES;
        let whole: Vec<u8> = self.received.drain(..n_whole).collect();
        self.has_command |= n_whole > 0;
        self.n_idle = if n_whole > 0 { 0 } else { self.n_idle + 1 };
        if self.has_command && self.n_idle >= IDLE_SAMPLES {
            return Err(io::Error::other("no command for 1 s"));
        }
        Ok(whole.chunks_exact(COMMAND_BYTES).map(<[u8]>::to_vec).collect())
    }
}
