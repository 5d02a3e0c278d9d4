//! The end of a run: its summary, curve and report.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use tandem_core::evaluation::TEST_SEED;
use tandem_proto::pb;
use tandem_report::FilmStrip;
use tandem_system::atomic_file;

use super::plan::Plan;
use super::processes::PeakMemory;
use crate::cli::{TrainArgs, task_flags};
use crate::columns::N_COLUMNS;
use crate::environment_server::names_server;
use crate::evaluation::{EvaluatedPolicy, EvaluationResult, Part, measure, measure_served};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::progress_text::{advice_text, clock_text, grouped};
use crate::run_pages::RunPages;
use crate::shell::shell_word;
use crate::{film, output, policy_file, run_directory, signals};

/// File in the run directory.
const FILE: &str = "summary.json";
/// Number of test goals from which on the report shows episodes of the test.
const MIN_TEST_EPISODES_OF_FILMS: usize = 100;

/// Evaluates the best policy on the test goals, draws the curve and prints the summary.
pub(super) fn print(
    plan: &Plan,
    last: &pb::Progress,
    memory: PeakMemory,
    args: &TrainArgs,
) -> Result<(), Failed> {
    let saved = || format!("the run is complete and saved in {}", plan.out.display());
    let result = test(plan, args).map_err(|failed| {
        if failed.exit() == Exit::Interrupted {
            output::message(format_args!("{}; its test was interrupted", saved()));
        }
        failed.context(saved())
    })?;
    let json = summary_json(plan, last, memory, &result).to_string();
    save(&plan.out, &json).map_err(|failed| failed.context(saved()))?;
    let (result, pages) = pages(plan, result, args).map_err(|failed| failed.context(saved()))?;
    let summary = match args.json {
        true => json,
        false => summary_lines(plan, last, memory, &result, &pages).join("\n"),
    };
    output::print(summary).map_err(|failed| failed.context(saved()))
}

/// Writes the summary, from which reports take the success on test goals.
fn save(out: &Path, summary: &str) -> Result<(), Failed> {
    let path = out.join(FILE);
    atomic_file::replace(&path, format!("{summary}\n").as_bytes())
        .or_cannot_write(|| format!("cannot write {}", path.display()))
}

/// Removes the summary of a run that goes on.
pub(super) fn remove(out: &Path) -> Result<(), Failed> {
    let path = out.join(FILE);
    match std::fs::remove_file(&path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(error).or_cannot_write(|| format!("cannot remove {}", path.display()))
        }
        _ => Ok(()),
    }
}

/// Plays the test goals with the best policy, on the server of the environments if the run has one.
fn test(plan: &Plan, args: &TrainArgs) -> Result<EvaluationResult, Failed> {
    let (path, n_episodes) = (plan.best_policy(), plan.config.evaluation.test_episodes);
    let (policy, goals) = (policy_file::load(&path)?, (n_episodes, TEST_SEED));
    if names_server(&plan.environment) {
        let subject = (Part::AllArms, &policy);
        return measure_served(&plan.environment, subject, goals, args.exit_with_stdin);
    }
    let subject = EvaluatedPolicy::new(policy, &path)?;
    signals::unless_interrupted(args.exit_with_stdin, move || {
        measure(&subject, n_episodes, TEST_SEED)
    })
}

/// Writes the pages of the run, which show episodes of the test.
fn pages(
    plan: &Plan,
    result: EvaluationResult,
    args: &TrainArgs,
) -> Result<(EvaluationResult, RunPages), Failed> {
    let (config, out) = (plan.config.clone(), plan.out.clone());
    signals::unless_interrupted(args.exit_with_stdin, move || {
        let pages = RunPages::write(&config, &out, &films(&result)?)?;
        Ok((result, pages))
    })
}

/// Draws the first success and the first failure of the test, if the simulator has the task. A test of few goals says
/// little, and drawing would take longer than the test.
fn films(result: &EvaluationResult) -> Result<Vec<FilmStrip>, Failed> {
    match result.task.as_built_in() {
        Some(layout) if result.episodes.len() >= MIN_TEST_EPISODES_OF_FILMS => {
            let films = film::OUTCOMES.into_iter().filter_map(|outcome| {
                film::of_outcome(layout, TEST_SEED, &result.episodes, outcome).transpose()
            });
            films.collect()
        }
        _ => Ok(Vec::new()),
    }
}

