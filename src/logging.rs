//! Where log lines go, and which of them.

use tandem_telemetry::logging::{LevelFilter, LogConfig};

use crate::cli::{Cli, Command};
use crate::exit::{Exit, Failed, OrExit as _};

/// Sends log lines to standard error: from level `info` for services, from `warn` for other commands.
pub(crate) fn start(cli: &Cli) -> Result<(), Failed> {
    let level = match &cli.command {
        Command::Teacher(_) | Command::Learner(_) | Command::Worker(_) | Command::Relay(_) => {
            LevelFilter::INFO
        }
        Command::Bridge(args) if args.command.is_none() => LevelFilter::INFO,
        _ => LevelFilter::WARN,
    };
    let directives = cli.log.clone().or_else(rust_log);
    let config =
        LogConfig { console: Some(level), is_coloured: wants_colour(), file: None, directives };
    tandem_telemetry::logging::init(&config).or_exit(Exit::Usage, String::new)
}

/// Returns false if `NO_COLOR` is set and not empty (<https://no-color.org>).
#[expect(clippy::disallowed_methods, reason = "NO_COLOR is read once, before anything is logged")]
fn wants_colour() -> bool {
    std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty())
}

#[expect(clippy::disallowed_methods, reason = "RUST_LOG is read once, before anything is logged")]
fn rust_log() -> Option<String> {
    std::env::var("RUST_LOG").ok().filter(|filter| !filter.is_empty())
}
