//! The paper's Table 2.

use super::four_digits;
use crate::paper::{PaperMeasures, TABLE_2};
use crate::table::{Table, optional};

/// Returns the paper's Table 2 with the paper's values, by the names of Tandem's strategies.
#[must_use]
pub fn paper_table() -> Table {
    let header = [
        "strategy",
        "in the paper",
        "push: IE",
        "RT",
        "MSR",
        "ELR",
        "pick and place: IE",
        "RT",
        "MSR",
        "ELR",
    ];
    let mut table = Table::new("the paper's Table 2".to_owned(), &header);
    table.rows.extend(TABLE_2.iter().map(|row| {
        let threshold = row.threshold.map(|threshold| format!(":{threshold}"));
        let mut cells =
            vec![format!("{}{}", row.strategy, threshold.unwrap_or_default()), row.name.to_owned()];
        cells.extend(paper_cells(&row.push));
        cells.extend(paper_cells(&row.pick_and_place));
        cells
    }));
    table
}

fn paper_cells(measures: &PaperMeasures) -> [String; 4] {
    let whole = |epochs: f64| format!("{epochs:.0}");
    let has_learned = measures.inspired_epoch.is_some();
    let rate = Some(measures.learning_rate).filter(|_| has_learned);
    [
        optional(measures.inspired_epoch, whole),
        optional(measures.rising_epochs, whole),
        four_digits(measures.max_success),
        optional(rate, four_digits),
    ]
}
