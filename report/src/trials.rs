//! Trials on arms: whose they were, how many succeeded, and why the others did not.

mod json;
mod page;
mod picture;
mod table;

use std::collections::{BTreeMap, BTreeSet};

use tandem_core::{Task, Wilson};
use tandem_telemetry::TrialRow;

use crate::figures::Figure;

pub use json::json;
pub(crate) use page::trials_body;
pub use picture::trial_svg;

/// Why trials fail, in the order of the tables.
pub const CAUSES: [&str; 7] = [
    "not-reached",
    "object-lost",
    "timed-out",
    "arms-touched",
    "table-touched",
    "refused",
    "stopped",
];
/// What stands for every other cause, and for a failure that has none.
pub const OTHER_CAUSES: &str = "other";

/// Trials of one subject at one task in one mode.
#[derive(Debug, Clone, PartialEq)]
pub struct TrialGroup {
    /// `push` or `pick-and-place`.
    pub task: String,
    /// Whose trials they are: a policy's name.
    pub subject: String,
    /// `open-loop` or `closed-loop`.
    pub mode: String,
    /// The trials, by seed and number.
    pub rows: Vec<TrialRow>,
}

/// All trials of a report.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Trials {
    /// Push before pick and place, then by subject and mode.
    pub groups: Vec<TrialGroup>,
    /// What makes the figures less than they seem, a line each.
    pub warnings: Vec<String>,
}

/// Which trials are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Pictured {
    /// Those that failed.
    #[default]
    Failures,
    /// Every one.
    All,
}

impl Trials {
    /// Puts `rows` into their groups.
    #[must_use]
    pub fn of(rows: Vec<TrialRow>) -> Self {
        let mut by_group: BTreeMap<_, Vec<TrialRow>> = BTreeMap::new();
        for row in rows {
            let key =
                (task_order(&row.task), row.task.clone(), row.subject.clone(), row.mode.clone());
            by_group.entry(key).or_default().push(row);
        }
        let group = |((_, task, subject, mode), mut rows): ((usize, _, _, _), Vec<TrialRow>)| {
            rows.sort_by_key(|row| (row.seed, row.trial));
            TrialGroup { task, subject, mode, rows }
        };
        let groups: Vec<TrialGroup> = by_group.into_iter().map(group).collect();
        let warnings = groups.iter().filter_map(TrialGroup::repeated).collect();
        Self { groups, warnings }
    }

    /// A picture of each trial that failed, or of each.
    #[must_use]
    pub fn pictures(&self, pictured: Pictured) -> Vec<Figure> {
        let mut names = BTreeMap::new();
        let rows = self.groups.iter().flat_map(|group| &group.rows);
        let drawn = rows.filter(|row| pictured == Pictured::All || !succeeded(row));
        drawn.map(|row| picture(row, &mut names)).collect()
    }
}

impl TrialGroup {
    /// Subject and mode, for tables.
    #[must_use]
    pub fn label(&self) -> String {
        format!("{}, {}", self.subject, self.mode)
    }

    /// How many trials succeeded.
    #[must_use]
    pub fn n_successes(&self) -> usize {
        self.rows.iter().filter(|row| succeeded(row)).count()
    }

    /// The 95 % interval of the share of successes.
    #[must_use]
    pub fn interval(&self) -> Wilson {
        Wilson::of(self.n_successes(), self.rows.len())
    }

    /// The trials that failed.
    pub fn failed(&self) -> impl Iterator<Item = &TrialRow> {
        self.rows.iter().filter(|row| !succeeded(row))
    }

    /// How many trials failed by each of [`CAUSES`], and at last by any other.
    #[must_use]
    pub fn n_failed_by(&self) -> [usize; CAUSES.len() + 1] {
        let mut counts = [0; CAUSES.len() + 1];
        for row in self.failed() {
            let known = CAUSES.iter().position(|cause| row.cause.as_deref() == Some(*cause));
            counts[known.unwrap_or(CAUSES.len())] += 1;
        }
        counts
    }

    /// Half of the trials took no longer, seconds; failures count. `None` without trials.
    #[must_use]
    pub fn median_duration_s(&self) -> Option<f64> {
        median(self.rows.iter().map(|row| row.duration_s).collect())
    }

    /// The same of the successes alone.
    #[must_use]
    pub fn median_success_duration_s(&self) -> Option<f64> {
        let successes = self.rows.iter().filter(|row| succeeded(row));
        median(successes.map(|row| row.duration_s).collect())
    }

    /// A warning when the same start was tried more than once.
    fn repeated(&self) -> Option<String> {
        let starts: BTreeSet<_> = self.rows.iter().map(|row| (row.seed, row.trial)).collect();
        let n_repeated = self.rows.len() - starts.len();
        (n_repeated > 0).then(|| {
            format!(
                "{}, {}: {n_repeated} of {} trials repeat another's seed and number; all are counted, so the interval is \
                 narrower than it should be",
                self.task,
                self.label(),
                self.rows.len()
            )
        })
    }
}

/// Whether nothing at all went wrong.
fn succeeded(row: &TrialRow) -> bool {
    row.success && row.cause.is_none()
}

/// How a trial ended, in a word.
fn verdict(row: &TrialRow) -> &str {
    match &row.cause {
        Some(cause) => cause,
        None if row.success => "success",
        None => "failure",
    }
}

fn task_order(name: &str) -> usize {
    Task::ALL.iter().position(|task| task.name() == name).unwrap_or(Task::ALL.len())
}

/// The middle value, or the mean of the middle two.
fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let middle = values.len() / 2;
    match values.len() {
        0 => None,
        n if n.is_multiple_of(2) => Some(0.5 * (values[middle - 1] + values[middle])),
        _ => Some(values[middle]),
    }
}

/// The picture of a trial, under a name that no picture in `names` has.
fn picture(row: &TrialRow, names: &mut BTreeMap<String, u32>) -> Figure {
    let TrialRow { task, subject, mode, seed, trial, .. } = row;
    let stem = slug(&format!("trial-{task}-{subject}-{mode}-seed{seed}-{trial}"));
    let n_before = names.entry(stem.clone()).or_insert(0);
    *n_before += 1;
    let file_name = match *n_before {
        1 => format!("{stem}.svg"),
        n => format!("{stem}-again{n}.svg"),
    };
    let title = format!("{task}, {subject}, {mode}, trial {trial}: {}", verdict(row));
    Figure { file_name, title, svg: trial_svg(row) }
}

/// A name that every file system takes.
fn slug(text: &str) -> String {
    let safe = |c: char| match c {
        'a'..='z' | '0'..='9' | '-' | '_' | '.' => c,
        'A'..='Z' => c.to_ascii_lowercase(),
        _ => '-',
    };
    text.chars().map(safe).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_is_in_the_middle() {
        let of = |values: &[f64]| median(values.to_vec());
        assert_eq!(of(&[]), None);
        assert_eq!(of(&[3.0]), Some(3.0));
        assert_eq!(of(&[9.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(of(&[4.0, 4.0, 1.0, 9.0]), Some(4.0));
        assert_eq!(of(&[4.0, 2.0]), Some(3.0));
    }

    #[test]
    fn a_files_name_has_no_odd_signs() {
        assert_eq!(slug("trial-Push/../x y-é-1.5"), "trial-push-..-x-y---1.5");
    }
}
