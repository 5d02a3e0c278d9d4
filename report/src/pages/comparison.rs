//! The part of a report that compares runs.

use crate::comparison::{Comparison, Section, paper_table};
use crate::html::{escaped, plot_grid, titled_table};
use crate::paper;
use crate::plots::Plot;

/// Explains the values of the tables.
const NOTES: &str = "IE: epoch of the first evaluation with 10 % of the maximum success. RT: number of epochs from there to 90 % \
     of the maximum. MSR: maximum success. ELR: 90 % of MSR, divided by the number of epochs until it was reached. Values over \
     several runs are the mean (smallest–largest), followed by the number of runs that have the value if some do not. \
     Intervals are Wilson's 95 % intervals over the episodes of all runs; they do not include the variation between seeds. \
     The best of many evaluations is biased upwards; the evaluation on test goals is not.";

/// Returns the tables and plots of `comparison` as HTML.
pub(super) fn body(comparison: &Comparison, plots: &[Plot]) -> String {
    let tables = comparison.sections.iter().flat_map(Section::tables);
    let mut body: String = tables.map(|table| titled_table(&table)).collect();
    body.push_str(&plot_grid(plots));
    body.push_str(&titled_table(&paper_table()));
    body.push_str(&format!("<p>{}</p><p>{}</p>", escaped(paper::SOURCE), escaped(NOTES)));
    body
}
