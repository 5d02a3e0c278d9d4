//! Arms behind Quanser's QUARC: a Simulink model that talks to us through a stream block.
//!
//! **The wire** is TCP (`tcpip://host:port` in QUARC's words) that carries vectors of doubles and nothing else: no header, no
//! length, one vector a sample each way. [`codec`] has the tables. The arms' side sends a state in every sample of its own,
//! whether a command has come or not.
//!
//! **What the model on that side has to do**, because a stream block goes on giving out what it got last:
//!
//! 1. Set all velocities to zero, and keep them there until an order to stop has come, when the command's number has not changed for
//!    [`SILENCE_S`](crate::driver::SILENCE_S), when its stream block is not connected, and in every sample before the first command of a connection.
//! 2. Do the same with a command that does not begin with its mark, has a number that is not finite, or an order that is
//!    neither 0 nor 1; and report a drive fault.
//! 3. Brake at once on order 0, whatever its number is. Such a vector may repeat the number of the command before.
//! 4. Receive into a buffer for one vector, and send states only while connected, so that nothing piles up. The sequence
//!    grows by 1 with each vector that was sent.
//! 5. Report the number of the newest command that it obeys. The executor stops when commands have no effect.
//! 6. Keep the arms' own limits (speed, torque, range). This side keeps them too, and neither relies on the other.
//!
//! **Here**, a number that is not finite, an unknown flag, a jump in the sequence, a vector that stays short, a command that cannot be written
//! at once and a closed connection all end the connection: the driver tells the arms to stop if it still can, shuts the socket and
//! answers every later exchange with that first error. **A driver is for one connection.** Whoever wants to go on connects anew and
//! gives the new driver to the executor, which stays stopped until somebody resets it. Nothing moves by connecting:
//! the driver refuses to hand on a motion before an order to stop was exchanged, and the numbers of commands begin at 1.
//!
//! **Who dials** is free. [`QuarcDriver::connect`] dials a Stream Server block; where a Stream Client block dials us,
//! accept its connection and pass it to [`QuarcDriver::over`].

use std::io::{ErrorKind, Read as _, Write as _};
use std::net::{Shutdown, TcpStream, ToSocketAddrs as _};
use std::time::Duration;

use crate::driver::{Command, Driver, DriverError, Order, PairState};
use crate::quarc::codec::STATE_BYTES;
use crate::quarc::inbox::Inbox;

pub mod codec;
mod inbox;

/// Bytes that are taken in one exchange at most. More is not a state a sample.
const MOST_BYTES: usize = 4096 * STATE_BYTES;
/// Reads in which the first state has to come.
const N_FIRST_READS: u32 = 100;

/// How to reach the arms, and how patient to be.
#[derive(Debug, Clone, PartialEq)]
pub struct QuarcConfig {
    /// Where the stream server listens: `host:port` or `tcpip://host:port`.
    pub address: String,
    /// Time from one exchange to the next, seconds: the model's sample time. Default 0.01.
    pub period_s: f64,
    /// How long to wait for the connection, and then for the first state. Default 3 s each.
    pub connect_timeout: Duration,
    /// How long an exchange waits for a state when none has come. Default 2 ms; has to be shorter than the period.
    /// It evens out the jitter of two clocks with the same period.
    pub wait: Duration,
    /// Exchanges after which a vector that is still short ends the connection. Default 3.
    pub short_exchanges: u32,
}

impl QuarcConfig {
    /// Defaults for the stream server at `address`.
    #[must_use]
    pub fn at(address: impl Into<String>) -> Self {
        Self {
            address: address.into(),
            period_s: 0.01,
            connect_timeout: Duration::from_secs(3),
            wait: Duration::from_millis(2),
            short_exchanges: 3,
        }
    }

    /// Passes values that make sense.
    fn checked(self) -> Result<Self, DriverError> {
        let wait_s = self.wait.as_secs_f64();
        if !(self.period_s.is_finite() && self.period_s > 0.0 && wait_s < self.period_s) {
            let period_s = self.period_s;
            let what = format!(
                "period {period_s} s with a wait of {wait_s} s: the wait has to be shorter"
            );
            return Err(DriverError::Refused { what });
        }
        Ok(self)
    }
}

