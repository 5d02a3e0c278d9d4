//! The end of a run: its summary, curve and report.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use tandem_core::Episode;
use tandem_core::evaluation::TEST_SEED;
use tandem_proto::pb;
use tandem_report::table::thousands;
use tandem_report::{FilmStrip, run_summary};
use tandem_system::atomic_file;
use tandem_telemetry::LogName;

use super::plan::Plan;
use super::processes::PeakMemory;
use super::resume_command::resume_command;
use crate::cli::{TrainArgs, task_flags};
use crate::columns::N_COLUMNS;
use crate::environment_server::names_server;
use crate::evaluation::{EvaluatedPolicy, EvaluationResult, Part, measure, measure_served};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::progress_text::{advice_text, clock_text, failures_text};
use crate::run_pages::RunPages;
use crate::shell::shell_word;
use crate::{environment_server, film, output, policy_file, run_directory, signals};

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
    let (result, shown) = test(plan, args).map_err(|failed| {
        if failed.exit() == Exit::Interrupted {
            print_interrupted_test(plan, args);
        }
        failed.context(saved())
    })?;
    let json = summary_json(plan, last, memory, &result).to_string();
    save(&plan.out, &json).map_err(|failed| failed.context(saved()))?;
    let (result, pages) =
        pages(plan, (result, shown), args).map_err(|failed| failed.context(saved()))?;
    let summary = match args.json {
        true => json,
        false => summary_lines((plan, args), last, memory, &result, &pages).join("\n"),
    };
    output::print(summary).map_err(|failed| failed.context(saved()))
}

/// Writes the summary, from which reports take the success on test goals.
fn save(out: &Path, summary: &str) -> Result<(), Failed> {
    let path = out.join(run_summary::FILE);
    atomic_file::replace(&path, format!("{summary}\n").as_bytes())
        .or_cannot_write(|| format!("cannot write {}", path.display()))
}

/// Removes the summary of a run that continues.
pub(super) fn remove(out: &Path) -> Result<(), Failed> {
    let path = out.join(run_summary::FILE);
    match std::fs::remove_file(&path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(error).or_cannot_write(|| format!("cannot remove {}", path.display()))
        }
        _ => Ok(()),
    }
}

/// Plays the test goals with the best policy, on the server of the environments if the run has one. Returns the first
/// episode of each outcome too.
fn test(plan: &Plan, args: &TrainArgs) -> Result<(EvaluationResult, Vec<Episode>), Failed> {
    let (path, n_episodes) = (plan.best_policy(), plan.config.evaluation.test_episodes);
    let (policy, goals) = (policy_file::load(&path)?, (n_episodes, TEST_SEED));
    if names_server(&plan.environment) {
        let (subject, mut firsts) = ((Part::AllArms, &policy), Vec::new());
        let mut take = |episodes: Vec<Episode>| film::keep_firsts(&mut firsts, &episodes);
        let result =
            measure_served(&plan.environment, subject, goals, &mut take, args.exit_with_stdin)?;
        return Ok((result, firsts));
    }
    let subject = EvaluatedPolicy::new(policy, &path)?;
    signals::unless_interrupted(args.exit_with_stdin, move || {
        let mut firsts = Vec::new();
        let mut take = |episodes: Vec<Episode>| film::keep_firsts(&mut firsts, &episodes);
        let result = measure(&subject, goals, &mut take)?;
        Ok((result, firsts))
    })
}

/// Writes the pages of the run, which show episodes of the test.
fn pages(
    plan: &Plan,
    (result, shown): (EvaluationResult, Vec<Episode>),
    args: &TrainArgs,
) -> Result<(EvaluationResult, RunPages), Failed> {
    let (config, out) = (plan.config.clone(), plan.out.clone());
    signals::unless_interrupted(args.exit_with_stdin, move || {
        let pages = RunPages::write(&config, &out, &films(&result, &shown)?)?;
        Ok((result, pages))
    })
}

