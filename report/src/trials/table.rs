//! Tables of trials: the paper's Table 4, with intervals and causes of failure.

use tandem_core::{Task, Wilson};

use super::{CAUSES, OTHER_CAUSES, TrialGroup, Trials};
use crate::paper::{N_PAPER_TRIALS, PaperTrials, TABLE_4};
use crate::table::{NONE, Table, optional, paragraph};

/// Number of arms in the paper's trials.
const N_PAPER_ARMS: usize = 2;

impl Trials {
    /// Returns one table per task.
    #[must_use]
    pub fn tables(&self) -> Vec<Table> {
        self.groups.chunk_by(|a, b| a.task == b.task).map(task_table).collect()
    }

    /// Formats the results for a terminal of 80 columns: successes, and below them the causes of failures.
    #[must_use]
    pub fn text(&self) -> String {
        let tasks = self.groups.chunk_by(|a, b| a.task == b.task);
        tasks.map(task_text).collect::<Vec<_>>().join("\n")
    }
}

/// Formats the results of one task.
fn task_text(groups: &[TrialGroup]) -> String {
    let full = task_table(groups);
    let without_causes = |cells: Vec<String>| -> Vec<String> {
        let last = cells.len().saturating_sub(1);
        let shown = cells.into_iter().enumerate().filter(|(idx, _)| *idx < 3 || *idx == last);
        shown.map(|(_, cell)| cell).collect()
    };
    let table = Table {
        title: full.title,
        header: without_causes(full.header),
        rows: full.rows.into_iter().map(without_causes).collect(),
    };
    let failures: String = groups.iter().filter_map(failures_text).collect();
    format!("{}{failures}", table.text())
}

/// Counts the failures of a group by their causes.
fn failures_text(group: &TrialGroup) -> Option<String> {
    let causes = CAUSES.into_iter().chain([OTHER_CAUSES]).zip(group.n_failed_by());
    let causes: Vec<String> =
        causes.filter(|(_, n)| *n > 0).map(|(cause, n)| format!("{n} {cause}")).collect();
    let text = format!("failures of {}: {}", group.label(), causes.join(", "));
    (!causes.is_empty()).then(|| paragraph(&text))
}

/// Returns the table of the groups of one task. The paper's rows follow if it has the task and a group has as many arms as
/// the paper.
fn task_table(groups: &[TrialGroup]) -> Table {
    let task_name = groups.first().map_or("", |group| &group.task);
    let has_others = groups.iter().any(|group| group.n_failed_by()[CAUSES.len()] > 0);
    let causes: Vec<&str> = CAUSES.into_iter().chain(has_others.then_some(OTHER_CAUSES)).collect();
    let mut header = vec!["policy, mode", "success", "share [95 % interval]"];
    header.extend(&causes);
    header.push("median time");
    let task = Task::ALL.into_iter().find(|task| task.name() == task_name);
    let is_extra = task.is_some_and(Task::shares_object);
    let as_in = if is_extra { "" } else { ", as the paper's Table 4" };
    let mut table = Table::new(format!("{task_name}: trials{as_in}"), &header);
    table.rows.extend(groups.iter().map(|group| row(group, causes.len())));
    let has_paper_arms = groups.iter().any(|group| n_arms(group) == N_PAPER_ARMS);
    for task in task.into_iter().filter(|_| has_paper_arms) {
        let rows = TABLE_4.iter().filter_map(|row| paper_row(row, task, causes.len()));
        table.rows.extend(rows);
    }
    table
}

fn row(group: &TrialGroup, n_causes: usize) -> Vec<String> {
    let mut row = vec![group.label()];
    row.extend(success_cells(group.n_successes(), group.rows.len()));
    row.extend(group.n_failed_by().iter().take(n_causes).map(usize::to_string));
    row.push(optional(group.median_duration_s(), |duration_s| format!("{duration_s:.1} s")));
    row
}

/// Returns a row of the paper, if the paper has the task.
fn paper_row(paper: &PaperTrials, task: Task, n_causes: usize) -> Option<Vec<String>> {
    let mut row = vec![format!("the paper, {}", paper.name)];
    row.extend(success_cells(paper.n_successes(task)?, N_PAPER_TRIALS));
    row.extend((0..=n_causes).map(|_| NONE.to_owned()));
    Some(row)
}

fn success_cells(n_successes: usize, n_trials: usize) -> [String; 2] {
    let Wilson { low, high } = Wilson::of(n_successes, n_trials);
    let percent = |share: f64| format!("{:.1}", 100.0 * share);
    let share = percent(n_successes as f64 / n_trials.max(1) as f64);
    [format!("{n_successes}/{n_trials}"), format!("{share} % [{}–{}]", percent(low), percent(high))]
}

fn n_arms(group: &TrialGroup) -> usize {
    group.rows.iter().map(|row| row.starts.len()).max().unwrap_or(0)
}
