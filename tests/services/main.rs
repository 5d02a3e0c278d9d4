//! The services, clients and logs of the crates `environment`, `learner`, `net`, `teacher`, `telemetry` and `worker`
//! through their public interfaces. The tests lie in the folders of their crates; together, and without optimization, they compile in a fraction of the time.

#![expect(
    clippy::panic,
    clippy::print_stdout,
    clippy::unwrap_used,
    reason = "tests say what went wrong, and measurements are printed"
)]

#[path = "../../net/tests/calls/main.rs"]
mod calls;
#[path = "../../environment/tests/service.rs"]
mod environment_service;
#[path = "../../telemetry/tests/episode_log.rs"]
mod episode_log_tests;
#[path = "../../teacher/tests/ledger/main.rs"]
mod ledger_tests;
#[path = "../../learner/tests/service/main.rs"]
mod service_tests;
#[path = "../../worker/tests/services/main.rs"]
mod services;
mod skipped;
#[path = "../../telemetry/tests/trial_log.rs"]
mod trial_log_tests;