/// Draws the first success and the first failure of the test, which are among `shown`, if the simulator has the task. A
/// test of few goals says little, and drawing would take longer than the test.
fn films(result: &EvaluationResult, shown: &[Episode]) -> Result<Vec<FilmStrip>, Failed> {
    match result.task.as_built_in() {
        Some(layout) if result.summary.n_episodes >= MIN_TEST_EPISODES_OF_FILMS => {
            let films = film::OUTCOMES.into_iter().filter_map(|outcome| {
                film::of_outcome(layout, TEST_SEED, shown, outcome).transpose()
            });
            films.collect()
        }
        _ => Ok(Vec::new()),
    }
}

fn summary_lines(
    (plan, args): (&Plan, &TrainArgs),
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
        thousands(last.env_steps),
        thousands(last.updates),
        if last.updates == 1 { "" } else { "s" },
        thousands(last.round),
        if last.round == 1 { "" } else { "s" },
        clock_text(last.wall_s)
    ));
    lines.extend(advice_text(last).map(|advice| format!("advice        {advice}")));
    if !last.environment.is_empty() {
        lines.push(format!("environment   {}", last.environment));
    }
    lines.extend(failures_text(last).map(|failures| format!("environment   {failures}")));
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
    ]);
    let recordings = Some(plan.logs()).filter(|logs| logs.is_dir());
    lines.extend(recordings.map(|logs| format!("recordings    {}", logs.display())));
    lines.extend([
        format!("log           {}", plan.log_path().display()),
        format!("state digest  {}", last.digest),
        "next".to_owned(),
    ]);
    lines.extend(next_commands((plan, args), last.env_steps).iter().map(command_line));
    lines
}

/// Returns commands that use the result: evaluate it, look at it, use it elsewhere, train longer. A command consists of
/// its beginning and its last option, which may be on another line. The run has `env_steps` environment steps.
fn next_commands(
    (plan, args): (&Plan, &TrainArgs),
    env_steps: u64,
) -> Vec<(String, Option<String>)> {
    let policy = shell_word(&plan.best_policy());
    let is_simulated = !names_server(&plan.environment);
    let evaluate = format!("tandem eval --policy {policy}");
    let mut commands = vec![match is_simulated {
        true => (evaluate, (plan.config.arms == 2).then(|| "--baselines".to_owned())),
        false => (evaluate, Some(environment_server::shell_words(&plan.environment))),
    }];
    if plan.config.arms == 1 && is_simulated {
        let task = plan.config.task.parse().map_or_else(|_unknown| String::new(), task_flags);
        commands.push((format!("tandem train {task}"), Some(format!("--teacher {policy}"))));
    }
    let log = newest_log(&plan.out);
    commands.extend(log.map(|log| (format!("tandem replay {}", shell_word(&log)), None)));
    commands.push((format!("tandem policy export {policy}"), Some("--onnx actor.onnx".to_owned())));
    let stop = &plan.config.stop;
    if stop.max_env_steps > 0 {
        let longer = longer(stop.max_env_steps, env_steps);
        let minutes = if stop.max_minutes > 0.0 { " --max-minutes 0" } else { "" };
        let success = if stop.until_success > 0.0 { " --until-success 0" } else { "" };
        commands.push((
            resume_command(&plan.out, args),
            Some(format!("--max-env-steps {longer}{minutes}{success}")),
        ));
    }
    commands
}

/// Returns a limit of environment steps that makes a run longer. A run whose limit was lowered has more steps than that.
fn longer(max_env_steps: u64, env_steps: u64) -> u64 {
    max_env_steps.max(env_steps).saturating_mul(2)
}

/// Indents a command, and puts its last option on a second line if it is too long for a terminal.
fn command_line((start, option): &(String, Option<String>)) -> String {
    let Some(option) = option else { return format!("  {start}") };
    match format!("  {start} {option}") {
        line if line.chars().count() > N_COLUMNS => format!("  {start} \\\n      {option}"),
        line => line,
    }
}

