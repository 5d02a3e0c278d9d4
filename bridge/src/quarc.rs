//! Arms behind Quanser's QUARC: a Simulink model that communicates through a stream block.
//!
//! **The wire** is TCP (`tcpip://host:port` in QUARC's notation). It carries only vectors of doubles, one per sample in
//! each direction, without header or length. [`codec`] has the tables. The model sends a state in every sample, with or
//! without a command.
//!
//! **Requirements of the model.** A stream block repeats its last value, and the model itself has to brake. The rules
//! are those of `docs/drivers.md`, section QUARC. `bridge/quarc` implements them in C for QUARC's Stream API and for a
//! Simulink block, [`arm_side`] implements them for simulated arms, and `bridge/quarc/vectors.txt` has examples that
//! test both.
//!
//! **A driver serves one connection.** A number that is not finite, an unknown flag, a jump in the sequence, a vector
//! that stays incomplete, a command that cannot be written at once and a closed connection end it: the driver stops the
//! arms if it still can, closes the socket and returns that first error from every later exchange. To continue, connect
//! again and give the new driver to the executor, which stays stopped until a reset. Connecting moves nothing: the
//! driver refuses a motion before an order to stop was exchanged, and commands are counted from 1.
//!
//! **Either side may connect.** [`QuarcDriver::connect`] connects to a Stream Server block. If a Stream Client block
//! connects to the bridge, accept its connection and pass it to [`QuarcDriver::over`].

use std::io::{ErrorKind, Read as _, Write as _};
use std::net::{Shutdown, TcpStream, ToSocketAddrs as _};
use std::time::Duration;

use crate::driver::{Command, Driver, DriverError, Order, PairState};
use crate::quarc::codec::STATE_BYTES;
use crate::quarc::state_buffer::{StateBuffer, keep_peaks};

pub mod arm_side;
pub mod codec;
mod state_buffer;

/// The largest number of bytes in one exchange. The model sends one state per sample.
const MAX_BYTES: usize = 4096 * STATE_BYTES;
/// The number of reads in which the first state has to arrive.
const N_FIRST_READS: u32 = 100;

/// The address and the time limits of a driver.
#[derive(Debug, Clone, PartialEq)]
pub struct QuarcConfig {
    /// The address of the stream server: `host:port` or `tcpip://host:port`.
    pub address: String,
    /// Time from one exchange to the next, seconds: the model's sample time. Default 0.01.
    pub period_s: f64,
    /// Time limit of the connection, and then of the first state. Default 3 s each.
    pub connect_timeout: Duration,
    /// Time for which an exchange waits for a state if none has arrived. Default 2 ms; must be shorter than the period.
    /// It compensates for the jitter of two clocks with the same period.
    pub wait: Duration,
    /// Exchanges after which an incomplete vector ends the connection. Default 3.
    pub partial_exchanges: u32,
}

impl QuarcConfig {
    /// Returns the defaults for the stream server at `address`.
    #[must_use]
    pub fn at(address: impl Into<String>) -> Self {
        Self {
            address: address.into(),
            period_s: 0.01,
            connect_timeout: Duration::from_secs(3),
            wait: Duration::from_millis(2),
            partial_exchanges: 3,
        }
    }

    /// Checks the values.
    fn checked(self) -> Result<Self, DriverError> {
        let wait_s = self.wait.as_secs_f64();
        if !(self.period_s.is_finite() && self.period_s > 0.0 && wait_s < self.period_s) {
            let period_s = self.period_s;
            let what =
                format!("period {period_s} s with a wait of {wait_s} s: the wait must be shorter");
            return Err(DriverError::Refused { what });
        }
        Ok(self)
    }
}

/// The driver of the arms at one connection.
#[derive(Debug)]
pub struct QuarcDriver {
    config: QuarcConfig,
    stream: TcpStream,
    buffered: StateBuffer,
    newest: PairState,
    /// Exchanges with an incomplete vector since the last state.
    n_partial: u32,
    /// The number of the newest command that was sent.
    number: u64,
    /// True if an order to stop was exchanged over this connection.
    stopped_once: bool,
    /// The error that ended the connection.
    failure: Option<DriverError>,
}

impl QuarcDriver {
    /// Connects to a stream server and waits for its first state. Sends nothing.
    ///
    /// # Errors
    /// Returns an error if the wait of `config` is not shorter than the period, or the address does not respond or
    /// sends no states.
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

    /// Takes over an existing connection and waits for its first state. Sends nothing. The configured address only
    /// appears in messages.
    ///
    /// # Errors
    /// Returns an error if the wait of `config` is not shorter than the period, or the connection sends no states.
    pub fn over(stream: TcpStream, config: QuarcConfig) -> Result<Self, DriverError> {
        let config = config.checked()?;
        let failed = |error: std::io::Error| lost(&format!("{:?}", config.address), &error);
        stream.set_nodelay(true).map_err(failed)?;
        let mut buffered = StateBuffer::default();
        let mut stream = stream;
        let newest = first_state(&mut stream, &mut buffered, &config)?;
        stream.set_nonblocking(true).map_err(failed)?;
        Ok(Self {
            buffered,
            // The executor receives states counted from 1.
            newest: PairState { sequence: 1, ..newest },
            n_partial: 0,
            number: 0,
            stopped_once: false,
            failure: None,
            stream,
            config,
        })
    }

