//! The part of a report that compares runs.

use crate::comparison::{Comparison, INTERVALS, LEGEND, Section, paper_table};
use crate::html::{details, escaped, film_strip, plot_grid, titled_table};
use crate::paper;
use crate::plots::{ComparisonPlots, Plot, n_first_plots};

/// Explains the values of the tables.
const NOTES: &str = "Values over several runs are the mean, with the smallest and the largest below it where a table has room, \
     and the number of runs that have the value if some do not. Bands of curves are from the smallest to the largest value \
     over seeds, or the 95 % interval of a single run. Against wall time, a curve continues after the end of a run \
     with the later points of the others. The best of many evaluations is biased upwards; the evaluation on test goals \
     is not. Success without contact is that without contact between the arms.";

/// Explains why the paper's values are apart.
const PAPER_NOTES: &str = "The paper's values are from another simulator, recipe, start distribution and count of epochs: they \
     cannot be compared with those of these runs.";

/// Returns the plots and tables of `comparison` as HTML: for each section curves, then means; the rest is folded.
pub(super) fn body(comparison: &Comparison, plots: &ComparisonPlots) -> String {
    let sections = comparison.sections.iter().zip(&plots.sections);
    let mut body: String = sections.map(|(section, plots)| section_body(section, plots)).collect();
    if !comparison.films.is_empty() {
        let films = comparison.films.iter().enumerate().map(|(idx, film)| film_strip(idx, film));
        body.push_str(&format!("<h2>Episodes</h2>{}", films.collect::<String>()));
    }
    if !plots.from_scratch.is_empty() {
        let grid = plot_grid(&plots.from_scratch);
        body.push_str(&format!("<h2>Learning from scratch</h2>{grid}"));
    }
    let paragraph = |text: &str| format!("<p>{}</p>", escaped(text));
    body.push_str("<h2>Notes</h2>");
    body.extend(comparison.warnings.iter().map(|warning| paragraph(warning)));
    let legend = comparison.is_in_paper().then_some(LEGEND);
    body.extend(legend.into_iter().chain([NOTES, INTERVALS]).map(paragraph));
    if legend.is_none() {
        return body;
    }
    let source = format!("<p>{}</p><p>{}</p>", escaped(PAPER_NOTES), escaped(paper::SOURCE));
    let paper = format!("{}{source}", titled_table(&paper_table()));
    body.push_str(&details("The paper's values", &paper));
    body
}

fn section_body(section: &Section, plots: &[Plot]) -> String {
    let (first, further) = plots.split_at(plots.len().min(n_first_plots(section)));
    let mut body = format!("<h2>{}</h2>", escaped(&section.setup.title()));
    if !first.is_empty() {
        body.push_str(&plot_grid(first));
    }
    body.extend(section.summaries().iter().map(titled_table));
    body.extend(section.hint().map(|hint| format!("<p>{}</p>", escaped(&hint))));
    if !further.is_empty() {
        let summary = format!("Further curves: {}", further.len());
        body.push_str(&details(&summary, &plot_grid(further)));
    }
    let tables: String = section.tables().iter().map(titled_table).collect();
    body.push_str(&details("All values, with ranges and intervals", &tables));
    body
}
