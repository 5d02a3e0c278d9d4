//! Runs the examples through their tests, which this file includes.

#[path = "../examples/observe.rs"]
#[expect(dead_code, reason = "the example's main function is not used")]
mod observe;
#[path = "../examples/random_actions.rs"]
mod random_actions;
#[path = "../examples/run_policy.rs"]
mod run_policy;
