//! Trials on arms: success rates and causes of failure, by policy and mode.

mod json;
mod plot;
mod table;

use std::collections::{BTreeMap, BTreeSet};

use tandem_core::{Task, Wilson};
use tandem_telemetry::TrialRow;

use crate::curve::Drawing;
use crate::plots::Plot;

pub use json::json;
pub(crate) use plot::millimetres;
pub use plot::trial_svg;

/// Causes of failure, in the order of the tables.
pub const CAUSES: [&str; 9] = [
    "not-reached",
    "condition-unmet",
    "object-lost",
    "timed-out",
    "arms-touched",
    "table-touched",
    "refused",
    "not-rehearsed",
    "stopped",
];
/// Column of all other causes, and of failures without a cause.
pub const OTHER_CAUSES: &str = "other";

/// Trials of one policy in one task and mode.
#[derive(Debug, Clone, PartialEq)]
pub struct TrialGroup {
    /// Name of the built-in task, such as `shared-push`.
    pub task: String,
    /// Name of the policy.
    pub policy: String,
    /// `open-loop`, `twin` or `closed-loop`.
    pub mode: String,
    /// Trials, sorted by seed and number.
    pub rows: Vec<TrialRow>,
}

/// All trials of a report.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Trials {
    /// Groups, push before pick and place, then by policy and mode.
    pub groups: Vec<TrialGroup>,
    /// One line for each problem that limits what the values mean.
    pub warnings: Vec<String>,
}

/// The trials that a report plots.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PlottedTrials {
    /// Failed trials.
    #[default]
    Failed,
    /// All trials.
    All,
}

impl Trials {
    /// Groups `rows` by task, policy and mode.
    #[must_use]
    pub fn of(rows: Vec<TrialRow>) -> Self {
        let mut by_group: BTreeMap<_, Vec<TrialRow>> = BTreeMap::new();
        for row in rows {
            let key =
                (task_order(&row.task), row.task.clone(), row.policy.clone(), row.mode.clone());
            by_group.entry(key).or_default().push(row);
        }
        let group = |((_, task, policy, mode), mut rows): ((usize, _, _, _), Vec<TrialRow>)| {
            rows.sort_by_key(|row| (row.seed, row.trial));
            TrialGroup { task, policy, mode, rows }
        };
        let groups: Vec<TrialGroup> = by_group.into_iter().map(group).collect();
        let warnings = groups.iter().filter_map(TrialGroup::repetition_warning).collect();
        Self { groups, warnings }
    }

    /// Draws the failed trials, or all trials.
    #[must_use]
    pub fn plots(&self, plotted: PlottedTrials) -> Vec<Plot> {
        let mut names = BTreeMap::new();
        let rows = self.groups.iter().flat_map(|group| &group.rows);
        let drawn = rows.filter(|row| plotted == PlottedTrials::All || !succeeded(row));
        drawn.map(|row| plot(row, &mut names)).collect()
    }
}

impl TrialGroup {
    /// Returns policy and mode, for tables.
    #[must_use]
    pub fn label(&self) -> String {
        format!("{}, {}", self.policy, self.mode)
    }

    /// Returns the number of successful trials.
    #[must_use]
    pub fn n_successes(&self) -> usize {
        self.rows.iter().filter(|row| succeeded(row)).count()
    }

    /// Returns Wilson's 95 % interval of the success rate.
    #[must_use]
    pub fn interval(&self) -> Wilson {
        Wilson::of(self.n_successes(), self.rows.len())
    }

    /// Returns the failed trials.
    pub fn failed(&self) -> impl Iterator<Item = &TrialRow> {
        self.rows.iter().filter(|row| !succeeded(row))
    }

    /// Returns the number of failures by each of [`CAUSES`], and last by any other cause.
    #[must_use]
    pub fn n_failed_by(&self) -> [usize; CAUSES.len() + 1] {
        let mut counts = [0; CAUSES.len() + 1];
        for row in self.failed() {
            let known = CAUSES.iter().position(|cause| row.cause.as_deref() == Some(*cause));
            counts[known.unwrap_or(CAUSES.len())] += 1;
        }
        counts
    }

    /// Returns the median duration of all trials, failures included, in seconds. `None` without trials.
    #[must_use]
    pub fn median_duration_s(&self) -> Option<f64> {
        median(self.rows.iter().map(|row| row.duration_s).collect())
    }

