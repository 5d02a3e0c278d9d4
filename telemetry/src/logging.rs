//! Initialisation of logging. Only a program calls it; libraries emit events.

use std::io::IsTerminal as _;

use tracing_subscriber::Registry;
pub use tracing_subscriber::filter::LevelFilter;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::fmt;
use tracing_subscriber::layer::{Layer, SubscriberExt as _};
use tracing_subscriber::util::SubscriberInitExt as _;

use crate::error::Error;
use crate::standard_error::EventWriter;

/// The destination of log lines, and its filter.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct LogConfig {
    /// Least severe level that is written to standard error; `None` writes nothing there.
    pub console: Option<LevelFilter>,
    /// True if lines on standard error are coloured if that is a terminal.
    pub is_coloured: bool,
    /// Directives that replace the level: `LEVEL` or `TARGET=LEVEL`, separated by commas.
    pub directives: Option<String>,
}

/// A further destination of spans, with its own filter.
pub type ExtraLayer = Box<dyn Layer<Registry> + Send + Sync>;

/// Initialises logging of this process. Lines that cannot be written are dropped.
///
/// # Errors
/// If the directives are malformed, or logging is already initialised.
pub fn init(config: &LogConfig, extra: Option<ExtraLayer>) -> Result<(), Error> {
    let console = match config.console {
        Some(level) => {
            let layer = fmt::layer()
                .with_writer(EventWriter::default)
                .with_ansi(config.is_coloured && std::io::stderr().is_terminal());
            Some(layer.with_filter(filter(level, config)?))
        }
        None => None,
    };
    tracing_subscriber::registry().with(extra).with(console).try_init()?;
    Ok(())
}

/// Returns the filter of `config`, by default Tandem's crates from `level` up and warnings of other crates, except
/// those of Foxglove's server about its viewers: one that goes away is no error of the program.
fn filter(level: LevelFilter, config: &LogConfig) -> Result<Targets, Error> {
    let by_default = || format!("warn,foxglove::websocket=off,tandem={level}");
    let directives = config.directives.clone().unwrap_or_else(by_default);
    match directives.parse::<Targets>() {
        Ok(filter) if filter.iter().all(|(target, _)| is_target(target)) => Ok(filter),
        parsed => Err(Error::LogFilter { filter: directives, source: parsed.err() }),
    }
}

/// Returns true if `name` can be a module path.
fn is_target(name: &str) -> bool {
    name.chars().all(|character| character.is_ascii_alphanumeric() || "_-:".contains(character))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_viewer_that_goes_away_is_no_error_unless_directives_ask_for_it() {
        let passes = |directives: Option<&str>, target: &str| {
            let directives = directives.map(str::to_owned);
            let config = LogConfig { directives, ..LogConfig::default() };
            let filter = filter(LevelFilter::INFO, &config).expect("well-formed");
            filter.would_enable(target, &tracing::Level::ERROR)
        };
        let server = "foxglove::websocket::connected_client";
        assert!(!passes(None, server) && passes(Some("info"), server));
        assert!(passes(None, "foxglove::mcap_writer") && passes(None, "h2::server"));
    }

    #[test]
    fn a_filter_is_a_list_of_levels_and_module_levels() {
        let check = |directives: &str, is_valid: bool| {
            let config =
                LogConfig { directives: Some(directives.to_owned()), ..LogConfig::default() };
            assert_eq!(filter(LevelFilter::INFO, &config).is_ok(), is_valid, "{directives:?}");
        };
        for valid in ["info", "off", "tandem_learner=debug", "warn,tandem_net::link=trace,h2=info"]
        {
            check(valid, true);
        }
        for malformed in ["[[", "tandem=loud", "tandem[run]=info", "a=b=c", "in fo"] {
            check(malformed, false);
        }
    }
}
