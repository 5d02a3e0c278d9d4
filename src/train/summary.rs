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
use crate::evaluation::{EvaluatedPolicy, EvaluationResult, measure};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::progress_text::{clock_text, grouped};
use crate::{output, policy_file};

/// Evaluates the best policy on the test goals if the simulator has the task, draws the curve and prints the summary.
pub(super) fn print(
    plan: &Plan,
    last: &pb::Progress,
    memory: PeakMemory,
    as_json: bool,
) -> Result<(), Failed> {
    let result = test(plan)?;
    let rows =
        MetricsLog::read_all(&plan.out.join("metrics.jsonl")).or_exit(Exit::Data, String::new)?;
    let pictures = Pictures {
        curve: draw_curve(plan, &rows)?,
        report: tandem_report::run_report_html(&plan.out).or_cannot_write(String::new)?,
    };
    let summary = match as_json {
        true => summary_json(plan, last, memory, result.as_ref()).to_string(),
        false => summary_lines(plan, last, memory, result.as_ref(), &pictures).join("\n"),
    };
    let saved = || format!("the run is complete and saved in {}", plan.out.display());
    output::print(summary).map_err(|failed| failed.context(saved()))
}

/// Plays the test goals with the best policy. Returns `None` if the simulator does not have the task.
fn test(plan: &Plan) -> Result<Option<EvaluationResult>, Failed> {
    let path = plan.best_policy();
    let policy = policy_file::load(&path)?;
    if policy.layout.as_built_in().is_none() {
        return Ok(None);
    }
    let subject = EvaluatedPolicy::new(policy, &path)?;
    measure(&subject, plan.config.evaluation.test_episodes, TEST_SEED).map(Some)
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
    result: Option<&EvaluationResult>,
    pictures: &Pictures,
) -> Vec<String> {
    let mut lines = vec![format!("done: {}", last.end_reason)];
    if let Some(result) = result {
        lines.push(format!(
            "best policy on {} test goals (seed {TEST_SEED}), alone: no noise, no advice",
            plan.config.evaluation.test_episodes
        ));
        lines.extend(result.lines().iter().map(|line| format!("  {line}")));
    } else if let Some(best) = &last.best {
        lines.push(format!(
            "best policy   success {:.3} over {} goals of the run; no test goals without a simulator",
            best.success, best.n_episodes
        ));
    }
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
    let options = CurveOptions::shares("Success of the policy alone", Axis::EnvSteps);
    let svg = tandem_report::curve_svg(&[series], &options).or_exit(Exit::Bug, String::new)?;
    let path = plan.out.join("curve.svg");
    std::fs::write(&path, svg).or_cannot_write(|| format!("cannot write {}", path.display()))?;
    Ok(path)
}

fn summary_json(
    plan: &Plan,
    last: &pb::Progress,
    memory: PeakMemory,
    result: Option<&EvaluationResult>,
) -> Value {
    let task = json!({ "task": plan.config.task, "arms": plan.config.arms });
    let mut summary = result.map_or(task, EvaluationResult::json);
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
