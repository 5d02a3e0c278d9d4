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

/// Held-out goals on which the best policy is judged at the end; no run chooses by them.
const REPORT_SEED: u64 = 777;
const REPORT_EPISODES: u64 = 240;

/// Judges the best policy on held-out goals, draws the curve, and prints where everything lies.
#[expect(clippy::print_stdout, reason = "the result of the command")]
pub(super) fn print(
    plan: &Plan,
    last: &pb::Progress,
    memory: Memory,
    as_json: bool,
) -> Result<(), Failed> {
    let path = plan.best_policy();
    let measured = measure(&Subject::Policy(load_policy(&path)?), REPORT_EPISODES, REPORT_SEED)?;
    let rows =
        MetricsLog::read_all(&plan.out.join("metrics.jsonl")).or_exit(Exit::Data, String::new)?;
    let curve = draw_curve(plan, &rows)?;
    let report = tandem_report::run_report_html(&plan.out).or_exit(Exit::TryAgain, String::new)?;
    if as_json {
        println!("{}", summary_json(plan, last, memory, &measured));
        return Ok(());
    }
    println!("done: {}", last.end_reason);
    println!(
        "best policy on {REPORT_EPISODES} held-out goals (seed {REPORT_SEED}), alone: no noise, no advice"
    );
    measured.lines().iter().for_each(|line| println!("  {line}"));
    println!(
        "training      {} env steps, {} updates, {} rounds in {}",
        grouped(last.env_steps),
        grouped(last.updates),
        last.round,
        clock_text(last.wall_s)
    );
    println!(
        "advice        {} spent, {} left",
        grouped(last.advice_spent),
        grouped(last.budget_left)
    );
    println!(
        "memory        learner {} MiB, teacher {} MiB, workers at most {} MiB",
        memory.learner_mib, memory.teacher_mib, memory.worker_mib
    );
    println!("policy        {}", path.display());
    println!("curve         {}", curve.display());
    println!("report        {}", report.display());
    println!("logs          {}, {}", plan.out.join("mcap").display(), plan.log_path().display());
    println!("digest        {}", last.digest);
    Ok(())
}

/// Says how to go on with an interrupted run.
#[expect(clippy::print_stderr, reason = "the line that resumes")]
pub(super) fn interrupted(plan: &Plan) {
    let out = plan.out.display();
    let saved = tandem_learner::checkpoint::list(&plan.checkpoints());
    let round = saved.last().and_then(|path| path.file_stem()?.to_str()?.parse::<u64>().ok());
    match round {
        Some(round) => {
            eprintln!("interrupted; the state after round {round} is saved. Go on with:");
        }
        None => eprintln!("interrupted before anything was saved. Start over with:"),
    }
    eprintln!("  tandem train --resume --out {out}");
}

/// Draws success against environment steps into the run directory.
fn draw_curve(plan: &Plan, rows: &[MetricsRow]) -> Result<PathBuf, Failed> {
    let config = &plan.config;
    let name = format!("{}, {} arm(s), {}", config.task, config.arms, config.advice.strategy);
    let series = Series::of(&name, rows, Axis::EnvSteps, Quantity::Success);
    let options = CurveOptions::shares("Success of the policy alone", Axis::EnvSteps);
    let svg = tandem_report::curve_svg(&[series], &options).or_exit(Exit::Bug, String::new)?;
    let path = plan.out.join("curve.svg");
    std::fs::write(&path, svg)
        .or_exit(Exit::TryAgain, || format!("cannot write {}", path.display()))?;
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
