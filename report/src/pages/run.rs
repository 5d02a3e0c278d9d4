//! The report of a single run.

use tandem_core::TaskSpec;
use tandem_core::task::Norm;
use tandem_telemetry::MetricsRow;

use crate::comparison::FilmStrip;
use crate::curve::{Axis, CurveOptions, Drawing, Series, curve_drawing};
use crate::error::Error;
use crate::html::{details, drawing_grid, escaped, film_strip, table};
use crate::quantity::Quantity;
use crate::run::Run;
use crate::table::{NONE, duration, interval, number, optional, percent_range, share, thousands};

/// The tile of a task that reports contacts.
const CONTACT_TILE: &str = "with contact";
/// The tile of a run that took advice.
const ADVICE_TILE: &str = "advice spent";
/// The column of a task with several arms.
const WITHOUT_CONTACT: &str = "without contact";
/// The tile of a task with several arms.
const WITHOUT_CONTACT_TILE: &str = "success without contact";

/// Returns key values, curves, evaluations and configuration of `run` as HTML.
pub(super) fn body(run: &Run, films: &[FilmStrip]) -> Result<String, Error> {
    let task = run.task_spec();
    let mut body = task.as_ref().map(task_line).unwrap_or_default();
    match (run.best(), run.last()) {
        (Some(best), Some(last)) => {
            let curves = curves(run, task.as_ref())?;
            body.push_str(&headline(run, best));
            body.push_str(&drawing_grid(&curves));
            let is_shown = |label: &str| match label {
                CONTACT_TILE => reports_contacts(task.as_ref()),
                ADVICE_TILE => run.took_advice(),
                WITHOUT_CONTACT_TILE => has_several_arms(task.as_ref()),
                _ => true,
            };
            body.push_str(&tiles(best, last, is_shown));
        }
        _ => body.push_str("<p>No evaluation yet.</p>"),
    }
    if !films.is_empty() {
        let strips = films.iter().enumerate().map(|(idx, film)| film_strip(idx, film));
        body.push_str(&format!("<h2>Episodes</h2>{}", strips.collect::<String>()));
    }
    if !run.rows.is_empty() {
        body.push_str(&details("Evaluations", &evaluations(&run.rows, task.as_ref())));
    }
    if let Some(configuration) = &run.configuration {
        let text = escaped(configuration.text());
        body.push_str(&details("Configuration", &format!("<pre>{text}</pre>")));
    }
    Ok(body)
}

/// Returns true if the task reports contacts or is unknown.
fn reports_contacts(task: Option<&TaskSpec>) -> bool {
    task.is_none_or(TaskSpec::reports_contacts)
}

/// Returns true if the task has several arms or is unknown.
fn has_several_arms(task: Option<&TaskSpec>) -> bool {
    task.is_none_or(|task| task.n_arms() > 1)
}

/// Returns the task, its number of arms, the length of its episodes and its tolerance.
fn task_line(task: &TaskSpec) -> String {
    let arms =
        if task.n_arms() == 1 { "1 arm".to_owned() } else { format!("{} arms", task.n_arms()) };
    let unit = if task.as_built_in().is_some() { " m" } else { "" };
    let norm = match task.norm() {
        Norm::Euclidean => "Euclidean norm",
        Norm::Maximum => "maximum norm",
    };
    format!(
        "<p>Task {}: {arms}, {} control steps per episode, goals within {}{unit} ({norm}) count as achieved.</p>",
        escaped(task.name()),
        thousands(task.episode_steps() as u64),
        task.tolerance()
    )
}

/// Returns the first number of the page: the success on test goals, or else in the best evaluation.
fn headline(run: &Run, best: &MetricsRow) -> String {
    let (success, interval, goals) = match &run.test {
        Some(test) => (
            test.success,
            percent_range(test.interval),
            format!("{} test goals", thousands(test.n_episodes)),
        ),
        None => (
            best.success,
            interval(best),
            format!("{} goals of its best evaluation", thousands(best.n_episodes)),
        ),
    };
    format!(
        "<p class=headline><strong>{}</strong> success of the policy alone on {goals}, 95 % interval {interval}</p>",
        share(success)
    )
}