    /// Returns the newest state, and waits at most `timeout` for a new one. Sends no command, so it suits arms that are
    /// only monitored.
    ///
    /// # Errors
    /// As [`Driver::exchange`].
    pub fn listen(&mut self, timeout: Duration) -> Result<PairState, DriverError> {
        self.unless_failed(|driver| {
            driver.receive(timeout)?;
            Ok(driver.newest.clone())
        })
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
            self.send(&Command { number: self.number, order: Order::Stop }).ok();
            self.stream.shutdown(Shutdown::Both).ok();
            self.failure = Some(failure.clone());
        })
    }

    /// Writes a whole command without waiting. The rest of a partly written command would arrive late, and a late
    /// command is wrong.
    fn send(&mut self, command: &Command) -> Result<(), DriverError> {
        let bytes = codec::to_bytes(&codec::encode_command(command, self.config.period_s)?);
        match self.stream.write(&bytes) {
            Ok(n) if n == bytes.len() => Ok(()),
            Ok(_) => Err(blocked(&self.stream)),
            Err(error) if error.kind() == ErrorKind::WouldBlock => Err(blocked(&self.stream)),
            Err(error) => Err(lost("a command could not be sent", &error)),
        }
    }

    /// Receives all waiting bytes, and waits once if they complete no state. Returns true if there is a new state.
    fn receive(&mut self, timeout: Duration) -> Result<bool, DriverError> {
        if self.drain()? {
            return Ok(true);
        }
        if timeout.is_zero() {
            return Ok(false);
        }
        let failed = |error: std::io::Error| lost("the socket", &error);
        self.stream.set_read_timeout(Some(timeout)).map_err(failed)?;
        self.stream.set_nonblocking(false).map_err(failed)?;
        // Only waits: `drain` reads the bytes.
        let peeked = self.stream.peek(&mut [0]);
        self.stream.set_nonblocking(true).map_err(failed)?;
        match peeked {
            Ok(_) => self.drain(),
            Err(error) if is_timeout(&error) => Ok(false),
            Err(error) => Err(lost("reading a state", &error)),
        }
    }

    /// Reads all bytes that have arrived. Returns true if they completed a state.
    fn drain(&mut self) -> Result<bool, DriverError> {
        let (mut buffer, mut n_taken, mut new) = ([0; 16 * STATE_BYTES], 0, None);
        loop {
            match self.stream.read(&mut buffer) {
                Ok(0) => return Err(closed()),
                Ok(n) => {
                    n_taken += n;
                    let before = new.take();
                    new = match (self.buffered.push(&buffer[..n])?, before) {
                        (Some(mut state), Some(before)) => {
                            keep_peaks(&mut state, &before);
                            Some(state)
                        }
                        (state, before) => state.or(before),
                    };
                }
                Err(error) if is_timeout(&error) => break,
                Err(error) => return Err(lost("reading a state", &error)),
            }
            if n_taken > MAX_BYTES {
                let what =
                    format!("{n_taken} bytes at once: the arms send faster than they are read");
                return Err(DriverError::Malformed { what });
            }
        }
        let Some(state) = new else { return Ok(false) };
        let sequence = self.newest.sequence + 1;
        self.newest = PairState { sequence, ..state };
        self.n_partial = 0;
        Ok(true)
    }

    fn check_partial(&mut self, new: bool) -> Result<(), DriverError> {
        let n_bytes = self.buffered.n_partial();
        self.n_partial += u32::from(!new && n_bytes > 0);
        if self.n_partial > self.config.partial_exchanges {
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
                    let what = "a new connection has to start with an order to stop".into();
                    return Err(DriverError::Refused { what });
                }
                Order::Move(_) => {}
            }
            driver.send(command)?;
            driver.number = command.number;
            let new = driver.receive(driver.config.wait)?;
            driver.check_partial(new)?;
            Ok(driver.newest.clone())
        })
    }

    /// Sends an order to stop. If that fails, the socket is closed and the model brakes because it receives no
    /// commands.
    fn stop(&mut self) -> Result<(), DriverError> {
        let stop = Command { number: self.number, order: Order::Stop };
        self.unless_failed(|driver| driver.send(&stop))
    }

    fn disconnect(&mut self, reason: &DriverError) {
        self.unless_failed(|_| Err::<(), _>(reason.clone())).ok();
    }
}

/// Waits for the first whole state.
fn first_state(
    stream: &mut TcpStream,
    buffered: &mut StateBuffer,
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
                if let Some(state) = buffered.push(&buffer[..n])? {
                    return Ok(state);
                }
            }
            Err(error) if is_timeout(&error) => {}
            Err(error) => return Err(failed(error)),
        }
    }
    let (address, got) = (&config.address, buffered.n_partial());
    let what = format!(
        "{address:?} accepted the connection and sent {got} bytes, a state has {STATE_BYTES}: is the model running without another bridge, and does its signal have the documented width?"
    );
    Err(DriverError::Malformed { what })
}

/// Returns true if an error only means that no data has arrived.
fn is_timeout(error: &std::io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted)
}

fn closed() -> DriverError {
    DriverError::Disconnected { what: "the arms' side closed the connection".into() }
}

fn lost(doing: &str, error: &std::io::Error) -> DriverError {
    DriverError::Disconnected { what: format!("{doing}: {error}") }
}

/// Closes the socket after a command did not fit into its buffer, which may contain a part of it.
fn blocked(stream: &TcpStream) -> DriverError {
    stream.shutdown(Shutdown::Both).ok();
    DriverError::Disconnected { what: "the arms no longer accept commands".into() }
}
