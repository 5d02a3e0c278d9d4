//! The examples run. Each has a test of its own, which this file includes.

#[path = "../examples/random_actions.rs"]
mod random_actions;
#[path = "../examples/run_policy.rs"]
mod run_policy;
