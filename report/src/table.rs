//! Tables, as plain text and for HTML pages, and the format of their values.

use tandem_core::Wilson;
use tandem_telemetry::MetricsRow;

use crate::group::Spread;

/// Shown for a value that does not exist.
pub(crate) const NONE: &str = "–";

/// A table with a title, a header and rows of as many cells.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Table {
    /// Title, shown above the table.
    pub title: String,
    /// Header cells.
    pub header: Vec<String>,
    /// Rows, each with one cell per column.
    pub rows: Vec<Vec<String>>,
}

impl Table {
    /// Creates a table without rows.
    pub(crate) fn new(title: String, header: &[&str]) -> Self {
        let header = header.iter().map(|head| (*head).to_owned()).collect();
        Self { title, header, rows: Vec::new() }
    }

    /// Formats the table for a terminal. The first column is left-aligned, the others are right-aligned.
    #[must_use]
    pub fn text(&self) -> String {
        let lines: Vec<&Vec<String>> = std::iter::once(&self.header).chain(&self.rows).collect();
        let width = |column: usize| {
            lines.iter().filter_map(|line| line.get(column)).map(|cell| cell.chars().count()).max()
        };
        let widths: Vec<usize> =
            (0..self.header.len()).map(|column| width(column).unwrap_or(0)).collect();
        let mut text = format!("{}\n", self.title);
        for line in lines {
            let padded =
                line.iter().zip(&widths).enumerate().map(|(column, (cell, width))| match column {
                    0 => format!("{cell:<width$}"),
                    _ => format!("{cell:>width$}"),
                });
            text.push_str(padded.collect::<Vec<_>>().join("  ").trim_end());
            text.push('\n');
        }
        text
    }
}

/// Formats a value over the runs of a group: the mean and, for several runs, the range and the number of runs that have
/// it.
pub(crate) fn spread(spread: &Spread, format: impl Fn(f64) -> String) -> String {
    let Spread { n, n_runs, mean, min, max } = *spread;
    if n == 0 {
        return NONE.to_owned();
    }
    let range = match n {
        1 => String::new(),
        _ => format!(" ({}–{})", format(min), format(max)),
    };
    let how_many = if n < n_runs { format!(", {n} of {n_runs}") } else { String::new() };
    format!("{}{range}{how_many}", format(mean))
}

/// Formats a share like [`spread`], with the 95 % interval over the episodes of all runs.
pub(crate) fn share_spread((values, interval): &(Spread, Option<Wilson>)) -> String {
    let text = spread(values, |share| format!("{share:.3}"));
    match interval {
        Some(Wilson { low, high }) => format!("{text} [{low:.3}, {high:.3}]"),
        None => text,
    }
}

/// Formats a value that may not exist.
pub(crate) fn optional(value: Option<f64>, format: impl Fn(f64) -> String) -> String {
    value.map_or_else(|| NONE.to_owned(), format)
}

/// Formats a share in per cent.
pub(crate) fn share(share: f64) -> String {
    if share.is_finite() { format!("{:.1} %", 100.0 * share) } else { NONE.to_owned() }
}

/// Formats a number with three decimals.
pub(crate) fn number(value: f64) -> String {
    if value.is_finite() { format!("{value:.3}") } else { NONE.to_owned() }
}

/// Formats the 95 % interval of an evaluation's success in per cent.
pub(crate) fn interval(row: &MetricsRow) -> String {
    format!("{:.1}–{:.1} %", 100.0 * row.success_low, 100.0 * row.success_high)
}

/// Formats a count with thousands separators.
pub(crate) fn thousands(count: u64) -> String {
    let digits = count.to_string();
    let mut text = String::with_capacity(digits.len() + digits.len() / 3);
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// Formats a number with a unit prefix: 1500000 as 1.5M, 20000 as 20k.
pub(crate) fn short_number(value: f64) -> String {
    let (scaled, unit) = match value.abs() {
        size if size >= 999_500.0 => (value / 1e6, "M"),
        size if size >= 1000.0 => (value / 1e3, "k"),
        _ => (value, ""),
    };
    let text = format!("{scaled:.2}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    format!("{}{unit}", if text == "-0" { "0" } else { text })
}

/// Formats a duration as hours and minutes, or as minutes and seconds below one hour.
pub(crate) fn duration(seconds: f64) -> String {
    let whole = std::time::Duration::try_from_secs_f64(seconds).unwrap_or_default().as_secs();
    let (hours, minutes, seconds) = (whole / 3600, whole / 60 % 60, whole % 60);
    match hours {
        0 => format!("{minutes}:{seconds:02} min"),
        _ => format!("{hours}:{minutes:02} h"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_and_durations_are_formatted_for_people() {
        assert_eq!([0, 999, 1000, 1_234_567].map(thousands), ["0", "999", "1,000", "1,234,567"]);
        assert_eq!(
            [0.4, 59.9, 61.0, 3725.0, f64::NAN].map(duration),
            ["0:00 min", "0:59 min", "1:01 min", "1:02 h", "0:00 min"]
        );
        assert_eq!(
            [0.0, -0.001, 0.25, 50.0, 1500.0, 20_000.0, 999_900.0, 1.5e6, -10.0].map(short_number),
            ["0", "0", "0.25", "50", "1.5k", "20k", "1M", "1.5M", "-10"]
        );
    }

    #[test]
    fn a_spread_shows_how_many_runs_have_the_value() {
        let text = |values: &[f64], n_runs| {
            spread(&Spread::of(values, n_runs), |value| format!("{value:.1}"))
        };
        assert_eq!(text(&[2.0], 1), "2.0");
        assert_eq!(text(&[1.0, 3.0], 2), "2.0 (1.0–3.0)");
        assert_eq!(text(&[1.0, 3.0], 3), "2.0 (1.0–3.0), 2 of 3");
        assert_eq!(text(&[2.0], 3), "2.0, 1 of 3");
        assert_eq!(text(&[], 3), NONE);
    }

    #[test]
    fn columns_are_aligned() {
        let mut table = Table::new("heading".to_owned(), &["strategy", "IE"]);
        table.rows = vec![vec!["a-long-name".to_owned(), "1.0–2.0".to_owned()]];
        table.rows.push(vec!["b".to_owned(), "3".to_owned()]);
        let text = table.text();
        let ends: Vec<usize> = text.lines().skip(1).map(|line| line.chars().count()).collect();
        assert_eq!(ends, [20, 20, 20], "{text}");
    }
}