/// The arms at the other end of one connection.
#[derive(Debug)]
pub struct QuarcDriver {
    config: QuarcConfig,
    stream: TcpStream,
    inbox: Inbox,
    newest: PairState,
    /// Exchanges in which a vector was begun and none completed, since the last state.
    n_short: u32,
    /// Number of the newest command that was sent.
    number: u64,
    /// Whether an order to stop was exchanged over this connection.
    stopped_once: bool,
    /// Why the connection has ended.
    failure: Option<DriverError>,
}

impl QuarcDriver {
    /// Dials a stream server and waits for its first state. Sends nothing.
    ///
    /// # Errors
    /// Says which address does not answer, or what it sends instead of states.
    pub fn connect(config: QuarcConfig) -> Result<Self, DriverError> {
        let config = config.checked()?;
        let bare = config.address.trim_start_matches("tcpip://").trim_end_matches('/');
        let unreachable = |why: String| DriverError::Disconnected {
            what: format!(
                "{:?}: {why}; is the model running, and its stream server at this address?",
                config.address
            ),
        };
        let addresses = bare.to_socket_addrs().map_err(|error| unreachable(error.to_string()))?;
        let mut why = "the name has no address".to_owned();
        for address in addresses {
            match TcpStream::connect_timeout(&address, config.connect_timeout) {
                Ok(stream) => return Self::over(stream, config),
                Err(error) => why = error.to_string(),
            }
        }
        Err(unreachable(why))
    }

    /// Takes over a connection that exists and waits for its first state; the configured address is for messages only. Sends nothing.
    ///
    /// # Errors
    /// Says what comes instead of states.
    pub fn over(stream: TcpStream, config: QuarcConfig) -> Result<Self, DriverError> {
        let config = config.checked()?;
        let failed = |error: std::io::Error| lost(&format!("{:?}", config.address), &error);
        stream.set_nodelay(true).map_err(failed)?;
        let mut inbox = Inbox::default();
        let mut stream = stream;
        let newest = first_state(&mut stream, &mut inbox, &config)?;
        stream.set_nonblocking(true).map_err(failed)?;
        Ok(Self {
            inbox,
            // What is handed on is counted from 1.
            newest: PairState { sequence: 1, ..newest },
            n_short: 0,
            number: 0,
            stopped_once: false,
            failure: None,
            stream,
            config,
        })
    }

    /// Returns the newest state, and waits for at most `patience` when it is known already. Sends nothing: for looking at arms that
    /// nobody commands.
    ///
    /// # Errors
    /// As an exchange.
    pub fn listen(&mut self, patience: Duration) -> Result<PairState, DriverError> {
        self.unless_failed(|driver| {
            driver.receive(patience)?;
            Ok(driver.newest.clone())
        })
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
            self.send(&Command { number: self.number, order: Order::Stop }).ok();
            self.stream.shutdown(Shutdown::Both).ok();
            self.failure = Some(failure.clone());
        })
    }

    /// Writes a command, all of it at once. What does not fit now would arrive late, and a late command is a wrong one.
    fn send(&mut self, command: &Command) -> Result<(), DriverError> {
        let bytes = codec::to_bytes(&codec::encode_command(command, self.config.period_s)?);
        match self.stream.write(&bytes) {
            Ok(n) if n == bytes.len() => Ok(()),
            Ok(_) => Err(blocked(&self.stream)),
            Err(error) if error.kind() == ErrorKind::WouldBlock => Err(blocked(&self.stream)),
            Err(error) => Err(lost("a command could not be sent", &error)),
        }
    }

    /// Takes what has come; waits once when that is no whole state. Says whether the newest state is a new one.
    fn receive(&mut self, patience: Duration) -> Result<bool, DriverError> {
        if self.drain()? {
            return Ok(true);
        }
        if patience.is_zero() {
            return Ok(false);
        }
        let failed = |error: std::io::Error| lost("the socket", &error);
        self.stream.set_read_timeout(Some(patience)).map_err(failed)?;
        self.stream.set_nonblocking(false).map_err(failed)?;
        // Only waits: bytes are taken by what follows.
        let came = self.stream.peek(&mut [0]);
        self.stream.set_nonblocking(true).map_err(failed)?;
        match came {
            Ok(_) => self.drain(),
            Err(error) if waited(&error) => Ok(false),
            Err(error) => Err(lost("reading a state", &error)),
        }
    }

    /// Takes all bytes that have come. Says whether a state was completed.
    fn drain(&mut self) -> Result<bool, DriverError> {
        let (mut buffer, mut n_taken, mut new) = ([0; 16 * STATE_BYTES], 0, None);
        loop {
            match self.stream.read(&mut buffer) {
                Ok(0) => return Err(closed()),
                Ok(n) => {
                    n_taken += n;
                    new = self.inbox.take(&buffer[..n])?.or(new);
                }
                Err(error) if waited(&error) => break,
                Err(error) => return Err(lost("reading a state", &error)),
            }
            if n_taken > MOST_BYTES {
                let what =
                    format!("{n_taken} bytes at once: the arms send faster than they are read");
                return Err(DriverError::Malformed { what });
            }
        }
        let Some(state) = new else { return Ok(false) };
        let sequence = self.newest.sequence + 1;
        self.newest = PairState { sequence, ..state };
        self.n_short = 0;
        Ok(true)
    }

    fn judge_short(&mut self, new: bool) -> Result<(), DriverError> {
        let n_bytes = self.inbox.n_short();
        self.n_short += u32::from(!new && n_bytes > 0);
        if self.n_short > self.config.short_exchanges {
            let what = format!(
                "a vector of {n_bytes} bytes instead of {STATE_BYTES}: check the width and the data type of the stream block's signal"
            );
            return Err(DriverError::Malformed { what });
        }
        Ok(())
    }
}

