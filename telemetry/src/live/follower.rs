//! Playback of the logs that become finished in a directory.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::os::unix::fs::DirEntryExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use foxglove::websocket::{ChannelView, Client, ServerListener};

use super::episode::Episode;
use super::{Clock, PAUSE_NS, Server, TICK};
use crate::error::Error;
use crate::log_name::LogName;

/// Time between two looks into the directory.
const LOOK_EVERY: Duration = Duration::from_millis(500);

/// Plays the newest evaluation episodes of a directory in real time, one after the other, as workers finish their logs.
/// While there is no new one, it plays the newest training episode, if these are recorded. A viewer that subscribes
/// later gets the present state, or the last one of the latest episode.
pub struct Follower {
    server: Server,
    address: SocketAddr,
    clock: Clock,
    directory: PathBuf,
    /// Logs of the directory that were there at the start or were played.
    seen: Logs,
    /// The end of the timeline so far.
    end_ns: u64,
    /// The episode that was played last.
    played: Option<Episode>,
    subscribed: Arc<Subscribed>,
}

/// True if a viewer has subscribed to a channel since this was read last.
#[derive(Default)]
struct Subscribed(AtomicBool);

impl Subscribed {
    fn take(&self) -> bool {
        self.0.swap(false, Ordering::AcqRel)
    }
}

impl ServerListener for Subscribed {
    fn on_subscribe(&self, _client: Client, _channel: ChannelView<'_>) {
        self.0.store(true, Ordering::Release);
    }
}

impl Follower {
    /// Listens on `address`; port 0 selects a free port. Logs that are in `directory` already are not played; it need
    /// not exist yet.
    ///
    /// # Errors
    /// If the address cannot be listened on.
    pub fn start(address: SocketAddr, directory: PathBuf, clock: Clock) -> Result<Self, Error> {
        let seen = logs_in(&directory).unwrap_or_default();
        let subscribed = Arc::new(Subscribed::default());
        let listener = Arc::clone(&subscribed) as Arc<dyn ServerListener>;
        let server = Server::start(address, "tandem", None, Some(listener))?;
        let address = server.address(address);
        let (end_ns, played) = (0, None);
        Ok(Self { server, address, clock, directory, seen, end_ns, played, subscribed })
    }

    /// Returns the address that viewers connect to.
    #[must_use]
    pub const fn address(&self) -> SocketAddr {
        self.address
    }

    /// Plays until `is_stopped` returns true, then closes all connections. Logs that cannot be read are left out.
    pub fn run(mut self, is_stopped: &dyn Fn() -> bool) {
        let mut looked_at = None;
        while !is_stopped() {
            let now = (self.clock)();
            let is_due = looked_at.is_none_or(|at| now.saturating_sub(at) >= LOOK_EVERY);
            if is_due {
                looked_at = Some(now);
                if let Some(episode) = self.next_episode() {
                    self.play(&episode, is_stopped);
                    self.played = Some(episode);
                    looked_at = None;
                }
            }
            if let Some(episode) = self.played.as_ref().filter(|_| self.subscribed.take()) {
                let n_messages = episode.messages.len();
                self.server.channels.publish_latest(episode, n_messages, episode.end_ns());
            }
            std::thread::sleep(TICK);
        }
        self.server.stop();
    }

    /// Returns the next episode to play. Older ones that were not played yet are left out.
    fn next_episode(&mut self) -> Option<Episode> {
        let logs = logs_in(&self.directory)?;
        // Logs that were deleted, or written again by a resumed run, are not seen.
        self.seen.retain(|log, inode| logs.get(log) == Some(inode));
        let is_new = |log: &&PathBuf| !self.seen.contains_key(*log);
        let new: Vec<PathBuf> = logs.keys().filter(is_new).cloned().collect();
        let path = next_log(&new)?.to_owned();
        let is_left_out = |log: &&PathBuf| evaluation(log) <= evaluation(&path);
        let left_out = new.iter().filter(is_left_out);
        self.seen.extend(left_out.filter_map(|log| Some((log.clone(), *logs.get(log)?))));
        let mut episode = Episode::read(&path).ok()?;
        self.server.channels.open(&episode.channels).ok()?;
        let start_ns = if self.end_ns == 0 { 0 } else { self.end_ns.saturating_add(PAUSE_NS) };
        episode.shift(start_ns);
        self.end_ns = start_ns.max(episode.end_ns());
        tracing::debug!(?path, "episode played to viewers");
        Some(episode)
    }

