//! `tandem bridge arms`: the simulated pair as a process of its own, behind the protocol of a Simulink model.
//!
//! The process plays the part of real arms: it moves on when the bridge hangs, and its drives brake by themselves when
//! the bridge is killed. [`tandem_bridge::quarc`] lists what the model has to do.

use std::io::{self, ErrorKind, Read as _, Write as _};
use std::net::{SocketAddr, TcpListener, TcpStream};

use tandem_bridge::driver::SILENCE_S;
use tandem_bridge::quarc::codec::{
    COMMAND_LEN, decode_command, encode_state, from_bytes, to_bytes,
};
use tandem_bridge::service::Clock as _;
use tandem_bridge::{Command, Driver as _, Order, PairState};
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
            peer: None,
            n_states: 0,
            has_obeyed: false,
            is_tripped: false,
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
    peer: Option<Peer>,
    n_states: u64,
    /// Whether the drives have ever obeyed a bridge.
    has_obeyed: bool,
    /// Whether the drives have braked by themselves.
    is_tripped: bool,
    /// Whether that the arms are at rest after it was told.
    is_told: bool,
}

/// A connected bridge.
struct Peer {
    stream: TcpStream,
    address: SocketAddr,
    received: Vec<u8>,
    /// The number of the last command.
    number: u64,
    /// Whether a stop has arrived, before which nothing moves.
    obeys: bool,
}

impl Model {
    fn run(mut self, interrupted: &CancellationToken) -> Result<(), Failed> {
        priority::raise_if_permitted();
        let clock = clock::BridgeClock::new();
        let mut at_s = clock.now_s();
        while !interrupted.is_cancelled() {
            // After a pause of the whole machine, time goes on from there.
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
        self.peer = Some(Peer { stream, address, received: Vec::new(), number: 0, obeys: false });
        self.tell(format_args!("connected: {address}"))
    }

    /// Simulates a period with the newest command and sends the state.
    fn sample(&mut self) -> Result<(), Failed> {
        let command = match self.peer.as_mut().map(Peer::newest_command) {
            Some(Ok(command)) => command,
            Some(Err(why)) => {
                self.disconnect(&why)?;
                None
            }
            None => None,
        };
        let state = match command {
            Some(command) => self.pair.exchange(&command).or_exit(Exit::Bug, String::new)?,
            None => self.pair.skip_period(),
        };
        self.tell_drives(&state)?;
        self.n_states += 1;
        let state = PairState { sequence: self.n_states, ..state };
        let vector = encode_state(&state).or_exit(Exit::Bug, String::new)?;
        match self.peer.as_mut().map(|peer| peer.stream.write_all(&to_bytes(&vector))) {
            Some(Err(error)) => self.disconnect(&error),
            Some(Ok(())) | None => Ok(()),
        }
    }

    fn disconnect(&mut self, why: &io::Error) -> Result<(), Failed> {
        let Some(peer) = self.peer.take() else { return Ok(()) };
        self.tell(format_args!("disconnected: {}: {why}", peer.address))
    }

    /// Tells when the drives brake by themselves and when the arms are at rest after that.
    fn tell_drives(&mut self, state: &PairState) -> Result<(), Failed> {
        let is_tripped = state.arms.iter().any(|arm| arm.faults.drive);
        // Before a bridge has connected, drives without commands are no event.
        self.has_obeyed |= !is_tripped && self.peer.as_ref().is_some_and(|peer| peer.obeys);
        if !(is_tripped && self.has_obeyed) {
            (self.is_tripped, self.is_told) = (false, false);
            return Ok(());
        }
        if !std::mem::replace(&mut self.is_tripped, true) {
            let silence_ms = 1e3 * SILENCE_S;
            self.tell(format_args!("no command for {silence_ms:.0} ms: the drives brake"))?;
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
    /// Returns the newest command that has arrived since the last call and that the drives obey.
    fn newest_command(&mut self) -> io::Result<Option<Command>> {
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
        let mut newest = None;
        while self.received.len() >= COMMAND_BYTES {
            let vector: Vec<u8> = self.received.drain(..COMMAND_BYTES).collect();
            let command = decode_command(&from_bytes(&vector)).map_err(io::Error::other)?;
            let is_stop = command.order == Order::Stop;
            self.obeys |= is_stop;
            if self.obeys && (is_stop || command.number != self.number) {
                self.number = command.number;
                newest = Some(command);
            }
        }
        Ok(newest)
    }
}
