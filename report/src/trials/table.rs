//! Trials as tables: the paper's Table 4, with intervals and causes.

use tandem_core::{Task, Wilson};

use super::{CAUSES, OTHER_CAUSES, TrialGroup, Trials};
use crate::paper::{N_PAPER_TRIALS, PaperTrials, TABLE_4};
use crate::table::{NONE, Table, optional};

/// Arms in the paper's trials.
const N_PAPER_ARMS: usize = 2;

impl Trials {
    /// A table for each task.
    #[must_use]
    pub fn tables(&self) -> Vec<Table> {
        self.groups.chunk_by(|a, b| a.task == b.task).map(task_table).collect()
    }

    /// Every table, ready for a terminal.
    #[must_use]
    pub fn text(&self) -> String {
        self.tables().iter().map(Table::text).collect::<Vec<_>>().join("\n")
    }
}

/// The table of the groups of one task. The paper's rows stand below trials that are like the paper's.
fn task_table(groups: &[TrialGroup]) -> Table {
    let task_name = groups.first().map_or("", |group| &group.task);
    let has_others = groups.iter().any(|group| group.n_failed_by()[CAUSES.len()] > 0);
    let causes: Vec<&str> = CAUSES.into_iter().chain(has_others.then_some(OTHER_CAUSES)).collect();
    let mut header = vec!["subject, mode", "success", "share [95 % interval]"];
    header.extend(&causes);
    header.push("median time");
    let mut table = Table::new(format!("{task_name}: trials, as the paper's Table 4"), &header);
    table.lines.extend(groups.iter().map(|group| line(group, causes.len())));
    let task = Task::ALL.into_iter().find(|task| task.name() == task_name);
    let like_the_papers = groups.iter().any(|group| n_arms(group) == N_PAPER_ARMS);
    for task in task.into_iter().filter(|_| like_the_papers) {
        table.lines.extend(TABLE_4.iter().map(|row| paper_line(row, task, causes.len())));
    }
    table
}

fn line(group: &TrialGroup, n_causes: usize) -> Vec<String> {
    let mut line = vec![group.label()];
    line.extend(success_cells(group.n_successes(), group.rows.len()));
    line.extend(group.n_failed_by().iter().take(n_causes).map(usize::to_string));
    line.push(optional(group.median_duration_s(), |duration_s| format!("{duration_s:.1} s")));
    line
}

fn paper_line(row: &PaperTrials, task: Task, n_causes: usize) -> Vec<String> {
    let mut line = vec![format!("the paper, {}", row.name)];
    line.extend(success_cells(row.n_successes(task), N_PAPER_TRIALS));
    line.extend((0..=n_causes).map(|_| NONE.to_owned()));
    line
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
