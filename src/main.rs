//! `tandem`: teaches robots with two arms by letting a robot with one arm advise them.
//!
//! The only place that reads the clock, the environment and the command line, starts processes and chooses exit
//! codes. What it starts are libraries: see `ARCHITECTURE.md`.

use std::process::ExitCode;

use clap::Parser as _;

mod access;
mod bench;
mod bridge;
mod cli;
mod clock;
mod eval;
mod exit;
mod files;
mod health;
mod input;
mod output;
mod picture;
mod report;
mod run_directory;
mod run_file;
mod services;
mod signals;
mod status;
mod sweep;
mod train;

use cli::{Cli, Command};
use exit::{Exit, Failed};

fn main() -> ExitCode {
    signals::survive_a_limit_of_file_sizes();
    let code = run();
    output::finish();
    code
}

fn run() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) if error.use_stderr() => {
            drop(error.print());
            return Exit::Usage.into();
        }
        Err(help) => return ended(output::print_help(&help)),
    };
    if let Err(failed) = services::start_logging(&cli) {
        return failed.report();
    }
    ended(match cli.command {
        Command::Train(args) => train::train(&args),
        Command::Eval(args) => eval::eval(&args),
        Command::Sweep(args) => sweep::sweep(&args),
        Command::Report(args) => report::report(&args),
        Command::Teacher(args) => services::teacher(args),
        Command::Learner(args) => services::learner(args),
        Command::Worker(args) => services::worker(args),
        Command::Relay(args) => services::relay(args),
        Command::Bridge(args) => bridge::bridge(args),
        Command::Health(args) => health::health(&args),
        Command::Status(args) => status::status(&args),
        Command::Bench(args) => bench::bench(&args),
        Command::Policy(args) => files::policy(&args),
        Command::Mcap(args) => files::mcap(&args),
        Command::Replay(args) => files::replay(&args),
        Command::Picture(args) => picture::picture(&args),
    })
}

fn ended(done: Result<(), Failed>) -> ExitCode {
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(failed) => failed.report(),
    }
}
