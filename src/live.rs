//! Episodes in Foxglove: servers of its websocket protocol, and the threads that play on them.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use tandem_core::text::counted;
use tandem_telemetry::Error;
use tandem_telemetry::live::{Follower, Replay};
use tokio::sync::oneshot;

use crate::exit::{Exit, Failed, OrExit as _};
use crate::{clock, output, runtime, signals};

/// Plays `logs` to viewers until the process is asked to exit.
pub(crate) fn serve(address: SocketAddr, logs: &[PathBuf]) -> Result<(), Failed> {
    let replay = Replay::start(address, logs, clock::since_now()).map_err(failed)?;
    announce(replay.address(), &format!(", {}; Ctrl-C ends", counted(logs.len(), "episode")));
    let runtime = runtime::new().or_exit(Exit::TryAgain, String::new)?;
    runtime.block_on(async {
        let shutdown = signals::shutdown_token(false)?;
        let (ended, end) = oneshot::channel();
        let stop = shutdown.clone();
        let player = std::thread::Builder::new().name("player".to_owned());
        let player = player.spawn(move || {
            // Fails only if this command has failed meanwhile.
            drop(ended.send(replay.run(&|| stop.is_cancelled())));
        });
        player.or_exit(Exit::TryAgain, || "cannot start a thread".to_owned())?;
        end.await.or_exit(Exit::Bug, || "the player panicked".to_owned())?.map_err(failed)
    })
}

/// Fails if `address` cannot be listened on, before a long computation.
pub(crate) fn check_address(address: SocketAddr) -> Result<(), Failed> {
    let listener = std::net::TcpListener::bind(address);
    listener.map(drop).map_err(|source| failed(Error::Listen { address, source }))
}

/// A thread that plays the logs of a run to viewers. It ends when this value is dropped.
pub(crate) struct LiveRun {
    is_stopped: Arc<AtomicBool>,
    player: Option<JoinHandle<()>>,
}

impl LiveRun {
    /// Plays the logs that become finished in `directory`.
    pub(crate) fn start(address: SocketAddr, directory: PathBuf) -> Result<Self, Failed> {
        let follower = Follower::start(address, directory, clock::since_now()).map_err(failed)?;
        announce(follower.address(), "");
        let is_stopped = Arc::new(AtomicBool::new(false));
        let stop = Arc::clone(&is_stopped);
        let player = std::thread::Builder::new().name("player".to_owned());
        let player = player
            .spawn(move || follower.run(&|| stop.load(Ordering::Relaxed)))
            .or_exit(Exit::TryAgain, || "cannot start a thread".to_owned())?;
        Ok(Self { is_stopped, player: Some(player) })
    }
}

impl Drop for LiveRun {
    fn drop(&mut self) {
        self.is_stopped.store(true, Ordering::Relaxed);
        if let Some(player) = self.player.take() {
            // A panic was reported by its thread; the run is not affected.
            drop(player.join());
        }
    }
}

fn announce(address: SocketAddr, detail: &str) {
    output::message(format_args!("tandem: live on ws://{address}{detail}"));
}

fn failed(error: Error) -> Failed {
    let exit = match error {
        Error::Listen { .. } => Exit::TryAgain,
        _ => Exit::Data,
    };
    Failed::new(exit, error)
}
