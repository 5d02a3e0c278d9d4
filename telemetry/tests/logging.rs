//! Initialisation of logging. There is one test because a process initialises logging once.

use std::path::Path;

use tandem_telemetry::Error;
use tandem_telemetry::events::{BudgetExhausted, ParametersPublished};
use tandem_telemetry::logging::{LogConfig, init};

#[test]
fn the_log_file_contains_events_from_level_info_up_with_their_fields() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let file = dir.path().join("tandem.log");
    let config = LogConfig { file: Some(file.clone()), ..LogConfig::default() };
    let malformed = LogConfig { directives: Some("tandem=loud".to_owned()), ..config.clone() };
    assert!(matches!(init(&malformed, None), Err(Error::LogFilter { .. })));
    let nowhere = LogConfig {
        file: Some(Path::new("/nowhere/tandem.log").to_owned()),
        ..LogConfig::default()
    };
    assert!(matches!(init(&nowhere, None), Err(Error::Io { action: "open", .. })));

    init(&config, None).expect("the first initialisation");
    assert!(matches!(init(&config, None), Err(Error::LoggingTwice(_))));
    BudgetExhausted { account: "run-7", budget: 500 }.emit();
    tracing::warn!(peer = "learner", attempt = 2, "call failed, retrying");
    ParametersPublished { version: 3 }.emit();

    let text = std::fs::read_to_string(&file).expect("the log");
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 2, "{text}");
    assert!(
        lines[0].contains("INFO")
            && lines[0].contains("advice budget exhausted account=\"run-7\" budget=500")
    );
    assert!(
        lines[1].contains("WARN")
            && lines[1].contains("call failed, retrying peer=\"learner\" attempt=2")
    );
    assert!(!text.contains('\u{1b}'), "a file has no colours");
}