/// Returns the first episode of the newest recorded evaluation.
fn newest_log(out: &Path) -> Option<PathBuf> {
    let entries = std::fs::read_dir(out.join("mcap")).ok()?;
    let paths = entries.filter_map(|entry| Some(entry.ok()?.path()));
    let logs = paths.filter_map(|path| Some((LogName::of(&path)?, path)));
    let firsts = logs.filter(|(name, _)| name.is_evaluation && name.number == 0);
    firsts.max().map(|(_, path)| path)
}

/// Prints the command that resumes an interrupted run.
pub(super) fn print_interrupted(plan: &Plan, args: &TrainArgs) {
    match run_directory::saved_round(&plan.out) {
        Some(round) => {
            output::message(format_args!(
                "interrupted; the state after round {round} is saved. Resume with:"
            ));
        }
        None => output::message("interrupted before the first checkpoint. Start over with:"),
    }
    print_resume(plan, args);
}

/// Prints the command that repeats the test of a run, which was interrupted.
fn print_interrupted_test(plan: &Plan, args: &TrainArgs) {
    output::message(format_args!(
        "the run is complete and saved in {}; its test was interrupted. Repeat it with:",
        plan.out.display()
    ));
    print_resume(plan, args);
}

/// Prints the command that resumes the run, and writes the pages so far.
fn print_resume(plan: &Plan, args: &TrainArgs) {
    output::message(format_args!("  {}", resume_command(&plan.out, args)));
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
        "log": plan.log_path().to_string_lossy(),
    });
    if !last.environment.is_empty() {
        summary["environment"] = last.environment.as_str().into();
    }
    if names_server(&plan.environment) {
        summary["environment_failures"] = last.environment_failures.into();
    }
    if let (Some(summary), Value::Object(more)) = (summary.as_object_mut(), more) {
        summary.extend(more);
    }
    summary
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::EnvironmentArgs;

    #[test]
    fn the_newest_log_is_that_of_the_latest_round_with_any_number_of_digits() {
        let out = tempfile::tempdir().expect("a directory");
        assert_eq!(newest_log(out.path()), None);
        let logs = out.path().join("mcap");
        std::fs::create_dir(&logs).expect("a directory");
        for name in [
            "eval-999999-000.mcap",
            "eval-1000000-000.mcap",
            "eval-1000000-001.mcap",
            "eval-2000000-000.mcap.part",
            "train-3000000-000.mcap",
        ] {
            std::fs::write(logs.join(name), "").expect("writes");
        }
        assert_eq!(newest_log(out.path()), Some(logs.join("eval-1000000-000.mcap")));
    }

    #[test]
    fn a_longer_run_is_longer_than_one_whose_limit_was_lowered() {
        assert_eq!(longer(100_000, 100_000), 200_000);
        assert_eq!(longer(1_000, 100_000), 200_000);
    }

    #[test]
    fn a_command_for_served_environments_names_the_server_and_is_not_broken_within_a_word() {
        let command = "python -m tandem.serve FetchPush-v4 --seed 1 --reward sparse".to_owned();
        let environment =
            EnvironmentArgs { env_command: Some(command), ..EnvironmentArgs::default() };
        let option = environment_server::shell_words(&environment);
        let line = command_line(&("tandem eval --policy p".to_owned(), Some(option)));
        assert_eq!(
            line,
            "  tandem eval --policy p \\\n      --env-command 'python -m tandem.serve FetchPush-v4 \
             --seed 1 --reward sparse'"
        );
        let environment = EnvironmentArgs {
            env: Some("127.0.0.1:7005".to_owned()),
            env_token_file: Some("a token".into()),
            ..EnvironmentArgs::default()
        };
        let option = environment_server::shell_words(&environment);
        assert_eq!(option, "--env 127.0.0.1:7005 --env-token-file 'a token'");
        let short = command_line(&("tandem eval".to_owned(), Some(option)));
        assert_eq!(short, "  tandem eval --env 127.0.0.1:7005 --env-token-file 'a token'");
    }
}
