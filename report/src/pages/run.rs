//! The report of a single run.

use tandem_telemetry::MetricsRow;

use crate::curve::{Axis, CurveOptions, Quantity, Series, curve_svg};
use crate::error::Error;
use crate::html::{escaped, svg_grid, table};
use crate::run::Run;
use crate::table::{duration, interval, number, optional, share, thousands};

/// Returns key values, curves, evaluations and configuration of `run` as HTML.
pub(super) fn body(run: &Run) -> Result<String, Error> {
    let mut body = match (run.best(), run.last()) {
        (Some(best), Some(last)) => {
            format!(
                "{}{}",
                tiles(best, last),
                svg_grid(&curves(run)?.each_ref().map(String::as_str))
            )
        }
        _ => "<p>No evaluation yet.</p>".to_owned(),
    };
    if !run.rows.is_empty() {
        let rows: Vec<Vec<String>> = run.rows.iter().map(evaluation_cells).collect();
        body.push_str(&format!("<h2>Evaluations</h2>{}", table(&EVALUATION_HEADER, &rows)));
    }
    if let Some(text) = &run.configuration {
        body.push_str(&format!("<h2>Configuration</h2><pre>{}</pre>", escaped(text)));
    }
    Ok(body)
}

/// Returns the key values of a run, one tile each.
fn tiles(best: &MetricsRow, last: &MetricsRow) -> String {
    let per_arm: Vec<String> = best.success_per_arm.iter().map(|success| share(*success)).collect();
    let without_contact = best.contacts.success().map(|[success, low, high]| {
        let arm_contact = optional(best.contacts.arm_contact_rate, share);
        let table_contact = optional(best.contacts.table_contact_rate, share);
        (
            "success without arm contact",
            share(success),
            format!(
                "95 % interval {low:.3}–{high:.3}; contact between arms: {arm_contact}, with table: {table_contact}"
            ),
        )
    });
    let tiles = [
        (
            "best success",
            share(best.success),
            format!("95 % interval {}, {} episodes", interval(best), best.n_episodes),
        ),
        ("joint norm", share(best.success_joint), format!("each arm: {}", per_arm.join(" / "))),
        (
            "with contact",
            share(best.collision_rate),
            format!("before success: {}", share(best.collision_rate_before_success)),
        ),
        (
            "reached after",
            thousands(best.env_steps),
            format!("env steps, {}", duration(best.wall_s)),
        ),
        (
            "advice spent",
            thousands(last.advice_spent),
            format!("{} left", thousands(last.budget_left)),
        ),
        (
            "whole run",
            duration(last.wall_s),
            format!("{} env steps, {} updates", thousands(last.env_steps), thousands(last.updates)),
        ),
    ];
    let tile = |(label, value, note): &(&str, String, String)| {
        format!(
            "<div class=tile><span>{label}</span><strong>{}</strong><small>{}</small></div>",
            escaped(value),
            escaped(note)
        )
    };
    format!(
        "<div class=tiles>{}</div>",
        without_contact.iter().chain(&tiles).map(tile).collect::<String>()
    )
}

/// Draws success, mean Q, contacts and advice against environment steps.
fn curves(run: &Run) -> Result<[String; 4], Error> {
    const AXIS: Axis = Axis::EnvSteps;
    let series = |named: &[(&str, Quantity)]| -> Vec<Series> {
        named.iter().map(|(name, quantity)| Series::of(name, &run.rows, AXIS, *quantity)).collect()
    };
    let success = series(&[
        ("success", Quantity::Success),
        ("joint norm", Quantity::SuccessJoint),
        ("training episodes", Quantity::TrainingSuccess),
        ("object moved", Quantity::Moved),
    ]);
    let contacts = series(&[
        ("any", Quantity::CollisionRate),
        ("before success", Quantity::CollisionRateBeforeSuccess),
    ]);
    Ok([
        curve_svg(&success, &CurveOptions::shares("Success", AXIS))?,
        curve_svg(&series(&[("", Quantity::MeanQ)]), &CurveOptions::values("Mean Q", AXIS))?,
        curve_svg(&contacts, &CurveOptions::shares("Episodes with contact", AXIS))?,
        curve_svg(
            &series(&[("", Quantity::AdviceSpent)]),
            &CurveOptions::values("Advice spent", AXIS),
        )?,
    ])
}

const EVALUATION_HEADER: [&str; 13] = [
    "round",
    "env steps",
    "updates",
    "paper epochs",
    "time",
    "success",
    "95 % interval",
    "without arm contact",
    "joint",
    "contact",
    "moved",
    "mean Q",
    "advice spent",
];

fn evaluation_cells(row: &MetricsRow) -> Vec<String> {
    vec![
        row.round.to_string(),
        thousands(row.env_steps),
        thousands(row.updates),
        format!("{:.2}", row.paper_epochs),
        duration(row.wall_s),
        share(row.success),
        interval(row),
        optional(row.contacts.success_without_contact, share),
        share(row.success_joint),
        share(row.collision_rate),
        share(row.moved),
        number(row.mean_q),
        thousands(row.advice_spent),
    ]
}
