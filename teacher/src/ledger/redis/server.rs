//! The connection to a Redis server, which is opened on demand and reopened after an error.

use std::fmt;
use std::time::Duration;

use redis::{
    Client, Cmd, Connection, ConnectionAddr, IntoConnectionInfo as _, Pipeline, RedisError,
    RedisResult,
};

use crate::ledger::{OpenError, printable};

const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);
const ANSWER_TIMEOUT: Duration = Duration::from_secs(2);

/// The set of all account names. It is for people: no operation depends on it.
const ACCOUNTS: &str = "tandem:accounts";

macro_rules! on_account {
    ($file:literal) => {
        concat!(include_str!("account.lua"), include_str!($file))
    };
}

/// An operation on an account.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Script {
    Open,
    Balance,
    OpenLeases,
    Settle,
    Charge,
}

impl Script {
    /// The source of each script, in the order of the enum.
    const CODE: [&str; 5] = [
        include_str!("open.lua"),
        on_account!("balance.lua"),
        on_account!("open_leases.lua"),
        on_account!("settle.lua"),
        on_account!("charge.lua"),
    ];
}

/// A script with its account and its arguments.
pub(super) struct Call {
    script: Script,
    account: String,
    args: Vec<String>,
}

/// The reply of a script.
pub(super) struct Reply {
    /// Budget, strategy, spent, leased; empty when there is no such account.
    pub(super) fields: Vec<Option<String>>,
    pub(super) numbers: Vec<u64>,
    /// Indices of refused charges.
    pub(super) refused: Vec<u64>,
}

/// A [`Reply`] as the server sends it.
type RawReply = (Vec<Option<String>>, Vec<u64>, Vec<u64>);

/// Properties of a server.
pub(super) struct ServerProperties {
    pub(super) n_accounts: u64,
    /// True if it writes an append-only file.
    pub(super) has_append_only_file: bool,
    /// True if it evicts keys when it runs out of memory.
    pub(super) evicts_keys: bool,
}

/// A server, with a connection to it if one is open.
pub(super) struct Server {
    client: Client,
    name: String,
    scripts: [redis::Script; Script::CODE.len()],
    connection: Option<Connection>,
}

impl Call {
    pub(super) fn new(script: Script, account: &str) -> Self {
        Self { script, account: account.to_owned(), args: Vec::new() }
    }

    pub(super) const fn script(&self) -> Script {
        self.script
    }

    pub(super) fn arg(mut self, arg: impl fmt::Display) -> Self {
        self.args.push(arg.to_string());
        self
    }

    pub(super) fn args(mut self, args: &[u64]) -> Self {
        self.args.extend(args.iter().map(ToString::to_string));
        self
    }

    fn command(&self, hash: &str) -> Cmd {
        let key = |kind| format!("{{tandem:{}}}:{kind}", self.account);
        let mut command = redis::cmd("EVALSHA");
        command.arg(hash).arg(3).arg(key("account")).arg(key("leases")).arg(key("verdicts"));
        command.arg(&self.args);
        command
    }
}

impl Server {
    /// Parses `url`. Sends nothing yet.
    pub(super) fn new(url: &str) -> Result<Self, OpenError> {
        // The URL may contain a password, so the message must not quote it.
        let refused = |what: &str| OpenError::InvalidLocation(format!("the redis:// URL {what}"));
        let parsed = redis::parse_redis_url(url).ok_or_else(|| refused("cannot be read"))?;
        if parsed.query().is_some() || parsed.fragment().is_some() {
            return Err(refused("has a ? or #, which must be written as %3F or %23 in a password"));
        }
        let info = parsed.into_connection_info();
        let info = info.map_err(|error| {
            refused(&format!("cannot be used: {}", printable(&error.to_string())))
        })?;
        let ConnectionAddr::Tcp(host, port) = info.addr() else {
            return Err(refused("names no host"));
        };
        let host = if host.contains(':') { format!("[{host}]") } else { host.clone() };
        let name = format!("redis://{host}:{port}/{}", info.redis_settings().db());
        let settings = info.tcp_settings().clone().set_nodelay(true);
        let client = Client::open(info.set_tcp_settings(settings));
        let client = client.map_err(|error| {
            refused(&format!("cannot be used: {}", printable(&error.to_string())))
        })?;
        let scripts = Script::CODE.map(redis::Script::new);
        Ok(Self { client, name, scripts, connection: None })
    }

    /// Returns the server's address without the password.
    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// Asks the server for its properties.
    pub(super) fn properties(&mut self) -> RedisResult<ServerProperties> {
        let mut pipeline = redis::pipe();
        pipeline.cmd("SCARD").arg(ACCOUNTS);
        pipeline.cmd("INFO").arg("persistence").cmd("INFO").arg("memory");
        let (n_accounts, persistence, memory): (u64, String, String) = self.query(&pipeline)?;
        let has_append_only_file = persistence.lines().any(|line| line == "aof_enabled:1");
        let policy = memory.lines().find_map(|line| line.strip_prefix("maxmemory_policy:"));
        let is_bounded = !memory.lines().any(|line| line == "maxmemory:0");
        let evicts_keys = is_bounded && policy.is_some_and(|policy| policy != "noeviction");
        Ok(ServerProperties { n_accounts, has_append_only_file, evicts_keys })
    }

    /// Sends all calls, then reads all replies. After an error some of the calls may have been executed.
    pub(super) fn run(&mut self, calls: &[Call]) -> RedisResult<Vec<Reply>> {
        let mut pipeline = redis::pipe();
        for call in calls {
            let script = &self.scripts[call.script as usize];
            pipeline.add_command(call.command(script.get_hash()));
            if matches!(call.script, Script::Open) {
                pipeline.cmd("SADD").arg(ACCOUNTS).arg(&call.account).ignore();
            }
        }
        let replies: Vec<RawReply> = self.query(&pipeline)?;
        let reply = |(fields, numbers, refused)| Reply { fields, numbers, refused };
        Ok(replies.into_iter().map(reply).collect())
    }

    /// Runs a pipeline. If the open connection fails, or the server has lost the scripts, the pipeline is run once more
    /// on a new connection. A pipeline that timed out is not repeated.
    fn query<T: redis::FromRedisValue>(&mut self, pipeline: &Pipeline) -> RedisResult<T> {
        if let Some(connection) = self.connection.as_mut() {
            match pipeline.query(connection) {
                Err(error) if !error.is_timeout() => self.connection = None,
                outcome => {
                    self.close_on_error(&outcome);
                    return outcome;
                }
            }
        }
        let connection = self.connect()?;
        let connection = self.connection.insert(connection);
        let outcome = pipeline.query(connection);
        self.close_on_error(&outcome);
        outcome
    }

    /// Closes the connection after an error, because the next reply on it might belong to an earlier call.
    fn close_on_error<T>(&mut self, outcome: &Result<T, RedisError>) {
        if outcome.is_err() {
            self.connection = None;
        }
    }

    fn connect(&self) -> RedisResult<Connection> {
        let mut connection = self.client.get_connection_with_timeout(CONNECT_TIMEOUT)?;
        connection.set_read_timeout(Some(ANSWER_TIMEOUT))?;
        connection.set_write_timeout(Some(ANSWER_TIMEOUT))?;
        for script in &self.scripts {
            script.load(&mut connection)?;
        }
        Ok(connection)
    }
}

impl fmt::Debug for Server {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Server").field("name", &self.name).finish_non_exhaustive()
    }
}
