//! Sets up where log lines go. Only a program calls this; libraries emit.

use std::fs::OpenOptions;
use std::io::IsTerminal as _;
use std::path::PathBuf;
use std::sync::Mutex;

pub use tracing_subscriber::filter::LevelFilter;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::fmt;
use tracing_subscriber::layer::{Layer as _, SubscriberExt as _};
use tracing_subscriber::util::SubscriberInitExt as _;

use crate::error::Error;
use crate::standard_error::Events;

/// Where log lines go and which ones.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct LogConfig {
    /// The least severe level shown on standard error; `None` for none at all.
    pub console: Option<LevelFilter>,
    /// A file that gets everything from `info` up; lines are added to what it has.
    pub file: Option<PathBuf>,
    /// Directives that take the place of the levels above: `LEVEL` or `TARGET=LEVEL`, separated by commas.
    pub directives: Option<String>,
}

/// Sends the log lines of this process where `config` says. Lines that cannot be written are dropped.
///
/// # Errors
/// When the file cannot be opened, the directives are malformed or logging is already set up.
pub fn init(config: &LogConfig) -> Result<(), Error> {
    let console = match config.console {
        Some(level) => {
            let layer = fmt::layer()
                .with_writer(Events::default)
                .with_ansi(std::io::stderr().is_terminal());
            Some(layer.with_filter(filter(level, config)?))
        }
        None => None,
    };
    let file = match &config.file {
        Some(path) => {
            let file = OpenOptions::new()
                .append(true)
                .create(true)
                .open(path)
                .map_err(Error::io("open", path))?;
            let layer = fmt::layer().with_writer(Mutex::new(file)).with_ansi(false);
            Some(layer.with_filter(filter(LevelFilter::INFO, config)?))
        }
        None => None,
    };
    tracing_subscriber::registry().with(console).with(file).try_init()?;
    Ok(())
}

/// Our own crates from `level` up, others' warnings.
fn filter(level: LevelFilter, config: &LogConfig) -> Result<Targets, Error> {
    let directives = config.directives.clone().unwrap_or_else(|| format!("warn,tandem={level}"));
    match directives.parse::<Targets>() {
        Ok(filter) if filter.iter().all(|(target, _)| is_target(target)) => Ok(filter),
        parsed => Err(Error::LogFilter { filter: directives, source: parsed.err() }),
    }
}

/// Whether `name` can be the path of a module.
fn is_target(name: &str) -> bool {
    name.chars().all(|character| character.is_ascii_alphanumeric() || "_-:".contains(character))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_filter_is_a_list_of_levels_and_modules() {
        let check = |directives: &str, is_good: bool| {
            let config =
                LogConfig { directives: Some(directives.to_owned()), ..LogConfig::default() };
            assert_eq!(filter(LevelFilter::INFO, &config).is_ok(), is_good, "{directives:?}");
        };
        for good in ["info", "off", "tandem_learner=debug", "warn,tandem_net::link=trace,h2=info"] {
            check(good, true);
        }
        for bad in ["[[", "tandem=loud", "tandem[run]=info", "a=b=c", "in fo"] {
            check(bad, false);
        }
    }
}
