//! The websocket to rosbridge. All waits have a time limit, and messages are not queued: a message that cannot be
//! written at once is an error.

use std::io::ErrorKind;
use std::net::{Shutdown, TcpStream, ToSocketAddrs as _};
use std::time::Duration;

use tungstenite::protocol::WebSocketConfig;
use tungstenite::{Error, Message, WebSocket};

use crate::driver::DriverError;
use crate::kinova_ros::protocol::{RosMessage, parse};

/// The largest number of messages in one exchange.
const MAX_MESSAGES: usize = 10_000;
/// The longest message, bytes. A joint state has fewer than a thousand.
const MAX_BYTES: usize = 1 << 20;

/// A connection to rosbridge.
#[derive(Debug)]
pub(crate) struct RosbridgeSocket {
    socket: WebSocket<TcpStream>,
}

impl RosbridgeSocket {
    /// Connects to `address`, `host:port`.
    pub(crate) fn connect(address: &str, timeout: Duration) -> Result<Self, DriverError> {
        let unreachable = |why: String| DriverError::Disconnected {
            what: format!("{address:?}: {why}; does rosbridge_websocket run, and at this address?"),
        };
        let addresses =
            address.to_socket_addrs().map_err(|error| unreachable(error.to_string()))?;
        let mut why = "the name has no address".to_owned();
        for place in addresses {
            match TcpStream::connect_timeout(&place, timeout) {
                Ok(stream) => {
                    return Self::handshake(stream, address, timeout).map_err(unreachable);
                }
                Err(error) => why = error.to_string(),
            }
        }
        Err(unreachable(why))
    }

    /// Performs the websocket handshake.
    fn handshake(stream: TcpStream, address: &str, timeout: Duration) -> Result<Self, String> {
        let prepared = stream.set_nodelay(true).and(stream.set_read_timeout(Some(timeout)));
        prepared.and(stream.set_write_timeout(Some(timeout))).map_err(|error| error.to_string())?;
        let config = WebSocketConfig::default()
            .write_buffer_size(0)
            .max_write_buffer_size(MAX_BYTES)
            .max_message_size(Some(MAX_BYTES))
            .max_frame_size(Some(MAX_BYTES));
        let url = format!("ws://{address}/");
        let (socket, _) = tungstenite::client::client_with_config(url, stream, Some(config))
            .map_err(|error| format!("no websocket: {error}"))?;
        socket.get_ref().set_nonblocking(true).map_err(|error| error.to_string())?;
        Ok(Self { socket })
    }

    /// Writes a whole message without waiting.
    pub(crate) fn send(&mut self, text: String) -> Result<(), DriverError> {
        self.socket.send(Message::text(text)).map_err(|error| match error {
            Error::Io(error) if is_timeout(&error) => blocked(),
            Error::WriteBufferFull(_) => blocked(),
            error => lost(&error),
        })
    }

    /// Returns the next message that has arrived.
    fn next(&mut self) -> Result<Option<RosMessage>, DriverError> {
        loop {
            match self.socket.read() {
                Ok(Message::Text(text)) => return parse(&text).map(Some),
                Ok(Message::Binary(_)) => {
                    let what = "rosbridge sent binary data instead of JSON".into();
                    return Err(DriverError::Malformed { what });
                }
                Ok(_) => {}
                Err(Error::Io(error)) if is_timeout(&error) => return Ok(None),
                Err(error) => return Err(lost(&error)),
            }
        }
    }

    /// Passes every message that has arrived to `handle`.
    pub(crate) fn drain(
        &mut self,
        mut handle: impl FnMut(RosMessage) -> Result<(), DriverError>,
    ) -> Result<(), DriverError> {
        for _ in 0..MAX_MESSAGES {
            match self.next()? {
                Some(message) => handle(message)?,
                None => return Ok(()),
            }
        }
        let what = format!("{MAX_MESSAGES} messages at once: rosbridge sends faster than is read");
        Err(DriverError::Malformed { what })
    }

    /// Waits at most `timeout` for data.
    pub(crate) fn wait(&self, timeout: Duration) -> Result<(), DriverError> {
        let stream = self.socket.get_ref();
        let failed = |error: std::io::Error| lost(&Error::Io(error));
        stream.set_read_timeout(Some(timeout.max(Duration::from_micros(1)))).map_err(failed)?;
        stream.set_nonblocking(false).map_err(failed)?;
        let peeked = stream.peek(&mut [0]);
        stream.set_nonblocking(true).map_err(failed)?;
        match peeked {
            Err(error) if !is_timeout(&error) => Err(failed(error)),
            _ => Ok(()),
        }
    }

    /// Ends the connection.
    pub(crate) fn close(&self) {
        self.socket.get_ref().shutdown(Shutdown::Both).ok();
    }
}

/// Returns true if an error only means that no data has arrived.
fn is_timeout(error: &std::io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted)
}

fn blocked() -> DriverError {
    DriverError::Disconnected { what: "rosbridge no longer accepts messages".into() }
}

fn lost(error: &Error) -> DriverError {
    DriverError::Disconnected { what: format!("the connection to rosbridge broke: {error}") }
}
