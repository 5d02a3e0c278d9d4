//! The end of a run: its summary, curve and report.

use std::path::PathBuf;

use serde_json::{Value, json};
use tandem_core::evaluation::TEST_SEED;
use tandem_core::text::counted;
use tandem_proto::pb;
use tandem_report::{Axis, CurveOptions, Quantity, Series};
use tandem_telemetry::{MetricsLog, MetricsRow};

use super::plan::Plan;
use super::processes::PeakMemory;
use crate::cli::TrainArgs;
use crate::environment_server::names_server;
use crate::evaluation::{EvaluatedPolicy, EvaluationResult, Part, measure, measure_served};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::progress_text::{clock_text, grouped};
use crate::{output, policy_file};

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
    let rows =
        MetricsLog::read_all(&plan.out.join("metrics.jsonl")).or_exit(Exit::Data, String::new)?;
    let pictures = Pictures {
        curve: draw_curve(plan, &rows)?,
        report: tandem_report::run_report_html(&plan.out).or_cannot_write(String::new)?,
    };
    let summary = match args.json {
        true => summary_json(plan, last, memory, &result).to_string(),
        false => summary_lines(plan, last, memory, &result, &pictures).join("\n"),
    };
    output::print(summary).map_err(|failed| failed.context(saved()))
}

/// Plays the test goals with the best policy, on the server of the environments if the run has one.
fn test(plan: &Plan, args: &TrainArgs) -> Result<EvaluationResult, Failed> {
    let (path, n_episodes) = (plan.best_policy(), plan.config.evaluation.test_episodes);
    let (policy, goals) = (policy_file::load(&path)?, (n_episodes, TEST_SEED));
    if names_server(&plan.environment) {
        let subject = (Part::AllArms, &policy);
        return measure_served(&plan.environment, subject, goals, args.exit_with_stdin);
    }
    measure(&EvaluatedPolicy::new(policy, &path)?, n_episodes, TEST_SEED)
}

/// Files written at the end of a run.
struct Pictures {
    curve: PathBuf,
    report: PathBuf,
}

fn summary_lines(
    plan: &Plan,
    last: &pb::Progress,
    memory: PeakMemory,
    result: &EvaluationResult,
    pictures: &Pictures,
) -> Vec<String> {
    let mut lines = vec![format!("done: {}", last.end_reason)];
    lines.push(format!(
        "best policy on {} test goals (seed {TEST_SEED}), alone: no noise, no advice",
        plan.config.evaluation.test_episodes
    ));
    lines.extend(result.lines().iter().map(|line| format!("  {line}")));
    lines.extend([
        format!(
            "training      {} env steps, {} updates, {} rounds in {}",
            grouped(last.env_steps),
            grouped(last.updates),
            last.round,
            clock_text(last.wall_s)
        ),
        format!(
            "advice        {} spent, {} left",
            grouped(last.advice_spent),
            grouped(last.budget_left)
        ),
    ]);
    if !last.environment.is_empty() {
        lines.push(format!("environment   {}", last.environment));
    }
    lines.extend([
        format!(
            "memory        learner {} MiB, teacher {} MiB, workers at most {} MiB",
            memory.learner_mib, memory.teacher_mib, memory.worker_mib
        ),
        format!("policy        {}", plan.best_policy().display()),
        format!("curve         {}", pictures.curve.display()),
        format!("report        {}", pictures.report.display()),
        format!("logs          {}, {}", plan.out.join("mcap").display(), plan.log_path().display()),
        format!("digest        {}", last.digest),
    ]);
    lines
}

/// Prints the command that resumes an interrupted run.
pub(super) fn print_interrupted(plan: &Plan) {
    let out = plan.out.display();
    let saved = tandem_learner::checkpoint::list(&plan.checkpoints());
    let round = saved.last().and_then(|path| path.file_stem()?.to_str()?.parse::<u64>().ok());
    match round {
        Some(round) => {
            output::message(format_args!(
                "interrupted; the state after round {round} is saved. Resume with:"
            ));
        }
        None => output::message("interrupted before the first checkpoint. Start over with:"),
    }
    output::message(format_args!("  tandem train --resume --out {out}"));
}

/// Draws the success rate over environment steps.
fn draw_curve(plan: &Plan, rows: &[MetricsRow]) -> Result<PathBuf, Failed> {
    let config = &plan.config;
    let arms = counted(config.arms, "arm");
    let name = format!("{}, {arms}, {}", config.task, config.advice.strategy);
    let series = Series::of(&name, rows, Axis::EnvSteps, Quantity::Success);
    let title = format!("Success of the policy alone: {name}");
    let options = CurveOptions::of(&title, Quantity::Success, Axis::EnvSteps);
    let svg = tandem_report::curve_svg(&[series], &options).or_exit(Exit::Bug, String::new)?;
    let path = plan.out.join("curve.svg");
    std::fs::write(&path, svg).or_cannot_write(|| format!("cannot write {}", path.display()))?;
    Ok(path)
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
        "budget_left": last.budget_left,
        "learner_mib": memory.learner_mib,
        "teacher_mib": memory.teacher_mib,
        "worker_mib": memory.worker_mib,
        "run_dir": plan.out.to_string_lossy(),
        "policy": plan.best_policy().to_string_lossy(),
        "digest": last.digest,
    });
    if !last.environment.is_empty() {
        summary["environment"] = last.environment.as_str().into();
    }
    if let (Some(summary), Value::Object(more)) = (summary.as_object_mut(), more) {
        summary.extend(more);
    }
    summary
}
