//! The websocket to rosbridge. Nothing here waits longer than it is told to, and nothing is queued: a message that cannot be written at
//! once is an error.

use std::io::ErrorKind;
use std::net::{Shutdown, TcpStream, ToSocketAddrs as _};
use std::time::Duration;

use tungstenite::protocol::WebSocketConfig;
use tungstenite::{Error, Message, WebSocket};

use crate::driver::DriverError;
use crate::kinova_ros::protocol::{Heard, hear};

/// Messages that are taken in one exchange at most.
const MOST_MESSAGES: usize = 10_000;
/// Longest message, bytes. A joint state has less than a thousand.
const MOST_BYTES: usize = 1 << 20;

/// A connection to rosbridge.
#[derive(Debug)]
pub(crate) struct Link {
    socket: WebSocket<TcpStream>,
}

impl Link {
    /// Dials `address`, `host:port`.
    pub(crate) fn connect(address: &str, timeout: Duration) -> Result<Self, DriverError> {
        let unreachable = |why: String| DriverError::Disconnected {
            what: format!("{address:?}: {why}; does rosbridge_websocket run, and at this address?"),
        };
        let addresses =
            address.to_socket_addrs().map_err(|error| unreachable(error.to_string()))?;
        let mut why = "the name has no address".to_owned();
        for place in addresses {
            match TcpStream::connect_timeout(&place, timeout) {
                Ok(stream) => return Self::greet(stream, address, timeout).map_err(unreachable),
                Err(error) => why = error.to_string(),
            }
        }
        Err(unreachable(why))
    }

    /// Makes a websocket of a connection.
    fn greet(stream: TcpStream, address: &str, timeout: Duration) -> Result<Self, String> {
        let prepared = stream.set_nodelay(true).and(stream.set_read_timeout(Some(timeout)));
        prepared.and(stream.set_write_timeout(Some(timeout))).map_err(|error| error.to_string())?;
        let config = WebSocketConfig::default()
            .write_buffer_size(0)
            .max_write_buffer_size(MOST_BYTES)
            .max_message_size(Some(MOST_BYTES))
            .max_frame_size(Some(MOST_BYTES));
        let url = format!("ws://{address}/");
        let (socket, _) = tungstenite::client::client_with_config(url, stream, Some(config))
            .map_err(|error| format!("no websocket: {error}"))?;
        socket.get_ref().set_nonblocking(true).map_err(|error| error.to_string())?;
        Ok(Self { socket })
    }

    /// Writes a message, all of it at once.
    pub(crate) fn say(&mut self, text: String) -> Result<(), DriverError> {
        self.socket.send(Message::text(text)).map_err(|error| match error {
            Error::Io(error) if waited(&error) => blocked(),
            Error::WriteBufferFull(_) => blocked(),
            error => lost(&error),
        })
    }

    /// The next message that has come.
    fn next(&mut self) -> Result<Option<Heard>, DriverError> {
        loop {
            match self.socket.read() {
                Ok(Message::Text(text)) => return hear(&text).map(Some),
                Ok(Message::Binary(_)) => {
                    let what = "rosbridge sent binary data instead of JSON".into();
                    return Err(DriverError::Malformed { what });
                }
                Ok(_) => {}
                Err(Error::Io(error)) if waited(&error) => return Ok(None),
                Err(error) => return Err(lost(&error)),
            }
        }
    }

    /// Passes every message that has come to `take`.
    pub(crate) fn drain(
        &mut self,
        mut take: impl FnMut(Heard) -> Result<(), DriverError>,
    ) -> Result<(), DriverError> {
        for _ in 0..MOST_MESSAGES {
            match self.next()? {
                Some(heard) => take(heard)?,
                None => return Ok(()),
            }
        }
        let what = format!("{MOST_MESSAGES} messages at once: rosbridge sends faster than is read");
        Err(DriverError::Malformed { what })
    }

    /// Waits for at most `patience` until something comes.
    pub(crate) fn wait(&self, patience: Duration) -> Result<(), DriverError> {
        let stream = self.socket.get_ref();
        let failed = |error: std::io::Error| lost(&Error::Io(error));
        stream.set_read_timeout(Some(patience.max(Duration::from_micros(1)))).map_err(failed)?;
        stream.set_nonblocking(false).map_err(failed)?;
        let came = stream.peek(&mut [0]);
        stream.set_nonblocking(true).map_err(failed)?;
        match came {
            Err(error) if !waited(&error) => Err(failed(error)),
            _ => Ok(()),
        }
    }

    /// Ends the connection.
    pub(crate) fn close(&self) {
        self.socket.get_ref().shutdown(Shutdown::Both).ok();
    }
}

/// Whether nothing had come, which is no failure.
fn waited(error: &std::io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted)
}

fn blocked() -> DriverError {
    DriverError::Disconnected { what: "rosbridge does not take messages any more".into() }
}

fn lost(error: &Error) -> DriverError {
    DriverError::Disconnected { what: format!("the connection to rosbridge broke: {error}") }
}
