//! The server of environments that the command line names.

use std::ffi::OsString;
use std::sync::Arc;
use std::time::Duration;

use tandem_net::ClientConfig;
use tandem_worker::{EnvironmentConfig, ServedTask};

use crate::access;
use crate::cli::{ClientArgs, EnvironmentArgs, SecretArgs};
use crate::environment_command::CommandServer;
use crate::exit::Failed;
use crate::shell::shell_text;

/// The environments in which a worker plays.
pub(crate) enum EnvironmentSource {
    /// The worker simulates them.
    Simulator,
    /// A server that the worker does not start.
    Address(EnvironmentConfig),
    /// A server that the worker starts.
    Command(EnvironmentConfig, Arc<CommandServer>),
}

impl EnvironmentSource {
    /// Reads the options. `default` is the client of a server without a token and an authority of its own.
    pub(crate) fn of(args: &EnvironmentArgs, default: &ClientConfig) -> Result<Self, Failed> {
        let reply_timeout = args.env_timeout_s.unwrap_or(EnvironmentConfig::REPLY_TIMEOUT);
        let max_attempts = EnvironmentConfig::MAX_ATTEMPTS;
        if let Some(address) = &args.env {
            let client = client_config(args, default)?;
            let server = Arc::new(address.clone());
            let config = EnvironmentConfig { server, client, reply_timeout, max_attempts };
            return Ok(Self::Address(config));
        }
        let Some(command) = &args.env_command else { return Ok(Self::Simulator) };
        let server = Arc::new(CommandServer::new(command.clone(), reply_timeout));
        let config = EnvironmentConfig {
            server: server.clone(),
            client: ClientConfig::default(),
            reply_timeout,
            max_attempts,
        };
        Ok(Self::Command(config, server))
    }

    pub(crate) fn config(&self) -> Option<EnvironmentConfig> {
        match self {
            Self::Simulator => None,
            Self::Address(config) | Self::Command(config, _) => Some(config.clone()),
        }
    }

    /// Returns the task of the server, if there is one.
    pub(crate) async fn served_task(&self) -> Result<Option<ServedTask>, tandem_worker::Error> {
        let Some(config) = self.config() else { return Ok(None) };
        tandem_worker::describe_environments(config).await.map(Some)
    }

    /// Ends the server if this process has started it.
    pub(crate) async fn end(&self) {
        if let Self::Command(_, server) = self {
            server.end().await;
        }
    }
}

fn client_config(args: &EnvironmentArgs, default: &ClientConfig) -> Result<ClientConfig, Failed> {
    if args.env_token_file.is_none() && args.env_tls_ca.is_none() {
        return Ok(default.clone());
    }
    let secret = SecretArgs { token_file: args.env_token_file.clone() };
    let own = access::client_config(&ClientArgs { tls_ca: args.env_tls_ca.clone() }, &secret)?;
    Ok(own.with_metrics(default.metrics().clone()))
}

/// Returns the options as arguments of a worker.
pub(crate) fn arguments(args: &EnvironmentArgs) -> Vec<OsString> {
    let EnvironmentArgs { env, env_command, env_timeout_s, env_token_file, env_tls_ca } = args;
    let mut options: Vec<OsString> = Vec::new();
    let mut push = |name: &str, value: Option<OsString>| {
        options.extend(value.into_iter().flat_map(|value| [name.into(), value]));
    };
    push("--env", env.as_ref().map(OsString::from));
    push("--env-command", env_command.as_ref().map(OsString::from));
    push("--env-token-file", env_token_file.as_ref().map(OsString::from));
    push("--env-tls-ca", env_tls_ca.as_ref().map(OsString::from));
    let timeout_s = env_timeout_s.filter(|_| names_server(args));
    push("--env-timeout-s", timeout_s.map(seconds_text));
    options
}

/// Returns the options for a shell.
pub(crate) fn shell_words(args: &EnvironmentArgs) -> String {
    let words = arguments(args).into_iter();
    let words = words.map(|word| shell_text(word.to_string_lossy().into_owned()));
    words.collect::<Vec<_>>().join(" ")
}

/// Returns true if the options name a server.
pub(crate) const fn names_server(args: &EnvironmentArgs) -> bool {
    args.env.is_some() || args.env_command.is_some()
}

/// Describes the server for a message, if the options name one.
pub(crate) fn shown(args: &EnvironmentArgs) -> Option<String> {
    let address = args.env.as_ref().map(|address| format!("the server at {address}"));
    address.or_else(|| Some(format!("the command {:?}", args.env_command.as_ref()?)))
}

fn seconds_text(duration: Duration) -> OsString {
    duration.as_secs_f64().to_string().into()
}
