//! Trials as part of a page: tables first, then what failed, then every trial.

use tandem_telemetry::TrialRow;

use super::{TrialGroup, Trials, verdict};
use crate::figures::Figure;
use crate::html::{escaped, figures, titled_table};
use crate::paper;
use crate::table::{NONE, Table, optional};

/// How the tables are meant.
pub(crate) const NOTES: &str = "A trial succeeds when every object ends within 5 cm of its goal and nothing went wrong on the way. \
     Intervals are Wilson's 95 %: they hold for further trials of the same kind, on the same arms. The median time is of all \
     trials, failures too. The paper's trials were on two real arms with a driver and objects of its own, and it gives no \
     counts by cause.";

const HEADER: [&str; 12] = [
    "trial",
    "seed",
    "outcome",
    "from goals, mm",
    "rehearsed, mm",
    "time, s",
    "steps",
    "shortened",
    "gap of arms, mm",
    "gap to table, mm",
    "detail",
    "log",
];

/// Everything there is to show of `trials`; `drawn` are their pictures.
pub(crate) fn trials_body(trials: &Trials, drawn: &[Figure]) -> String {
    let mut body: String = trials.tables().iter().map(titled_table).collect();
    let warnings = trials.warnings.iter().map(|warning| format!("<p>{}</p>", escaped(warning)));
    body.extend(warnings);
    body.push_str(&format!("<p>{}</p><p>{}</p>", escaped(NOTES), escaped(paper::SOURCE)));
    if drawn.is_empty() {
        body.push_str("<h2>Pictures</h2><p>No trial failed.</p>");
    } else {
        body.push_str(&format!("<h2>Pictures</h2>{}", figures(drawn)));
    }
    body.extend(trials.groups.iter().map(|group| titled_table(&every_trial(group))));
    body
}

fn every_trial(group: &TrialGroup) -> Table {
    let title = format!("{}, {}: every trial", group.task, group.label());
    let mut table = Table::new(title, &HEADER);
    table.lines.extend(group.rows.iter().map(cells));
    table
}

fn cells(row: &TrialRow) -> Vec<String> {
    let text = |text: &Option<String>| text.clone().unwrap_or_else(|| NONE.to_owned());
    vec![
        row.trial.to_string(),
        row.seed.to_string(),
        verdict(row).to_owned(),
        millimetres(&row.goal_distances_m),
        row.rehearsed_m.as_deref().map_or_else(|| NONE.to_owned(), millimetres),
        format!("{:.1}", row.duration_s),
        row.n_steps.to_string(),
        row.n_shortened.to_string(),
        optional(row.arms_gap_m, one_millimetre),
        one_millimetre(row.table_gap_m),
        text(&row.detail),
        text(&row.log),
    ]
}

/// Lengths, arm by arm.
pub(super) fn millimetres(lengths_m: &[f64]) -> String {
    match lengths_m {
        [] => NONE.to_owned(),
        _ => lengths_m.iter().map(|m| format!("{:.0}", 1000.0 * m)).collect::<Vec<_>>().join(" / "),
    }
}

fn one_millimetre(length_m: f64) -> String {
    format!("{:.1}", 1000.0 * length_m)
}
