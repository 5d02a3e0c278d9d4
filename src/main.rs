//! `tandem`: trains policies for two robot arms with advice from a one-arm policy.
//!
//! Only this crate reads the clock, the environment and the command line, starts processes and chooses exit codes. The
//! work is done by the libraries of the workspace: see `ARCHITECTURE.md`.

use std::process::ExitCode;

use clap::Parser as _;

mod access;
mod bench;
mod bridge;
mod call_failure;
mod cli;
mod clock;
mod columns;
mod commands_page;
mod dashboard;
mod environment_command;
mod environment_file;
mod environment_server;
mod eval;
mod evaluation;
mod exit;
mod film;
mod health;
mod input;
mod launch;
mod live;
mod logging;
mod mcap;
mod metrics;
#[cfg(feature = "otlp")]
mod otlp;
mod output;
mod picture;
mod policy;
mod policy_file;
mod program;
mod progress_json;
mod progress_lines;
mod progress_text;
mod replay;
mod report;
mod run_directory;
mod run_display;
mod run_file;
mod run_pages;
mod runtime;
mod scene;
mod served_task;
mod service;
mod settings_page;
mod shell;
mod signals;
mod status;
mod sweep;
mod train;
mod version;

use cli::{Cli, Command};
use exit::{Exit, Failed};

fn main() -> ExitCode {
    program::set_process_name();
    signals::ignore_file_size_signal();
    let code = run();
    output::flush_messages();
    code
}

fn run() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) if error.use_stderr() => {
            drop(error.print());
            return Exit::Usage.into();
        }
        Err(help) => return exit_code(output::print_help(&help)),
    };
    let started = logging::start(&cli);
    match cli.command {
        Command::EnvGuard(args) => {
            let code = started.and_then(|_guard| environment_command::guard(args.command));
            code.map_or_else(|failed| output::report(&failed), ExitCode::from)
        }
        command => exit_code(started.and_then(|_guard| dispatch(command))),
    }
}

fn dispatch(command: Command) -> Result<(), Failed> {
    match command {
        Command::Train(args) => train::train(&args),
        Command::Eval(args) => eval::eval(&args),
        Command::Sweep(args) => sweep::sweep(&args),
        Command::Report(args) => report::report(&args),
        Command::Teacher(args) => service::teacher(args),
        Command::Learner(args) => service::learner(args),
        Command::Env(args) => service::environment(args),
        // Handled by the caller, because its exit code is that of another program.
        Command::EnvGuard(_) => Ok(()),
        Command::Worker(args) => service::worker(args),
        Command::Relay(args) => service::relay(args),
        Command::Bridge(args) => bridge::bridge(args),
        Command::Health(args) => health::health(&args),
        Command::Status(args) => status::status(&args),
        Command::Bench(args) => bench::bench(&args),
        Command::Policy(args) => policy::policy(args.command),
        Command::Mcap(args) => mcap::mcap(&args),
        Command::Replay(args) => replay::replay(&args),
        Command::Picture(args) => picture::picture(&args),
        Command::Scene(args) => scene::scene(&args),
        Command::Commands => commands_page::print(),
    }
}

fn exit_code(result: Result<(), Failed>) -> ExitCode {
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(failed) => output::report(&failed),
    }
}
