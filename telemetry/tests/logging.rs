//! Initialisation of logging. There is one test because a process initialises logging once.

use std::fs::File;
use std::sync::Mutex;

use tandem_telemetry::Error;
use tandem_telemetry::events::{ParametersPublished, RunFinished};
use tandem_telemetry::logging::{LevelFilter, LogConfig, init};
use tracing_subscriber::fmt;
use tracing_subscriber::layer::Layer as _;

#[test]
fn a_further_destination_gets_events_with_their_fields() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let file = dir.path().join("tandem.log");
    let config = LogConfig { console: Some(LevelFilter::OFF), ..LogConfig::default() };
    let malformed = LogConfig { directives: Some("tandem=loud".to_owned()), ..config.clone() };
    assert!(matches!(init(&malformed, None), Err(Error::LogFilter { .. })));

    let writer = Mutex::new(File::create(&file).expect("creates"));
    let layer = fmt::layer().with_writer(writer).with_ansi(false).with_filter(LevelFilter::INFO);
    init(&config, Some(layer.boxed())).expect("the first initialisation");
    assert!(matches!(init(&config, None), Err(Error::LoggingTwice(_))));
    RunFinished { reason: "800 steps", round: 7, digest: "5f3a" }.emit();
    tracing::warn!(peer = "learner", attempt = 2, "call failed, retrying");
    ParametersPublished { version: 3 }.emit();

    let text = std::fs::read_to_string(&file).expect("the log");
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 2, "{text}");
    assert!(lines[0].contains("INFO"), "{text}");
    assert!(
        lines[0].contains("run finished reason=\"800 steps\" round=7 digest=\"5f3a\""),
        "{text}"
    );
    assert!(
        lines[1].contains("WARN")
            && lines[1].contains("call failed, retrying peer=\"learner\" attempt=2")
    );
}
