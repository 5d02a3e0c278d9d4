//! Playback of a fixed set of logs.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use foxglove::websocket::{
    ChannelView, Client, PlaybackControlRequest, PlaybackState, ServerListener,
};

use tandem_core::text::error_chain;

use super::episode::{ChannelDescription, Episode};
use super::transport::Transport;
use super::{Clock, PAUSE_NS, Server, TICK};
use crate::error::Error;

/// Logs on one timeline, which viewers play, pause and seek together.
pub struct Replay {
    server: Server,
    address: SocketAddr,
    control: Arc<Control>,
    logs: Vec<LogSpan>,
    /// Indices of the logs that can no longer be read.
    unreadable: BTreeSet<usize>,
    /// The log that was read last, and its index.
    loaded: Option<(usize, Episode)>,
    /// The position up to which messages were published.
    published_ns: Option<u64>,
}

/// A log on the timeline.
struct LogSpan {
    path: PathBuf,
    start_ns: u64,
    end_ns: u64,
}

/// Playback state that viewers control.
struct Control {
    clock: Clock,
    transport: Mutex<Transport>,
    /// Viewers need the present state again: after a seek, or because one has subscribed.
    refresh: AtomicBool,
}

impl Control {
    fn transport(&self) -> MutexGuard<'_, Transport> {
        self.transport.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ServerListener for Control {
    fn on_subscribe(&self, _client: Client, _channel: ChannelView<'_>) {
        self.refresh.store(true, Ordering::Release);
    }

    fn on_playback_control_request(
        &self,
        request: PlaybackControlRequest,
    ) -> Option<PlaybackState> {
        let state = self.transport().handle(&request, (self.clock)());
        if state.did_seek {
            self.refresh.store(true, Ordering::Release);
        }
        Some(state)
    }
}

impl Replay {
    /// Reads all of `logs`, which are played in this order, and listens on `address`; port 0 selects a free port. Logs
    /// that cannot be read are left out with a warning.
    ///
    /// # Errors
    /// If no log can be read or the address cannot be listened on.
    pub fn start(address: SocketAddr, logs: &[PathBuf], clock: Clock) -> Result<Self, Error> {
        let mut spans: Vec<LogSpan> = Vec::with_capacity(logs.len());
        let mut channels: Vec<ChannelDescription> = Vec::new();
        let mut unreadable = Vec::new();
        for path in logs {
            let episode = match Episode::read(path) {
                Ok(episode) => episode,
                Err(error) => {
                    unreadable.push(error);
                    continue;
                }
            };
            let start_ns = spans.last().map_or(0, |span| span.end_ns.saturating_add(PAUSE_NS));
            let end_ns = start_ns.saturating_add(episode.end_ns());
            spans.push(LogSpan { path: path.clone(), start_ns, end_ns });
            for channel in episode.channels {
                if channels.iter().all(|known| known.topic != channel.topic) {
                    channels.push(channel);
                }
            }
        }
        if spans.is_empty() && !unreadable.is_empty() {
            return Err(unreadable.swap_remove(0));
        }
        unreadable.iter().for_each(warn_of);
        let end_ns = spans.last().map_or(0, |span| span.end_ns);
        let control = Arc::new(Control {
            transport: Mutex::new(Transport::playing(end_ns, clock())),
            clock,
            refresh: AtomicBool::new(true),
        });
        let listener = Arc::clone(&control) as Arc<dyn ServerListener>;
        let mut server = Server::start(address, "tandem", Some((0, end_ns)), Some(listener))?;
        server.channels.open(&channels)?;
        let address = server.address(address);
        let (unreadable, loaded, published_ns) = (BTreeSet::new(), None, None);
        Ok(Self { server, address, control, logs: spans, unreadable, loaded, published_ns })
    }

    /// Returns the address that viewers connect to.
    #[must_use]
    pub const fn address(&self) -> SocketAddr {
        self.address
    }