/// Returns the key values of a run, one tile each.
fn tiles(best: &MetricsRow, last: &MetricsRow, is_shown: impl Fn(&str) -> bool) -> String {
    let per_arm: Vec<String> = best.success_per_arm.iter().map(|success| share(*success)).collect();
    let without_contact = best.contacts.success().map(|(success, interval)| {
        let arm_contact = optional(best.contacts.arm_contact_rate, share);
        let table_contact = optional(best.contacts.table_contact_rate, share);
        (
            WITHOUT_CONTACT_TILE,
            share(success),
            format!(
                "95 % interval {}; contact between arms: {arm_contact}, with table: {table_contact}",
                percent_range(interval)
            ),
        )
    });
    let tiles = [
        (
            "best success",
            share(best.success),
            format!("95 % interval {}, {} episodes", interval(best), best.n_episodes),
        ),
        ("joint goal", share(best.success_joint), format!("each arm: {}", per_arm.join(" / "))),
        (
            CONTACT_TILE,
            share(best.collision_rate),
            format!("before success: {}", share(best.collision_rate_before_success)),
        ),
        (
            "reached after",
            thousands(best.env_steps),
            format!("env steps, {}", duration(best.wall_s)),
        ),
        (
            ADVICE_TILE,
            thousands(last.advice_spent),
            match last.advice_queries {
                Some(n) => {
                    format!("{} left, {} queries", thousands(last.budget_left), thousands(n))
                }
                None => format!("{} left", thousands(last.budget_left)),
            },
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
    let shown = without_contact.iter().chain(&tiles).filter(|(label, ..)| is_shown(label));
    format!("<div class=tiles>{}</div>", shown.map(tile).collect::<String>())
}

/// Draws success, mean Q, contacts (if the task reports them) and advice (if the run took some) against environment
/// steps.
fn curves(run: &Run, task: Option<&TaskSpec>) -> Result<Vec<Drawing>, Error> {
    const AXIS: Axis = Axis::EnvSteps;
    let series = |named: &[(&str, Quantity)]| -> Vec<Series> {
        named.iter().map(|(name, quantity)| Series::of(name, &run.rows, AXIS, *quantity)).collect()
    };
    let draw = |title: &str, quantity: Quantity, series: &[Series]| {
        curve_drawing(series, CurveOptions::of(title, quantity, AXIS))
    };
    let is_built_in = task.is_none_or(|task| task.as_built_in().is_some());
    let moved = if is_built_in { "object moved" } else { "achieved goal moved" };
    let mut shares = vec![
        ("success", Quantity::Success),
        ("joint goal", Quantity::SuccessJoint),
        ("training episodes", Quantity::TrainingSuccess),
        (moved, Quantity::Moved),
    ];
    let is_known = |row: &MetricsRow| row.contacts.success_without_contact.is_some();
    if has_several_arms(task) && run.rows.iter().any(is_known) {
        shares.insert(1, (WITHOUT_CONTACT, Quantity::SuccessWithoutContact));
    }
    let success = series(&shares);
    let contacts = series(&[
        ("any", Quantity::CollisionRate),
        ("before success", Quantity::CollisionRateBeforeSuccess),
    ]);
    let mut curves = vec![
        draw("Success", Quantity::Success, &success)?,
        draw("Mean Q", Quantity::MeanQ, &series(&[("", Quantity::MeanQ)]))?,
    ];
    if reports_contacts(task) {
        curves.push(draw("Episodes with contact", Quantity::CollisionRate, &contacts)?);
    }
    if run.took_advice() {
        let advice = series(&[("", Quantity::AdviceSpent)]);
        curves.push(draw("Advice spent", Quantity::AdviceSpent, &advice)?);
    }
    Ok(curves)
}

const EVALUATION_HEADER: [&str; 13] = [
    "round",
    "env steps",
    "updates",
    "paper epochs",
    "time",
    "success",
    "95 % interval",
    WITHOUT_CONTACT,
    "joint",
    "contact",
    "moved",
    "mean Q",
    "advice spent",
];

/// Returns the table of all evaluations.
fn evaluations(rows: &[MetricsRow], task: Option<&TaskSpec>) -> String {
    let is_shown =
        |idx: &usize| has_several_arms(task) || EVALUATION_HEADER[*idx] != WITHOUT_CONTACT;
    let columns: Vec<usize> = (0..EVALUATION_HEADER.len()).filter(is_shown).collect();
    let header: Vec<&str> = columns.iter().map(|idx| EVALUATION_HEADER[*idx]).collect();
    let cells = |row| {
        let cells = evaluation_cells(row, reports_contacts(task));
        columns.iter().map(|idx| cells[*idx].clone()).collect()
    };
    table("Evaluations", &header, &rows.iter().map(cells).collect::<Vec<Vec<String>>>())
}

fn evaluation_cells(row: &MetricsRow, has_contacts: bool) -> Vec<String> {
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
        if has_contacts { share(row.collision_rate) } else { NONE.to_owned() },
        share(row.moved),
        number(Quantity::MeanQ.of(row)),
        thousands(row.advice_spent),
    ]
}
