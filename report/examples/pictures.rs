//! Draws synthetic learning curves into the directory given on the command line.

use std::path::PathBuf;

use tandem_report::{Axis, CurveOptions, Quantity, Series, curve_svg, run_report_html};
use tandem_telemetry::{MetricsLog, MetricsRow};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let dir = std::env::args_os().nth(1).map(PathBuf::from).ok_or("usage: pictures DIR")?;
    let runs = [("none", 0.0), ("mc-q:0.1, half of the episodes", 1.0), ("ea", 0.6)];
    let series: Vec<Series> = runs
        .iter()
        .map(|(name, speed)| Series::of(name, &rows(*speed), Axis::EnvSteps, Quantity::Success))
        .collect();
    std::fs::write(
        dir.join("success.svg"),
        curve_svg(&series, &CurveOptions::of("Two arms push", Quantity::Success, Axis::EnvSteps))?,
    )?;
    let metrics_path = dir.join("metrics.jsonl");
    let (mut metrics, _) = MetricsLog::restore(&metrics_path, &[])?;
    rows(1.0).iter().try_for_each(|row| metrics.append(row))?;
    std::fs::write(dir.join("run.toml"), "task = \"push\"\narms = 2\n")?;
    run_report_html(&dir, &[])?;
    Ok(())
}

/// Returns a synthetic learning curve; a larger `speed` makes it rise faster.
fn rows(speed: f64) -> Vec<MetricsRow> {
    let row = |evaluation: u32| {
        let progress = f64::from(evaluation) / 24.0;
        let ripple = 0.03 * (f64::from(evaluation) * 2.1).sin();
        let success = (0.95 / (1.0 + (-(progress * speed - 0.45) * 12.0).exp()) + ripple * speed)
            .clamp(0.0, 1.0);
        let spread = 1.96 * (success * (1.0 - success) / 240.0).sqrt() + 0.008;
        MetricsRow {
            round: u64::from(evaluation) * 5,
            env_steps: u64::from(evaluation) * 8000,
            episodes: u64::from(evaluation) * 160,
            updates: u64::from(evaluation) * 2000,
            paper_epochs: progress * 2.4,
            wall_s: progress * 1500.0,
            success,
            success_joint: 0.93 * success,
            success_per_arm: vec![success, success],
            success_low: (success - spread).max(0.0),
            success_high: (success + spread).min(1.0),
            collision_rate: 0.25 * progress,
            mean_q: -10.0 + 8.0 * success,
            advice_spent: u64::from(evaluation) * 700,
            budget_left: 500_000 - u64::from(evaluation) * 700,
            moved: (success + 0.3).min(1.0),
            collision_rate_before_success: 0.1 * progress,
            training_success: 0.9 * success,
            n_episodes: 240,
            ..MetricsRow::default()
        }
    };
    (0..25).map(row).collect()
}
