//! The figures of runs as a table of plain text.

use tandem_telemetry::MetricsRow;

use crate::measures::LearningMeasures;
use crate::run::Run;

/// What stands for a number that does not exist.
const NONE: &str = "–";

/// One line a run: the best evaluation, the cost of reaching it and the paper's measures.
#[must_use]
pub fn summary_table(runs: &[Run]) -> String {
    let header = HEADER.map(str::to_owned);
    let lines: Vec<[String; N_COLUMNS]> =
        std::iter::once(header).chain(runs.iter().map(cells)).collect();
    let width =
        |column: usize| lines.iter().map(|line| line[column].chars().count()).max().unwrap_or(0);
    let widths: [usize; N_COLUMNS] = std::array::from_fn(width);
    let mut table = String::new();
    for line in &lines {
        let padded =
            line.iter().zip(widths).enumerate().map(|(column, (cell, width))| match column {
                0 => format!("{cell:<width$}"),
                _ => format!("{cell:>width$}"),
            });
        table.push_str(padded.collect::<Vec<_>>().join("  ").trim_end());
        table.push('\n');
    }
    table
}

pub(crate) const N_COLUMNS: usize = 12;
/// Heads of the columns of [`cells`].
pub(crate) const HEADER: [&str; N_COLUMNS] = [
    "run",
    "success",
    "95 % interval",
    "joint",
    "per arm",
    "contact",
    "env steps",
    "updates",
    "time",
    "advice",
    "IE",
    "ELR",
];

/// A run's line.
pub(crate) fn cells(run: &Run) -> [String; N_COLUMNS] {
    let Some(best) = run.best() else {
        return std::array::from_fn(
            |column| if column == 0 { run.name.clone() } else { NONE.to_owned() },
        );
    };
    let measures = LearningMeasures::of(&run.rows);
    [
        run.name.clone(),
        share(best.success),
        interval(best),
        share(best.success_joint),
        best.success_per_arm.iter().map(|success| share(*success)).collect::<Vec<_>>().join(" / "),
        share(best.collision_rate),
        thousands(best.env_steps),
        thousands(best.updates),
        duration(best.wall_s),
        thousands(best.advice_spent),
        measures.inspired_epoch.map_or_else(|| NONE.to_owned(), |epoch| format!("{epoch:.1}")),
        measures.learning_rate.map_or_else(|| NONE.to_owned(), |rate| format!("{rate:.4}")),
    ]
}

/// A share in per cent.
pub(crate) fn share(share: f64) -> String {
    if share.is_finite() { format!("{:.1} %", 100.0 * share) } else { NONE.to_owned() }
}

/// Any other number.
pub(crate) fn number(value: f64) -> String {
    if value.is_finite() { format!("{value:.3}") } else { NONE.to_owned() }
}

/// The 95 % interval of an evaluation's success.
pub(crate) fn interval(row: &MetricsRow) -> String {
    format!("{:.1}–{:.1} %", 100.0 * row.success_low, 100.0 * row.success_high)
}

/// A count with its thousands set apart.
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

/// A span of time in hours, minutes and seconds.
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
    fn counts_and_times_are_easy_to_read() {
        assert_eq!([0, 999, 1000, 1_234_567].map(thousands), ["0", "999", "1,000", "1,234,567"]);
        assert_eq!(
            [0.4, 59.9, 61.0, 3725.0, f64::NAN].map(duration),
            ["0:00 min", "0:59 min", "1:01 min", "1:02 h", "0:00 min"]
        );
    }

    #[test]
    fn columns_line_up_and_the_best_row_counts() {
        let row = |success, env_steps| MetricsRow {
            success,
            env_steps,
            success_per_arm: vec![success; 2],
            ..MetricsRow::default()
        };
        let run = |name: &str, rows| Run { name: name.to_owned(), rows, configuration: None };
        let table = summary_table(&[
            run("a-long-name", vec![row(0.5, 1000), row(0.9375, 2000), row(0.9375, 3000)]),
            run("empty", Vec::new()),
        ]);
        let lines: Vec<&str> = table.lines().collect();
        assert_eq!(lines.len(), 3);
        assert!(
            lines[1].contains("93.8 %")
                && lines[1].contains("2,000")
                && !lines[1].contains("3,000"),
            "{table}"
        );
        let end_of =
            |line: &str, text: &str| line[..line.find(text).unwrap() + text.len()].chars().count();
        assert_eq!(end_of(lines[0], "success"), end_of(lines[1], "93.8 %"));
    }
}
