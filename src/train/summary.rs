//! What stands at the end of a run.

use std::path::PathBuf;

use serde_json::{Value, json};
use tandem_proto::pb;
use tandem_report::{Axis, CurveOptions, Quantity, Series};
use tandem_telemetry::{MetricsLog, MetricsRow};

use super::children::Memory;
use super::display::{clock_text, grouped};
use super::plan::Plan;
use crate::eval::{Measured, Subject, measure};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::files::load_policy;
use crate::output;

/// Test goals for the final evaluation of the best policy; no run selects its policy by them.
const REPORT_SEED: u64 = 777;

/// Evaluates the best policy on test goals, draws the curve, and prints where everything lies.
pub(super) fn print(
    plan: &Plan,
    last: &pb::Progress,
    memory: Memory,
    as_json: bool,
) -> Result<(), Failed> {
    let n_test_episodes = plan.config.evaluation.test_episodes;
    let path = plan.best_policy();
    let measured = measure(&Subject::Policy(load_policy(&path)?), n_test_episodes, REPORT_SEED)?;
    let rows =
        MetricsLog::read_all(&plan.out.join("metrics.jsonl")).or_exit(Exit::Data, String::new)?;
    let drawn = Drawn {
        curve: draw_curve(plan, &rows)?,
        report: tandem_report::run_report_html(&plan.out).or_cannot_write(String::new)?,
    };
    let summary = match as_json {
        true => summary_json(plan, last, memory, &measured).to_string(),
        false => summary_lines(plan, last, memory, &measured, &drawn).join("\n"),
    };
    let saved = || format!("the run is complete and saved in {}", plan.out.display());
    output::print(summary).map_err(|failed| failed.context(saved()))
}

/// The pictures of a run that has ended.
struct Drawn {
    curve: PathBuf,
    report: PathBuf,
}

fn summary_lines(
    plan: &Plan,
    last: &pb::Progress,
    memory: Memory,
    measured: &Measured,
    drawn: &Drawn,
) -> Vec<String> {
    let mut lines = vec![
        format!("done: {}", last.end_reason),
        format!(
            "best policy on {} test goals (seed {REPORT_SEED}), alone: no noise, no advice",
            plan.config.evaluation.test_episodes
        ),
    ];
    lines.extend(measured.lines().iter().map(|line| format!("  {line}")));
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
        format!(
            "memory        learner {} MiB, teacher {} MiB, workers at most {} MiB",
            memory.learner_mib, memory.teacher_mib, memory.worker_mib
        ),
        format!("policy        {}", plan.best_policy().display()),
        format!("curve         {}", drawn.curve.display()),
        format!("report        {}", drawn.report.display()),
        format!("logs          {}, {}", plan.out.join("mcap").display(), plan.log_path().display()),
        format!("digest        {}", last.digest),
    ]);
    lines
}

/// Says how to go on with an interrupted run.
pub(super) fn interrupted(plan: &Plan) {
    let out = plan.out.display();
    let saved = tandem_learner::checkpoint::list(&plan.checkpoints());
    let round = saved.last().and_then(|path| path.file_stem()?.to_str()?.parse::<u64>().ok());
    match round {
        Some(round) => {
            output::message(format_args!(
                "interrupted; the state after round {round} is saved. Go on with:"
            ));
        }
        None => output::message("interrupted before anything was saved. Start over with:"),
    }
    output::message(format_args!("  tandem train --resume --out {out}"));
}

/// Draws success against environment steps into the run directory.
fn draw_curve(plan: &Plan, rows: &[MetricsRow]) -> Result<PathBuf, Failed> {
    let config = &plan.config;
    let name = format!("{}, {} arm(s), {}", config.task, config.arms, config.advice.strategy);
    let series = Series::of(&name, rows, Axis::EnvSteps, Quantity::Success);
    let options = CurveOptions::shares("Success of the policy alone", Axis::EnvSteps);
    let svg = tandem_report::curve_svg(&[series], &options).or_exit(Exit::Bug, String::new)?;
    let path = plan.out.join("curve.svg");
    std::fs::write(&path, svg).or_cannot_write(|| format!("cannot write {}", path.display()))?;
    Ok(path)
}

fn summary_json(plan: &Plan, last: &pb::Progress, memory: Memory, measured: &Measured) -> Value {
    let mut summary = measured.json();
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
    if let (Some(summary), Value::Object(more)) = (summary.as_object_mut(), more) {
        summary.extend(more);
    }
    summary
}