    /// Returns the median duration of the successful trials, in seconds. `None` without successes.
    #[must_use]
    pub fn median_success_duration_s(&self) -> Option<f64> {
        let successes = self.rows.iter().filter(|row| succeeded(row));
        median(successes.map(|row| row.duration_s).collect())
    }

    /// Returns a warning if some trials have the same seed and number.
    fn repetition_warning(&self) -> Option<String> {
        let starts: BTreeSet<_> = self.rows.iter().map(|row| (row.seed, row.trial)).collect();
        let n_repeated = self.rows.len() - starts.len();
        (n_repeated > 0).then(|| {
            format!(
                "{}, {}: {n_repeated} of {} trials repeat the seed and number of another; all are counted, so the interval \
                 is too narrow",
                self.task,
                self.label(),
                self.rows.len()
            )
        })
    }
}

/// Returns true if a trial succeeded. A trial with a cause is a failure even if its other fields say otherwise.
fn succeeded(row: &TrialRow) -> bool {
    row.success && row.cause.is_none()
}

/// Returns the outcome of a trial as one word: `success`, the cause of failure, or `failure`.
pub(crate) fn outcome(row: &TrialRow) -> &str {
    match &row.cause {
        Some(cause) => cause,
        None if row.success => "success",
        None => "failure",
    }
}

fn task_order(name: &str) -> usize {
    Task::ALL.iter().position(|task| task.name() == name).unwrap_or(Task::ALL.len())
}

/// Returns the median; for an even number of values, the mean of the middle two.
fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let middle = values.len() / 2;
    match values.len() {
        0 => None,
        n if n.is_multiple_of(2) => Some(0.5 * (values[middle - 1] + values[middle])),
        _ => Some(values[middle]),
    }
}

/// Draws a trial. `names` counts the uses of each file name, so that every plot gets its own.
fn plot(row: &TrialRow, names: &mut BTreeMap<String, u32>) -> Plot {
    let TrialRow { task, policy, mode, seed, trial, .. } = row;
    let policy_part: String = slug(policy).chars().take(MAX_NAME_PART).collect();
    let stem = slug(&format!("trial-{task}-{policy_part}-{mode}-seed{seed}-{trial}"));
    let n_uses = names.entry(stem.clone()).or_insert(0);
    *n_uses += 1;
    let file_name = match *n_uses {
        1 => format!("{stem}.svg"),
        n => format!("{stem}-again{n}.svg"),
    };
    let title = format!("{task}, {policy}, {mode}, trial {trial}: {}", outcome(row));
    let Drawing { wide, narrow } = plot::trial_drawing(row);
    Plot { file_name, title, svg: wide, narrow_svg: narrow }
}

/// Returns true if `stem` is the name of a plot's file without its extension, of these trials or of others.
pub(crate) fn is_file_stem(stem: &str) -> bool {
    let numbers = stem.strip_prefix("trial-").and_then(|rest| rest.rsplit_once("-seed"));
    let Some((_, numbers)) = numbers else { return false };
    let parts: Vec<&str> = numbers.split('-').collect();
    let is_number = |text: &str| text.parse::<u64>().is_ok();
    match parts.as_slice() {
        [seed, trial] => is_number(seed) && is_number(trial),
        [seed, trial, again] => {
            is_number(seed)
                && is_number(trial)
                && again.strip_prefix("again").is_some_and(is_number)
        }
        _ => false,
    }
}

/// Largest number of characters of a policy's name in the name of a file.
const MAX_NAME_PART: usize = 100;

/// Returns a name that is valid on every file system.
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
    fn the_median_is_the_middle_value_or_the_mean_of_two() {
        let of = |values: &[f64]| median(values.to_vec());
        assert_eq!(of(&[]), None);
        assert_eq!(of(&[3.0]), Some(3.0));
        assert_eq!(of(&[9.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(of(&[4.0, 4.0, 1.0, 9.0]), Some(4.0));
        assert_eq!(of(&[4.0, 2.0]), Some(3.0));
    }

    #[test]
    fn a_file_name_has_no_special_characters() {
        assert_eq!(slug("trial-Push/../x y-é-1.5"), "trial-push-..-x-y---1.5");
    }
}
