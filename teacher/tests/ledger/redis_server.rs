//! A Redis server for one test.

use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use tempfile::TempDir;

use crate::skipped::skip;

/// A running server with an append-only file. It ends with the test.
pub(crate) struct RedisServer {
    process: Child,
    port: u16,
    directory: TempDir,
    settings: Vec<String>,
}

impl RedisServer {
    /// Starts a server. Reports that and returns `None` if Redis is not installed.
    pub(crate) fn start() -> Option<Self> {
        Self::start_with(&["--appendonly", "yes"])
    }

    /// Starts a server with other settings.
    pub(crate) fn start_with(settings: &[&str]) -> Option<Self> {
        if Command::new("redis-server").arg("--version").stdout(Stdio::null()).status().is_err() {
            skip("REDIS", "the ledger in Redis: redis-server is not installed");
            return None;
        }
        let directory = tempfile::tempdir().expect("a directory");
        let settings = settings.iter().map(|setting| (*setting).to_owned()).collect::<Vec<_>>();
        // Another process may take the free port before the server does.
        let started = (0..10).find_map(|_| {
            let port = TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr());
            let port = port.expect("a port").port();
            run(port, directory.path(), &settings).map(|process| (port, process))
        });
        let (port, process) = started.expect("redis-server starts");
        Some(Self { process, port, directory, settings })
    }

    pub(crate) fn url(&self) -> String {
        format!("redis://127.0.0.1:{}/0", self.port)
    }

    pub(crate) const fn port(&self) -> u16 {
        self.port
    }

    /// Kills the server.
    pub(crate) fn kill(&mut self) {
        self.process.kill().expect("killed");
        self.process.wait().expect("gone");
    }

    /// Restarts the server on the same port and directory.
    pub(crate) fn restart(&mut self) {
        let again = || run(self.port, self.directory.path(), &self.settings);
        self.process = (0..10).find_map(|_| again()).expect("redis-server starts again");
    }

    /// Sends a signal to the server's process.
    pub(crate) fn signal(&self, signal: &str) {
        let pid = self.process.id().to_string();
        assert!(Command::new("kill").args([signal, &pid]).status().expect("kill runs").success());
    }

    /// Opens a connection for the test.
    pub(crate) fn connection(&self) -> redis::Connection {
        let client = redis::Client::open(self.url()).expect("a URL");
        client.get_connection().expect("a connection")
    }
}

impl Drop for RedisServer {
    fn drop(&mut self) {
        drop(self.process.kill());
        drop(self.process.wait());
    }
}

/// Starts a server and waits until it answers. Returns `None` if it ends first.
fn run(port: u16, directory: &Path, settings: &[String]) -> Option<Child> {
    let mut process = Command::new("redis-server")
        .args(["--port", &port.to_string(), "--bind", "127.0.0.1", "--save", "", "--dir"])
        .arg(directory)
        .args(settings)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("starts");
    let client = redis::Client::open(("127.0.0.1", port)).expect("an address");
    for _ in 0..6000 {
        let answer = client
            .get_connection_with_timeout(Duration::from_secs(1))
            .and_then(|mut connection| redis::cmd("PING").query::<String>(&mut connection));
        match answer {
            Ok(_) => return Some(process),
            // The server is up and requires a password.
            Err(error) if error.code() == Some("NOAUTH") => return Some(process),
            Err(_) => std::thread::sleep(Duration::from_millis(10)),
        }
        if process.try_wait().expect("a child").is_some() {
            return None;
        }
    }
    drop(process.kill());
    None
}
