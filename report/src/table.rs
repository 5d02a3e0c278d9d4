//! Tables, as plain text and for HTML pages, and the format of their values.

use tandem_core::Wilson;
use tandem_telemetry::MetricsRow;

use crate::spread::{ShareSpread, Spread};

/// Shown for a value that does not exist.
pub(crate) const NONE: &str = "–";

/// Width of the narrowest terminal for which output is laid out, columns.
pub const TERMINAL_COLUMNS: usize = 80;
/// Gap between two columns.
const GAP: usize = 2;
/// Smallest width of the first column of an aligned table.
const MIN_FIRST_COLUMN: usize = 12;

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

/// Returns a cell without control characters, which would break lines or command the terminal.
fn in_terminal(cell: &str) -> String {
    cell.replace(char::is_control, "\u{fffd}")
}

/// Escapes a cell for Markdown: its text is that of a user's directory.
fn in_markdown(cell: &str) -> String {
    cell.replace('|', "\\|").replace('<', "&lt;").replace(['\n', '\r'], " ")
}

impl Table {
    /// Creates a table without rows.
    pub(crate) fn new(title: String, header: &[&str]) -> Self {
        let header = header.iter().map(|head| (*head).to_owned()).collect();
        Self { title, header, rows: Vec::new() }
    }

    /// Removes the column with a head, if there is one.
    pub(crate) fn remove_column(&mut self, head: &str) {
        let Some(idx) = self.header.iter().position(|other| other == head) else { return };
        for row in std::iter::once(&mut self.header).chain(&mut self.rows) {
            row.remove(idx);
        }
    }

    /// Formats the table for a terminal. The first column is left-aligned, the others are right-aligned.
    ///
    /// If the table is wider than a terminal, a long first cell has a line of its own, above the other cells of
    /// its row. If the other columns alone are wider, each row becomes a block with one cell per line.
    #[must_use]
    pub fn text(&self) -> String {
        let rows = self
            .rows
            .iter()
            .map(|row| row.iter().map(|cell| in_terminal(cell)).collect())
            .collect();
        Self { rows, ..self.clone() }.aligned_text()
    }

    fn aligned_text(&self) -> String {
        let lines: Vec<&Vec<String>> = std::iter::once(&self.header).chain(&self.rows).collect();
        let width = |column: usize| {
            lines.iter().filter_map(|line| line.get(column)).map(|cell| n_chars(cell)).max()
        };
        let widths: Vec<usize> =
            (0..self.header.len()).map(|column| width(column).unwrap_or(0)).collect();
        let others: usize = widths.iter().skip(1).map(|width| GAP + width).sum();
        let title = paragraph(&self.title);
        if others + MIN_FIRST_COLUMN > TERMINAL_COLUMNS {
            return format!("{title}{}", self.blocks());
        }
        let first = widths.first().copied().unwrap_or(0).min(TERMINAL_COLUMNS - others);
        let rows = lines.into_iter().map(|line| aligned(line, first, &widths));
        format!("{title}{}", rows.collect::<String>())
    }

    /// Formats the table as Markdown, below its title as a heading. The first column is left-aligned.
    #[must_use]
    pub fn markdown(&self) -> String {
        let line = |cells: &[String]| {
            let cells: Vec<String> = cells.iter().map(|cell| in_markdown(cell)).collect();
            format!("| {} |\n", cells.join(" | "))
        };
        let alignments: String = (0..self.header.len())
            .map(|column| if column == 0 { "---|" } else { "---:|" })
            .collect();
        let rows: String = self.rows.iter().map(|row| line(row)).collect();
        format!("### {}\n\n{}|{alignments}\n{rows}", self.title, line(&self.header))
    }

    /// Formats each row as a block: its first cell, then a line for each other cell.
    fn blocks(&self) -> String {
        let names = self.header.iter().skip(1);
        let width = names.clone().map(|name| n_chars(name)).max().unwrap_or(0);
        let block = |row: &Vec<String>| {
            let cells = names.clone().zip(row.iter().skip(1));
            let lines = cells.map(|(name, cell)| format!("  {name:<width$}  {cell}\n"));
            let label = paragraph(row.first().map_or("", String::as_str));
            format!("{label}{}", lines.collect::<String>())
        };
        self.rows.iter().map(block).collect()
    }
}

/// Formats a row with its first cell in a column of `first` characters, or above the others if it is longer.
fn aligned(row: &[String], first: usize, widths: &[usize]) -> String {
    let label = row.first().map_or("", String::as_str);
    let others = row.iter().zip(widths).skip(1);
    let others: String =
        others.map(|(cell, width)| format!("{:gap$}{cell:>width$}", "", gap = GAP)).collect();
    let line = match n_chars(label) > first {
        true => format!("{}{:first$}{others}", paragraph(label), ""),
        false => format!("{label:<first$}{others}"),
    };
    format!("{}\n", line.trim_end())
}

/// Breaks `text` between words into lines of at most [`TERMINAL_COLUMNS`] columns. Lines after the first start with
/// `indent`. A word that is longer than a line, such as a path, gets a line of its own.
#[must_use]
pub fn wrapped(text: &str, indent: &str) -> String {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            None => lines.push(word.to_owned()),
            Some(line) if n_chars(line) + 1 + n_chars(word) <= TERMINAL_COLUMNS => {
                line.push(' ');
                line.push_str(word);
            }
            Some(_) => lines.push(format!("{indent}{word}")),
        }
    }
    lines.join("\n")
}