fn summary_lines(
    plan: &Plan,
    last: &pb::Progress,
    memory: PeakMemory,
    result: &EvaluationResult,
    pages: &RunPages,
) -> Vec<String> {
    let mut lines = vec![format!("done: {}", last.end_reason)];
    lines.push(format!(
        "best policy on {} test goals (seed {TEST_SEED}), without noise and advice",
        plan.config.evaluation.test_episodes
    ));
    lines.extend(result.lines().iter().map(|line| format!("  {line}")));
    lines.push(format!(
        "training      {} env steps, {} update{}, {} round{} in {}",
        grouped(last.env_steps),
        grouped(last.updates),
        if last.updates == 1 { "" } else { "s" },
        grouped(last.round),
        if last.round == 1 { "" } else { "s" },
        clock_text(last.wall_s)
    ));
    lines.extend(advice_text(last).map(|advice| format!("advice        {advice}")));
    if !last.environment.is_empty() {
        lines.push(format!("environment   {}", last.environment));
    }
    let teacher = match memory.teacher_mib {
        0 => String::new(),
        mib => format!("teacher {mib} MiB, "),
    };
    lines.extend([
        format!(
            "memory        learner {} MiB, {teacher}workers at most {} MiB",
            memory.learner_mib, memory.worker_mib
        ),
        format!("policy        {}", plan.best_policy().display()),
        format!("curve         {}", pages.curve.display()),
        format!("report        {}", pages.report.display()),
        format!("recordings    {}", plan.out.join("mcap").display()),
        format!("log           {}", plan.log_path().display()),
        format!("state digest  {}", last.digest),
        "next".to_owned(),
    ]);
    lines.extend(next_commands(plan).iter().map(|command| command_line(command)));
    lines
}

/// Returns commands that use the result: evaluate it, look at it, use it elsewhere, train longer.
fn next_commands(plan: &Plan) -> Vec<String> {
    let (out, policy) = (shell_word(&plan.out), shell_word(&plan.best_policy()));
    let mut commands = Vec::new();
    let is_simulated = !names_server(&plan.environment);
    if is_simulated {
        let baselines = if plan.config.arms == 2 { " --baselines" } else { "" };
        commands.push(format!("tandem eval --policy {policy}{baselines}"));
    }
    if plan.config.arms == 1 && is_simulated {
        let task = plan.config.task.parse().map_or_else(|_unknown| String::new(), task_flags);
        commands.push(format!("tandem train {task} --teacher {policy}"));
    }
    commands.extend(newest_log(&plan.out).map(|log| format!("tandem replay {}", shell_word(&log))));
    commands.push(format!("tandem policy export {policy} --onnx actor.onnx"));
    if plan.config.stop.max_env_steps > 0 {
        let longer = 2 * plan.config.stop.max_env_steps;
        let minutes = if plan.config.stop.max_minutes > 0.0 { " --max-minutes 0" } else { "" };
        let success = if plan.config.stop.until_success > 0.0 { " --until-success 0" } else { "" };
        let limits = format!("--max-env-steps {longer}{minutes}{success}");
        commands.push(format!("tandem train --resume --out {out} {limits}"));
    }
    commands
}

/// Indents a command, and continues it on a second line if it is too long for a terminal.
fn command_line(command: &str) -> String {
    let line = format!("  {command}");
    match line.rsplit_once(" --") {
        Some((start, option)) if line.chars().count() > N_COLUMNS => {
            format!("{start} \\\n      --{option}")
        }
        _ => line,
    }
}

/// Returns the first episode of the newest recorded evaluation.
fn newest_log(out: &Path) -> Option<PathBuf> {
    let entries = std::fs::read_dir(out.join("mcap")).ok()?;
    let logs = entries.filter_map(|entry| Some(entry.ok()?.path()));
    logs.filter(|path| path.to_string_lossy().ends_with("-000.mcap")).max()
}

/// Prints the command that resumes an interrupted run.
pub(super) fn print_interrupted(plan: &Plan) {
    let out = shell_word(&plan.out);
    match run_directory::saved_round(&plan.out) {
        Some(round) => {
            output::message(format_args!(
                "interrupted; the state after round {round} is saved. Resume with:"
            ));
        }
        None => output::message("interrupted before the first checkpoint. Start over with:"),
    }
    output::message(format_args!("  tandem train --resume --out {out}"));
    // The state is saved; pages that cannot be written are left out.
    if let Ok(Some(pages)) = RunPages::write_if_evaluated(&plan.config, &plan.out) {
        output::message(format_args!("report so far: {}", pages.report.display()));
    }
}

fn summary_json(
    plan: &Plan,
    last: &pb::Progress,
    memory: PeakMemory,
    result: &EvaluationResult,
) -> Value {
    let mut summary = result.json();
    let more = json!({
        "env_steps": last.env_steps,
        "updates": last.updates,
        "wall_s": last.wall_s,
        "advice_spent": last.advice_spent,
        "advice_queries": last.advice_queries,
        "budget_left": last.budget_left,
        "learner_mib": memory.learner_mib,
        "teacher_mib": memory.teacher_mib,
        "worker_mib": memory.worker_mib,
        "run_dir": plan.out.to_string_lossy(),
        "policy": plan.best_policy().to_string_lossy(),
        "digest": last.digest,
        "max_env_steps": plan.config.stop.max_env_steps,
    });
    if !last.environment.is_empty() {
        summary["environment"] = last.environment.as_str().into();
    }
    if let (Some(summary), Value::Object(more)) = (summary.as_object_mut(), more) {
        summary.extend(more);
    }
    summary
}