    /// Plays until `is_stopped` returns true, then closes all connections. For a log that can no longer be read, it
    /// shows nothing.
    ///
    /// # Errors
    /// If none of the logs can be read any longer.
    pub fn run(mut self, is_stopped: &dyn Fn() -> bool) -> Result<(), Error> {
        let mut n_clients = 0;
        while !is_stopped() {
            self.tick()?;
            let n_connected = self.server.handle.client_count();
            if n_connected > n_clients {
                self.broadcast_state();
            }
            n_clients = n_connected;
            std::thread::sleep(TICK);
        }
        self.server.stop();
        Ok(())
    }

    /// Publishes what the time since the last call has brought.
    fn tick(&mut self) -> Result<(), Error> {
        // A request after this line sets the flag again.
        let refresh = self.control.refresh.swap(false, Ordering::AcqRel);
        let now = (self.control.clock)();
        let position_ns = self.control.transport().position_ns(now);
        match self.published_ns {
            Some(published_ns) if !refresh && position_ns >= published_ns => {
                self.publish_between(published_ns, position_ns)?;
            }
            _ => self.publish_at(position_ns)?,
        }
        if self.published_ns != Some(position_ns) {
            self.server.handle.broadcast_time(position_ns);
        }
        self.published_ns = Some(position_ns);
        self.stop_at_end();
        Ok(())
    }

    fn stop_at_end(&self) {
        let now = (self.control.clock)();
        let mut transport = self.control.transport();
        if transport.has_ended(now) && transport.is_playing() {
            transport.end();
            let state = transport.state(now);
            drop(transport);
            self.server.handle.broadcast_playback_state(state);
        }
    }

    fn broadcast_state(&self) {
        let now = (self.control.clock)();
        let state = self.control.transport().state(now);
        self.server.handle.broadcast_playback_state(state);
    }

    /// Publishes the messages after `published_ns`, up to and including `position_ns`.
    fn publish_between(&mut self, published_ns: u64, position_ns: u64) -> Result<(), Error> {
        let (first, last) = (self.log_at(published_ns), self.log_at(position_ns));
        for log_idx in first..=last {
            self.load(log_idx)?;
            if let Some((_, episode)) = &self.loaded {
                let (from, to) = (episode.n_until(published_ns), episode.n_until(position_ns));
                let from = if log_idx > first { 0 } else { from };
                self.server.channels.publish(episode, from, to);
            }
        }
        Ok(())
    }

    /// Publishes the state at `position_ns`.
    fn publish_at(&mut self, position_ns: u64) -> Result<(), Error> {
        self.load(self.log_at(position_ns))?;
        if let Some((_, episode)) = &self.loaded {
            let end = episode.n_until(position_ns);
            self.server.channels.publish_latest(episode, end, position_ns);
        }
        Ok(())
    }

    /// Returns the index of the log that is played at `time_ns`.
    fn log_at(&self, time_ns: u64) -> usize {
        self.logs.partition_point(|log| log.start_ns <= time_ns).saturating_sub(1)
    }

    /// Reads a log, if it can be read. A log budget may have deleted it since the start.
    fn load(&mut self, log_idx: usize) -> Result<(), Error> {
        if self.loaded.as_ref().is_some_and(|(loaded, _)| *loaded == log_idx) {
            return Ok(());
        }
        self.loaded = None;
        if self.unreadable.contains(&log_idx) {
            return Ok(());
        }
        let Some(log) = self.logs.get(log_idx) else { return Ok(()) };
        match Episode::read(&log.path) {
            Ok(mut episode) => {
                episode.shift(log.start_ns);
                self.loaded = Some((log_idx, episode));
            }
            Err(error) => {
                self.unreadable.insert(log_idx);
                if self.unreadable.len() == self.logs.len() {
                    return Err(error);
                }
                warn_of(&error);
            }
        }
        Ok(())
    }
}

fn warn_of(error: &Error) {
    tracing::warn!(error = error_chain(error), "episode left out");
}