impl Driver for QuarcDriver {
    fn period_s(&self) -> f64 {
        self.config.period_s
    }

    fn exchange(&mut self, command: &Command) -> Result<PairState, DriverError> {
        self.unless_failed(|driver| {
            match &command.order {
                Order::Stop => driver.stopped_once = true,
                Order::Move(_) if !driver.stopped_once => {
                    let what = "a new connection has to begin with an order to stop".into();
                    return Err(DriverError::Refused { what });
                }
                Order::Move(_) => {}
            }
            driver.send(command)?;
            driver.number = command.number;
            let new = driver.receive(driver.config.wait)?;
            driver.judge_short(new)?;
            Ok(driver.newest.clone())
        })
    }

    /// Sends an order to stop on top of all that was sent. When that cannot be done the socket is shut, and the model brakes
    /// because it hears nothing more.
    fn stop(&mut self) -> Result<(), DriverError> {
        let stop = Command { number: self.number, order: Order::Stop };
        self.unless_failed(|driver| driver.send(&stop))
    }
}

/// Waits for the first whole state.
fn first_state(
    stream: &mut TcpStream,
    inbox: &mut Inbox,
    config: &QuarcConfig,
) -> Result<PairState, DriverError> {
    let failed = |error: std::io::Error| lost(&format!("{:?}", config.address), &error);
    stream.set_nonblocking(false).map_err(failed)?;
    let slice = (config.connect_timeout / N_FIRST_READS).max(Duration::from_millis(1));
    stream.set_read_timeout(Some(slice)).map_err(failed)?;
    let mut buffer = [0; 16 * STATE_BYTES];
    for _ in 0..N_FIRST_READS {
        match stream.read(&mut buffer) {
            Ok(0) => return Err(closed()),
            Ok(n) => {
                if let Some(state) = inbox.take(&buffer[..n])? {
                    return Ok(state);
                }
            }
            Err(error) if waited(&error) => {}
            Err(error) => return Err(failed(error)),
        }
    }
    let (address, got) = (&config.address, inbox.n_short());
    let what = format!(
        "{address:?} took the connection and sent {got} bytes, a state has {STATE_BYTES}: does the model run, and is its signal as wide as the table says?"
    );
    Err(DriverError::Malformed { what })
}

/// Whether nothing had come, which is no failure.
fn waited(error: &std::io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted)
}

fn closed() -> DriverError {
    DriverError::Disconnected { what: "the arms' side closed the connection".into() }
}

fn lost(doing: &str, error: &std::io::Error) -> DriverError {
    DriverError::Disconnected { what: format!("{doing}: {error}") }
}

/// A command did not fit into the socket's buffer. Shuts the socket: half a command may be in it.
fn blocked(stream: &TcpStream) -> DriverError {
    stream.shutdown(Shutdown::Both).ok();
    DriverError::Disconnected { what: "the arms do not take commands any more".into() }
}