/// Returns `text` in lines of at most [`TERMINAL_COLUMNS`] columns, each with its end.
pub(crate) fn paragraph(text: &str) -> String {
    wrapped(text, "").lines().map(|line| format!("{line}\n")).collect()
}

fn n_chars(text: &str) -> usize {
    text.chars().count()
}

/// Formats a value over the runs of a group: the mean, the range if runs differ, and the number of runs that have it if
/// some do not.
pub(crate) fn spread(spread: &Spread, format: impl Fn(f64) -> String) -> String {
    let Spread { n, n_runs, mean, min, max } = *spread;
    if n == 0 {
        return NONE.to_owned();
    }
    let [low, high] = [min, max].map(&format);
    let range = if low == high { String::new() } else { format!(" ({low}–{high})") };
    let how_many = if n < n_runs { format!(", {n} of {n_runs}") } else { String::new() };
    format!("{}{range}{how_many}", format(mean))
}

/// Formats the mean of a value over the runs of a group, and how many of them have it if some do not.
pub(crate) fn mean(spread: &Spread, format: impl Fn(f64) -> String) -> String {
    let Spread { n, n_runs, mean, .. } = *spread;
    match n {
        0 => NONE.to_owned(),
        n if n < n_runs => format!("{} ({n}/{n_runs})", format(mean)),
        _ => format(mean),
    }
}

/// Formats a share like [`spread`], with its 95 % interval.
pub(crate) fn share_spread(share: &ShareSpread) -> String {
    let text = spread(&share.values, |value| format!("{value:.3}"));
    match share.shown_interval() {
        Some((low, high)) => format!("{text} [{low:.3}, {high:.3}]"),
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
    percent_range(Wilson { low: row.success_low, high: row.success_high })
}

/// Formats an interval in per cent.
pub(crate) fn percent_range(Wilson { low, high }: Wilson) -> String {
    format!("{:.1}–{:.1} %", 100.0 * low, 100.0 * high)
}

/// Formats a count with thousands separators.
#[must_use]
pub fn thousands(count: u64) -> String {
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
        0 => format!("{minutes} min {seconds:02} s"),
        _ => format!("{hours} h {minutes:02} min"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_break_between_words_only() {
        let path = "x".repeat(100);
        let text = format!("{} {path} end", "word ".repeat(20));
        let lines = wrapped(&text, "  ");
        let lines: Vec<&str> = lines.lines().collect();
        assert_eq!((lines.len(), lines[0].len()), (4, 79), "{lines:?}");
        assert_eq!(lines[1..], ["  word word word word", &format!("  {path}"), "  end"]);
        assert_eq!((wrapped("", "  ").as_str(), paragraph("").as_str()), ("", ""));
        assert_eq!(paragraph("a  b"), "a b\n");
    }

    #[test]
    fn counts_and_durations_are_formatted_for_people() {
        assert_eq!([0, 999, 1000, 1_234_567].map(thousands), ["0", "999", "1,000", "1,234,567"]);
        assert_eq!(
            [0.4, 59.9, 61.0, 3725.0, f64::NAN].map(duration),
            ["0 min 00 s", "0 min 59 s", "1 min 01 s", "1 h 02 min", "0 min 00 s"]
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
        assert_eq!(text(&[2.0, 2.01], 2), "2.0");
        assert_eq!(text(&[2.0], 3), "2.0, 1 of 3");
        assert_eq!(text(&[], 3), NONE);
    }

    #[test]
    fn names_do_not_break_lines_or_command_the_terminal() {
        let mut table = Table::new("T".to_owned(), &["run", "success"]);
        table.rows.push(vec!["a\nb\u{1b}[2J".to_owned(), "1".to_owned()]);
        assert_eq!(table.text(), "T\nrun      success\na\u{fffd}b\u{fffd}[2J        1\n");
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

    #[test]
    fn markdown_has_a_line_for_the_header_and_each_row() {
        let mut table = Table::new("heading".to_owned(), &["strategy", "IE"]);
        table.rows = vec![vec!["a|b".to_owned(), "1.0–2.0".to_owned()]];
        let expected = "### heading\n\n| strategy | IE |\n|---|---:|\n| a\\|b | 1.0–2.0 |\n";
        assert_eq!(table.markdown(), expected);
    }

    #[test]
    fn no_line_of_a_table_is_wider_than_a_terminal() {
        let long =
            "ddpg.bc_weight=0, ddpg.polyak_keep=0.95, exploration.random_share=0.3, rounds.lag=1";
        let check = |n_columns: usize, expected: &str| {
            let header: Vec<String> = (0..n_columns).map(|idx| format!("column {idx}")).collect();
            let header: Vec<&str> = header.iter().map(String::as_str).collect();
            let mut table = Table::new("words of a title ".repeat(9), &header);
            let cells = std::iter::repeat_n("0.996 (0.99)".to_owned(), n_columns - 1);
            table.rows.push(std::iter::once(long[..70].to_owned()).chain(cells.clone()).collect());
            table.rows.push(std::iter::once(long.to_owned()).chain(cells).collect());
            let text = table.text();
            assert!(text.lines().all(|line| n_chars(line) <= TERMINAL_COLUMNS), "{text}");
            assert!(text.contains(expected), "{text}");
        };
        check(4, &format!("\n{}\n{:38}  0.996 (0.99)  0.996", &long[..70], ""));
        check(9, &format!("\n{}\n  column 1  0.996 (0.99)\n  column 2", &long[..70]));
    }
}