    fn play(&self, episode: &Episode, is_stopped: &dyn Fn() -> bool) {
        let (start, mut n_published) = ((self.clock)(), 0);
        let start_ns = episode.messages.first().map_or(0, |message| message.time_ns);
        while n_published < episode.messages.len() && !is_stopped() {
            let played = (self.clock)().saturating_sub(start).as_nanos();
            let position_ns = start_ns.saturating_add(u64::try_from(played).unwrap_or(u64::MAX));
            let position_ns = position_ns.min(episode.end_ns());
            let end = episode.n_until(position_ns);
            self.server.handle.broadcast_time(position_ns);
            if self.subscribed.take() {
                self.server.channels.publish_latest(episode, n_published, position_ns);
            }
            self.server.channels.publish(episode, n_published, end);
            n_published = end;
            std::thread::sleep(TICK);
        }
    }
}

/// Logs with their inodes.
type Logs = BTreeMap<PathBuf, u64>;

/// Returns the finished logs in `directory`, `None` if it cannot be read.
fn logs_in(directory: &Path) -> Option<Logs> {
    let entries = std::fs::read_dir(directory).ok()?.flatten();
    let is_log = |path: &PathBuf| path.extension().is_some_and(|extension| extension == "mcap");
    Some(entries.map(|it| (it.path(), it.ino())).filter(|(path, _)| is_log(path)).collect())
}

/// Returns the first log of the newest evaluation among `new` or, without one, the newest training episode.
fn next_log(new: &[PathBuf]) -> Option<&Path> {
    let evaluations = || new.iter().filter_map(|log| Some((evaluation(log)?, log)));
    let newest = evaluations().map(|(name, _)| name.version).max();
    let first = evaluations().filter(|(name, _)| Some(name.version) == newest).min();
    let first = first.map(|(_, log)| log);
    first.or_else(|| new.iter().max_by_key(|log| LogName::of(log))).map(PathBuf::as_path)
}

/// Returns the name of an evaluation's log; `None` for others.
fn evaluation(log: &Path) -> Option<LogName> {
    LogName::of(log).filter(|name| name.is_evaluation)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_evaluation_is_played_first_and_in_order() {
        let check = |names: &[&str], expected: Option<&str>| {
            let paths: Vec<PathBuf> = names.iter().map(PathBuf::from).collect();
            assert_eq!(next_log(&paths), expected.map(Path::new), "{names:?}");
        };
        check(&[], None);
        let evaluations = ["eval-000001-000.mcap", "eval-000009-000.mcap", "eval-000009-001.mcap"];
        check(&evaluations, Some("eval-000009-000.mcap"));
        check(&[&evaluations[..], &["train-000010-000400.mcap"]].concat(), Some(evaluations[1]));
        check(
            &["train-000001-000001.mcap", "train-000002-000009.mcap"],
            Some("train-000002-000009.mcap"),
        );
        check(
            &["eval-1000000-000.mcap", "eval-1000000-1000.mcap", "eval-1000000-999.mcap"],
            Some("eval-1000000-000.mcap"),
        );
        check(
            &["eval-1000000-1000.mcap", "eval-1000000-999.mcap", "eval-999999-000.mcap"],
            Some("eval-1000000-999.mcap"),
        );
        check(
            &["train-1000000-000400.mcap", "train-999999-000400.mcap"],
            Some("train-1000000-000400.mcap"),
        );
    }
}
