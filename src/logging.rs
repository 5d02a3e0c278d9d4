//! Destinations and filters of log lines.

use tandem_telemetry::logging::{ExtraLayer, LevelFilter, LogConfig};

use crate::cli::{Cli, Command};
use crate::exit::{Exit, Failed, OrExit as _};

/// Ends what logging has started when it is dropped: the last spans are sent.
#[derive(Default)]
pub(crate) struct LogGuard {
    #[cfg(feature = "otlp")]
    _exporter: Option<crate::otlp::Exporter>,
}

/// Sends log lines to standard error: from level `info` for services, from `warn` for other commands.
pub(crate) fn start(cli: &Cli) -> Result<LogGuard, Failed> {
    let level = match &cli.command {
        Command::Teacher(_) | Command::Learner(_) | Command::Worker(_) | Command::Relay(_) => {
            LevelFilter::INFO
        }
        Command::Bridge(args) if args.command.is_none() => LevelFilter::INFO,
        _ => LevelFilter::WARN,
    };
    let directives = cli.log.clone().or_else(rust_log);
    let config = LogConfig { console: Some(level), is_coloured: wants_colour(), directives };
    let (extra, guard) = spans(cli)?;
    tandem_telemetry::logging::init(&config, extra).or_exit(Exit::Usage, String::new)?;
    Ok(guard)
}

/// Returns the destination of spans, if the command line names one.
#[cfg(feature = "otlp")]
fn spans(cli: &Cli) -> Result<(Option<ExtraLayer>, LogGuard), Failed> {
    use tracing_subscriber::Layer as _;
    use tracing_subscriber::filter::filter_fn;

    use crate::otlp::{self, SpanLayer};

    let component = match &cli.command {
        Command::Teacher(_) => "teacher",
        Command::Learner(_) => "learner",
        Command::Worker(_) => "worker",
        Command::Relay(_) => "relay",
        Command::Env(_) => "environment",
        Command::Bridge(args) if args.command.is_none() => "bridge",
        _ => return Ok((None, LogGuard::default())),
    };
    let Some(endpoint) = &cli.otlp_endpoint else { return Ok((None, LogGuard::default())) };
    let (layer, exporter) = otlp::start(endpoint, component)?;
    let layer = layer.with_filter(filter_fn(SpanLayer::wants));
    Ok((Some(Box::new(layer)), LogGuard { _exporter: Some(exporter) }))
}

#[cfg(not(feature = "otlp"))]
const fn spans(_: &Cli) -> Result<(Option<ExtraLayer>, LogGuard), Failed> {
    Ok((None, LogGuard {}))
}

/// Returns false if `NO_COLOR` is set and not empty (<https://no-color.org>).
fn wants_colour() -> bool {
    std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty())
}

#[expect(clippy::disallowed_methods, reason = "RUST_LOG is read once, before anything is logged")]
fn rust_log() -> Option<String> {
    std::env::var("RUST_LOG").ok().filter(|filter| !filter.is_empty())
}
