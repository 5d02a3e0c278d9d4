//! `tandem bench`: measures the performance of the parts on this machine, as rates and as ratios within one run.

use std::path::Path;
use std::pin::pin;
use std::process::{Output, Stdio};

use anyhow::anyhow;
use clap::ValueEnum as _;
use serde_json::{Value, json};
use tandem_bench::{Clock, Figure, rates};
use tandem_core::Task;

use crate::cli::{BenchArgs, BenchName};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{clock, output, policy_file, program, runtime, signals};

mod record;
mod scale;

pub(crate) fn bench(args: &BenchArgs) -> Result<(), Failed> {
    let mut all = BenchName::value_variants().to_vec();
    all.retain(|what| !matches!(what, BenchName::Scale | BenchName::Record));
    let chosen = if args.what.is_empty() { &all } else { &args.what };
    let clock = clock::since_now();
    for what in chosen {
        let figures = match what {
            BenchName::Sim => rates::sim(&clock).or_exit(Exit::Bug, String::new)?,
            BenchName::Inference => rates::inference(&clock).or_exit(Exit::Bug, String::new)?,
            BenchName::Update => rates::update(&clock),
            BenchName::Replay => rates::replay(&clock),
            BenchName::Teacher => teacher(&clock)?,
            BenchName::EndToEnd => end_to_end()?,
            BenchName::Record => record::record()?,
            BenchName::Scale if args.json => scale::scale(&args.scale)?.figures(),
            BenchName::Scale => {
                let table = scale::scale(&args.scale)?.to_string();
                output::print(table.trim_end())?;
                continue;
            }
        };
        for Figure { name, value, unit } in figures {
            if args.json {
                output::print(json!({"name": name, "value": value, "unit": unit}))?;
            } else {
                output::print(format_args!("{name:<44} {value:>12.2} {unit}"))?;
            }
        }
    }
    Ok(())
}

/// Measures the teacher service with the shipped teacher and a ledger in a temporary directory.
fn teacher(clock: &Clock) -> Result<Vec<Figure>, Failed> {
    let policy = policy_file::shipped_teacher(Task::Push.name())?;
    let name = format!("tandem-bench-teacher-{}", std::process::id());
    let directory = std::env::temp_dir().join(name);
    let made = std::fs::create_dir_all(&directory);
    made.or_exit(Exit::TryAgain, || format!("cannot create {}", directory.display()))?;
    let ledger = directory.join("ledger.sqlite").to_string_lossy().into_owned();
    let config = tandem_teacher::Config { policy, critic: None, ledger };
    let figures = tandem_bench::teacher::measure(config, clock);
    drop(std::fs::remove_dir_all(&directory));
    figures.or_exit(Exit::TryAgain, || "cannot measure the teacher".to_owned())
}

/// Rates and memory of a training run of 30 rounds with evaluations.
fn end_to_end() -> Result<Vec<Figure>, Failed> {
    let summary = short_run(
        &["--max-env-steps", "24000", "--set", "evaluation.every_env_steps=20000"],
        |_directory| (),
    )?
    .0;
    let number = |key: &str| summary[key].as_f64().unwrap_or_default();
    let figure = |name: &str, value, unit| Figure::new(format!("end-to-end/{name}"), value, unit);
    Ok(vec![
        figure("env-steps", number("env_steps") / number("wall_s"), "env steps/s"),
        figure("updates", number("updates") / number("wall_s"), "updates/s"),
        figure("learner-memory", number("learner_mib"), "MiB"),
        figure("teacher-memory", number("teacher_mib"), "MiB"),
        figure("worker-memory", number("worker_mib"), "MiB"),
    ])
}

/// Trains in a temporary directory with these options, and returns the summary and what `inspect` finds in the directory
/// before it is removed, also if the run is interrupted.
fn short_run<T>(options: &[&str], inspect: impl FnOnce(&Path) -> T) -> Result<(Value, T), Failed> {
    let directory = std::env::temp_dir().join(format!("tandem-bench-{}", std::process::id()));
    let program = program::file().or_exit(Exit::Bug, String::new)?;
    let mut command = tokio::process::Command::new(program);
    command.args(["train", "--json", "--exit-with-stdin", "--no-dashboard", "--max-minutes", "0"]);
    command.args(options).arg("--out").arg(&directory);
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null());
    let run = output_of(command);
    let inspected = inspect(&directory);
    drop(std::fs::remove_dir_all(&directory));
    let summary = serde_json::from_slice(&run?.stdout)
        .or_exit(Exit::TryAgain, || "the short run failed; try `tandem train`".to_owned())?;
    Ok((summary, inspected))
}

/// Runs a command to its end. If a signal comes first, closes its standard input and waits until it has exited.
fn output_of(mut command: tokio::process::Command) -> Result<Output, Failed> {
    let runtime = runtime::new().or_exit(Exit::TryAgain, String::new)?;
    runtime.block_on(async {
        let interrupted = signals::shutdown_token(false)?;
        let cannot_start = || "cannot start a run".to_owned();
        let mut child = command.spawn().or_exit(Exit::TryAgain, cannot_start)?;
        let input = child.stdin.take();
        let mut ended = pin!(child.wait_with_output());
        tokio::select! {
            output = &mut ended => output.or_exit(Exit::TryAgain, cannot_start),
            () = interrupted.cancelled() => {
                drop(input);
                drop(ended.await);
                Err(Failed::new(Exit::Interrupted, anyhow!("interrupted")))
            }
        }
    })
}
