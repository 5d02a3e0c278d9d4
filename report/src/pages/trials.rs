//! The part of a report about trials: tables, then plots, then a list of all trials.

use tandem_telemetry::TrialRow;

use crate::html::{details, escaped, plot_grid, titled_table};
use crate::paper;
use crate::plots::Plot;
use crate::table::{NONE, Table, optional};
use crate::trials::{TrialGroup, Trials, millimetres, outcome};

/// Explains the values of the tables.
const NOTES: &str = "Intervals are Wilson's 95 % intervals; they apply to further trials of the same kind on the same arms. The median time is over all \
     trials, including failures. The paper's trials were on two real arms with another driver and other objects; the paper \
     does not count failures by cause.";

const HEADER: [&str; 12] = [
    "trial",
    "seed",
    "outcome",
    "distance to goal, mm",
    "in rehearsal, mm",
    "time, s",
    "steps",
    "shortened",
    "gap between arms, mm",
    "gap to table, mm",
    "detail",
    "log",
];

/// Returns the tables, plots and lists of `trials` as HTML.
pub(super) fn body(trials: &Trials, plots: &[Plot]) -> String {
    let mut body: String = trials.tables().iter().map(titled_table).collect();
    let warnings = trials.warnings.iter().map(|warning| format!("<p>{}</p>", escaped(warning)));
    body.extend(warnings);
    let notes = format!("{} {NOTES}", success_note(trials));
    body.push_str(&format!("<p>{}</p><p>{}</p>", escaped(&notes), escaped(paper::SOURCE)));
    if plots.is_empty() {
        body.push_str("<h2>Plots</h2><p>No trial failed.</p>");
    } else {
        body.push_str(&format!("<h2>Plots</h2>{}", plot_grid(plots)));
    }
    let all: String = trials.groups.iter().map(|group| titled_table(&all_trials(group))).collect();
    body.push_str(&details("All trials", &all));
    body
}

/// Explains when a trial succeeds.
fn success_note(trials: &Trials) -> String {
    let rows = trials.groups.iter().flat_map(|group| &group.rows);
    let mut tolerances_m: Vec<f64> = rows.filter_map(TrialRow::goal_tolerance_m).collect();
    tolerances_m.sort_by(f64::total_cmp);
    // Numbers that were single precision are equal in millimetres only.
    let mut texts: Vec<String> =
        tolerances_m.iter().map(|tolerance_m| centimetres(*tolerance_m)).collect();
    texts.dedup();
    let within = match texts.as_slice() {
        [] => "the tolerance".to_owned(),
        texts => format!("{} cm", texts.join(" or ")),
    };
    format!(
        "A trial succeeds if every object ends within {within} of its goal and nothing fails on the way."
    )
}

/// Formats a length in centimetres, to a tenth of a millimetre.
fn centimetres(length_m: f64) -> String {
    let text = format!("{:.2}", 100.0 * length_m);
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

fn all_trials(group: &TrialGroup) -> Table {
    let title = format!("{}, {}: all trials", group.task, group.label());
    let mut table = Table::new(title, &HEADER);
    table.rows.extend(group.rows.iter().map(cells));
    table
}

fn cells(row: &TrialRow) -> Vec<String> {
    let text = |text: &Option<String>| text.clone().unwrap_or_else(|| NONE.to_owned());
    vec![
        row.trial.to_string(),
        row.seed.to_string(),
        outcome(row).to_owned(),
        millimetres(&row.goal_distances_m),
        row.rehearsed_m.as_deref().map_or_else(|| NONE.to_owned(), millimetres),
        format!("{:.1}", row.duration_s),
        row.n_steps.to_string(),
        row.n_shortened.to_string(),
        optional(row.arms_gap_m, tenths_of_millimetre),
        tenths_of_millimetre(row.table_gap_m),
        text(&row.detail),
        text(&row.log),
    ]
}

fn tenths_of_millimetre(length_m: f64) -> String {
    format!("{:.1}", 1000.0 * length_m)
}
