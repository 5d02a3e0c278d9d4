//! Episodes and arms over the websocket protocol of Foxglove, with the channels of their logs.
//!
//! Episodes are put one after the other on one timeline, with a pause between them, and the stamps within messages are
//! shifted with them. [`Replay`] plays a fixed set of logs, which a viewer can pause and seek; [`Follower`] plays each
//! log of a directory once it is complete. [`LiveArms`] shows the current state of a bridge's arms. A viewer that
//! cannot keep up loses messages and delays no other viewer.

mod arms;
mod channels;
mod episode;
mod follower;
mod replay;
mod transport;

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use foxglove::websocket::{Capability, ServerListener};
use foxglove::{Context, FoxgloveError, WebSocketServer, WebSocketServerHandle};

pub use arms::LiveArms;
pub use follower::Follower;
pub use replay::Replay;

use crate::error::Error;
use channels::Channels;

/// A clock that counts from any moment.
pub type Clock = Arc<dyn Fn() -> Duration + Send + Sync>;

/// Time between two looks at the clock, about one picture of a display.
const TICK: Duration = Duration::from_millis(15);
/// Pause between two episodes on the timeline, nanoseconds.
const PAUSE_NS: u64 = 500_000_000;

/// A websocket server with the channels that were opened so far.
struct Server {
    handle: WebSocketServerHandle,
    channels: Channels,
}

impl Server {
    /// Listens on `address`. With a time range, viewers can pause and seek.
    fn start(
        address: SocketAddr,
        name: &str,
        time_range_ns: Option<(u64, u64)>,
        listener: Option<Arc<dyn ServerListener>>,
    ) -> Result<Self, Error> {
        let context = Context::new();
        let host = match address.ip() {
            IpAddr::V4(ip) => ip.to_string(),
            IpAddr::V6(ip) => format!("[{ip}]"),
        };
        let mut server = WebSocketServer::new()
            .name(name)
            .context(&context)
            .capabilities([Capability::Time])
            .bind(host, address.port());
        if let Some((start_ns, end_ns)) = time_range_ns {
            server = server.playback_time_range(start_ns, end_ns);
        }
        if let Some(listener) = listener {
            server = server.listener(listener);
        }
        let handle = server.start_blocking().map_err(|error| Error::Listen {
            address,
            source: match error {
                FoxgloveError::Bind(source) | FoxgloveError::IoError(source) => source,
                other => std::io::Error::other(other.to_string()),
            },
        })?;
        Ok(Self { handle, channels: Channels::new(context) })
    }

    /// Returns the address that viewers connect to.
    fn address(&self, requested: SocketAddr) -> SocketAddr {
        SocketAddr::new(requested.ip(), self.handle.port())
    }

    fn stop(self) {
        self.handle.stop().wait_blocking();
    }
}
