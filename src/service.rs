//! The services as subcommands: each binds its address, prints it and serves until it is asked to exit.

mod environment;
mod learner;
mod listen;
mod relay;
mod resume_command;
mod teacher;
mod worker;

use tandem_system::fd_limit;

use crate::exit::{Exit, Failed, OrExit as _};
use crate::runtime;

pub(crate) use environment::environment;
pub(crate) use learner::learner;
pub(crate) use listen::{bind, listen};
pub(crate) use relay::relay;
pub(crate) use teacher::{policy_address, teacher, teacher_failed};
pub(crate) use worker::{worker, worker_failed};

/// Runs a service to its end on this thread.
fn run(service: impl Future<Output = Result<(), Failed>>) -> Result<(), Failed> {
    fd_limit::raise();
    runtime::new().or_exit(Exit::TryAgain, String::new)?.block_on(service)
}
