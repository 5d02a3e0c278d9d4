//! Groups of runs that differ only in their seed, and statistics over them.

use std::collections::{BTreeMap, BTreeSet};

use tandem_core::{Task, Wilson};
use tandem_telemetry::MetricsRow;
use toml::{Table, Value};

use crate::measures::{LearningMeasures, first_reaching};
use crate::paper::PaperRow;
use crate::quantity::Quantity;
use crate::run::Run;

/// Success rates for which reports give the cost of reaching them.
pub const MILESTONES: [f64; 3] = [0.5, 0.9, 0.95];
/// Settings in which runs of one group may differ, besides the number of recorded episodes. None affects a result.
const FREE_SETTINGS: [&str; 3] = ["name", "seed", "checkpoint"];

/// Number of settings in a label at most.
const MAX_DIFFERENCES: usize = 3;

/// Task and number of arms. Runs with the same task setup share tables. Unknown values sort last.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TaskSetup {
    /// Name of the task.
    pub task: Option<String>,
    /// Number of arms of the policy.
    pub n_arms: Option<u64>,
}

impl TaskSetup {
    fn of(run: &Run, settings: &Table) -> Self {
        let n_arms = settings.get("arms").and_then(Value::as_integer);
        Self { task: run.task(), n_arms: n_arms.and_then(|n| u64::try_from(n).ok()) }
    }

    /// Returns a heading such as "push, 2 arms".
    #[must_use]
    pub fn title(&self) -> String {
        let task = self.task.as_deref().unwrap_or("unknown task");
        match self.n_arms {
            Some(1) => format!("{task}, 1 arm"),
            Some(n_arms) => format!("{task}, {n_arms} arms"),
            None => task.to_owned(),
        }
    }

    /// Returns the built-in task, if it is one.
    #[must_use]
    pub fn built_in(&self) -> Option<Task> {
        self.task.as_ref()?.parse().ok()
    }

    /// Returns a part of a file name, such as "push-2". No name of a task contains `~`, which replaces `/`.
    pub(crate) fn slug(&self) -> String {
        let task = self.task.as_deref().unwrap_or("unknown").replace('/', "~");
        match self.n_arms {
            Some(n_arms) => format!("{task}-{n_arms}"),
            None => task,
        }
    }

    /// Returns the key by which task setups are sorted: the tasks of the paper in its order, then other tasks by name;
    /// two arms before one.
    pub(crate) fn sort_key(&self) -> SortKey {
        let rank = match (&self.task, self.built_in()) {
            (_, Some(task)) => Task::ALL.iter().position(|other| *other == task),
            (Some(_), None) => Some(Task::ALL.len()),
            (None, None) => None,
        };
        let name = self.task.clone();
        (rank.is_none(), rank, name, self.n_arms.is_none(), std::cmp::Reverse(self.n_arms))
    }
}

/// The key by which task setups are sorted.
type SortKey = (bool, Option<usize>, Option<String>, bool, std::cmp::Reverse<Option<u64>>);

/// Runs that differ only in their seed.
#[derive(Debug, Clone, PartialEq)]
pub struct SeedGroup {
    /// Label in tables and legends: the strategy if it identifies the runs, else their common name.
    pub label: String,
    /// Task and number of arms.
    pub setup: TaskSetup,
    /// Advising strategy as on the command line, from the configuration or else from the runs' name.
    pub strategy: Option<String>,
    /// The runs, sorted by seed.
    pub runs: Vec<Run>,
}

/// Groups runs that differ only in their seed.
///
/// Runs with a configuration are compared by it, others by their name without the seed. Groups are sorted by task
/// setup, then by their row in the paper's Table 2, then by label.
#[must_use]
pub fn group_by_settings(runs: Vec<Run>) -> Vec<SeedGroup> {
    let mut keyed: Vec<(String, SeedGroup)> = Vec::new();
    for run in runs {
        let key = settings_key(&run);
        match keyed.iter_mut().find(|(other, _)| *other == key) {
            Some((_, group)) => group.runs.push(run),
            None => keyed.push((key, SeedGroup::of(run))),
        }
    }
    let mut groups: Vec<SeedGroup> = keyed.into_iter().map(|(_, group)| group).collect();
    for group in &mut groups {
        group.runs.sort_by_key(|run| (run.seed(), run.name.clone()));
    }
    groups.sort_by_key(|group| {
        (group.setup.sort_key(), group.paper_index().unwrap_or(usize::MAX), group.label.clone())
    });
    distinguish_labels(&mut groups);
    groups
}

/// Returns a key that is equal for runs that differ only in their seed.
fn settings_key(run: &Run) -> String {
    let settings = compared_settings(run);
    match settings.is_empty() {
        true => format!("named {}", run.stem()),
        false => settings.to_string(),
    }
}

/// Returns the settings in which runs of one group are equal.
fn compared_settings(run: &Run) -> Table {
    let mut settings = run.settings();
    for free in FREE_SETTINGS {
        settings.remove(free);
    }
    // These do not affect training. The intervals show the number of test episodes.
    if let Some(evaluation) = settings.get_mut("evaluation").and_then(Value::as_table_mut) {
        evaluation.remove("recorded_episodes");
        evaluation.remove("test_episodes");
    }
    settings
}

/// Distinguishes equal labels within a task setup by the settings that differ, such as `ea, ddpg.discount=0.9`. Groups
/// without such settings are numbered: `NAME (#2)`.
fn distinguish_labels(groups: &mut [SeedGroup]) {
    let labels: Vec<String> = groups.iter().map(|group| group.label.clone()).collect();
    for idx in 0..groups.len() {
        let is_same = |other: &usize| {
            labels[*other] == labels[idx] && groups[*other].setup == groups[idx].setup
        };
        let same: Vec<usize> = (0..groups.len()).filter(is_same).collect();
        if same.len() > 1 {
            groups[idx].label = format!("{}{}", labels[idx], differences(groups, idx, &same));
        }
    }
    number_duplicate_labels(groups);
}

/// Returns the settings in which group `idx` differs from the groups `same`, as an addition to their label.
fn differences(groups: &[SeedGroup], idx: usize, same: &[usize]) -> String {
    let settings = |idx: usize| -> BTreeMap<String, String> {
        let mut flat = BTreeMap::new();
        if let Some(run) = groups[idx].runs.first() {
            flatten("", &Value::Table(compared_settings(run)), &mut flat);
        }
        flat
    };
    let all: Vec<BTreeMap<String, String>> = same.iter().map(|other| settings(*other)).collect();
    let own = settings(idx);
    let keys: BTreeSet<&String> = all.iter().flat_map(BTreeMap::keys).collect();
    let differs = |key: &&&String| all.iter().any(|other| other.get(**key) != own.get(**key));
    let differing: Vec<&String> = keys.iter().filter(differs).copied().collect();
    let shown = differing.iter().take(MAX_DIFFERENCES).map(|key| {
        let value = own.get(*key).map_or("default", String::as_str);
        format!(", {key}={value}")
    });
    let rest = if differing.len() > MAX_DIFFERENCES { ", …" } else { "" };
    shown.chain([rest.to_owned()]).collect()
}

/// Adds the values of a table with their keys, joined by dots.
fn flatten(prefix: &str, value: &Value, flat: &mut BTreeMap<String, String>) {
    let Value::Table(table) = value else {
        let text = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
        flat.insert(prefix.to_owned(), text);
        return;
    };
    for (key, value) in table {
        let path = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
        flatten(&path, value, flat);
    }
}

/// Numbers equal labels within a task setup from the second on: `NAME (#2)`.
fn number_duplicate_labels(groups: &mut [SeedGroup]) {
    for idx in 1..groups.len() {
        let (before, rest) = groups.split_at_mut(idx);
        let group = &mut rest[0];
        let has_same_label = |other: &&SeedGroup| {
            other.setup == group.setup
                && other.label.split(" (#").next() == Some(group.label.as_str())
        };
        let n_same = before.iter().filter(has_same_label).count();
        if n_same > 0 {
            group.label = format!("{} (#{})", group.label, n_same + 1);
        }
    }
}

impl SeedGroup {
    fn of(run: Run) -> Self {
        let settings = run.settings();
        let setup = TaskSetup::of(&run, &settings);
        let configured = settings
            .get("advice")
            .and_then(|advice| advice.get("strategy"))
            .and_then(Value::as_str)
            .map(str::to_owned);
        let label = label(run.stem(), &setup, configured.as_deref());
        let strategy = configured.or_else(|| strategy_from_name(run.stem()));
        Self { label, setup, strategy, runs: vec![run] }
    }

    /// Returns whether the strategy alone identifies these runs.
    #[must_use]
    pub fn is_plain_strategy(&self) -> bool {
        self.strategy.as_ref() == Some(&self.label)
    }

    /// Returns whether these runs got no advice.
    #[must_use]
    pub fn is_from_scratch(&self) -> bool {
        self.strategy.as_deref() == Some("none")
    }

    /// Returns the row of the paper's Table 2 for these runs, if they have two arms, one of its strategies and no
    /// task that the paper lacks.
    #[must_use]
    pub fn paper(&self) -> Option<&'static PaperRow> {
        let is_student = self.setup.n_arms.is_none_or(|n_arms| n_arms == 2);
        let may_be_of_paper =
            self.setup.task.is_none() || self.setup.built_in().is_some_and(Task::is_in_paper);
        let strategy = self.strategy.as_ref().filter(|_| is_student && may_be_of_paper)?;
        Some(PaperRow::of(strategy)?.1)
    }

    fn paper_index(&self) -> Option<usize> {
        Some(PaperRow::of(self.strategy.as_ref()?)?.0)
    }

    /// Returns the spread of a value over the runs that have one.
    pub fn spread(&self, value: impl Fn(&Run) -> Option<f64>) -> Spread {
        let values: Vec<f64> =
            self.runs.iter().filter_map(value).filter(|value| value.is_finite()).collect();
        Spread::of(&values, self.runs.len())
    }

    /// Returns the spread of one of the paper's measures, see [`LearningMeasures::for_comparison`].
    pub fn measure(&self, measure: impl Fn(&LearningMeasures) -> Option<f64>) -> Spread {
        self.spread(|run| measure(&LearningMeasures::for_comparison(&run.rows)?))
    }

    /// Returns the spread of a value of each run's first evaluation in which `measure` is at least `success`.
    pub fn at_milestone(
        &self,
        (measure, success): (Quantity, f64),
        value: impl Fn(&MetricsRow) -> Option<f64>,
    ) -> Spread {
        self.spread(|run| first_reaching(&run.rows, measure, success).and_then(&value))
    }

    /// Returns whether the evaluations of all runs that have any contain the success without contact.
    pub(crate) fn has_success_without_contact(&self) -> bool {
        let is_known = |row: &MetricsRow| Quantity::SuccessWithoutContact.of(row).is_finite();
        let evaluated = |run: &&Run| !run.rows.is_empty();
        self.runs.iter().filter(evaluated).all(|run| run.rows.iter().any(is_known))
    }

    /// Returns the spread of a share, and its 95 % interval over the episodes of all runs.
    ///
    /// `pick` returns a run's share, in [0, 1], and the number of its episodes.
    pub fn share(&self, pick: impl Fn(&Run) -> Option<(f64, u64)>) -> (Spread, Option<Wilson>) {
        let picked: Vec<(f64, u64)> = self.runs.iter().filter_map(pick).collect();
        let n_episodes: u64 = picked.iter().map(|(_, n)| n).sum();
        let n_hits: u64 = picked.iter().map(|(share, n)| hits(*share, *n)).sum();
        let counts = usize::try_from(n_hits).ok().zip(usize::try_from(n_episodes).ok());
        let interval = counts.filter(|(_, n)| *n > 0).map(|(hits, n)| Wilson::of(hits, n));
        let values: Vec<f64> = picked.iter().map(|(share, _)| *share).collect();
        (Spread::of(&values, self.runs.len()), interval)
    }
}

/// Returns the number of episodes that a share corresponds to.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a share of few episodes, clamped"
)]
fn hits(share: f64, n_episodes: u64) -> u64 {
    (share.clamp(0.0, 1.0) * n_episodes as f64).round() as u64
}

/// Mean and range of a value over the runs that have it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// Number of runs that have the value.
    pub n: usize,
    /// Number of runs of the group.
    pub n_runs: usize,
    /// Mean over the runs that have it; NaN if none has.
    pub mean: f64,
    /// Smallest value; NaN if no run has it.
    pub min: f64,
    /// Largest value; NaN if no run has it.
    pub max: f64,
}

impl Spread {
    /// Computes the spread of `values`, which belong to some of `n_runs` runs.
    #[must_use]
    pub fn of(values: &[f64], n_runs: usize) -> Self {
        Self {
            n: values.len(),
            n_runs,
            mean: values.iter().sum::<f64>() / values.len() as f64,
            min: values.iter().copied().fold(f64::NAN, f64::min),
            max: values.iter().copied().fold(f64::NAN, f64::max),
        }
    }
}

/// Returns the label of a table row: the strategy if it identifies the run, else the run name minus the task of the
/// heading.
fn label(stem: &str, setup: &TaskSetup, strategy: Option<&str>) -> String {
    let task = setup.task.as_deref().unwrap_or_default();
    // Directories have dashes in place of the `/` of a task's name.
    let rest = without_prefix(stem, &task.replace('/', "-"));
    let n_arms = setup.n_arms.map(|n| n.to_string()).unwrap_or_default();
    let shortest = without_prefix(rest, &n_arms);
    match strategy {
        Some(strategy) if shortest == dashed(strategy) || rest == dashed(strategy) => {
            strategy.to_owned()
        }
        _ => rest.to_owned(),
    }
}

/// Removes `prefix-` from `text`, unless nothing would remain.
fn without_prefix<'a>(text: &'a str, prefix: &str) -> &'a str {
    if prefix.is_empty() {
        return text;
    }
    text.strip_prefix(prefix)
        .and_then(|rest| rest.strip_prefix('-'))
        .filter(|rest| !rest.is_empty())
        .unwrap_or(text)
}

/// Returns a strategy as it is written in directory names.
fn dashed(strategy: &str) -> String {
    strategy.replace(':', "-")
}

/// Returns the strategy of the paper's Table 2 with which a run name ends, for runs without a configuration.
fn strategy_from_name(stem: &str) -> Option<String> {
    let strategies = crate::paper::TABLE_2.iter().map(|row| match row.threshold {
        Some(threshold) => format!("{}:{threshold}", row.strategy),
        None => row.strategy.to_owned(),
    });
    let mut matching = strategies.filter(|strategy| {
        stem.strip_suffix(&dashed(strategy)).is_some_and(|rest| rest.ends_with('-'))
    });
    matching.next()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(name: &str, settings: &str, successes: &[f64]) -> Run {
        let row = |(idx, success): (u64, &f64)| MetricsRow {
            round: 50 * idx,
            env_steps: 1000 * idx,
            paper_epochs: idx as f64,
            wall_s: 60.0 * idx as f64,
            success: *success,
            n_episodes: 240,
            ..MetricsRow::default()
        };
        Run {
            name: name.to_owned(),
            rows: (1..).zip(successes).map(row).collect(),
            configuration: (!settings.is_empty()).then(|| settings.to_owned()),
            ..Run::default()
        }
    }

    fn settings(strategy: &str, seed: u64, discount: f64) -> String {
        format!(
            "name = \"run-{seed}\"\ntask = \"push\"\narms = 2\nseed = {seed}\n[advice]\nstrategy = \"{strategy}\"\n\
             [ddpg]\ndiscount = {discount}\n[checkpoint]\nkeep = {seed}\n\
             [evaluation]\nepisodes = 240\nrecorded_episodes = {seed}"
        )
    }

    #[test]
    fn runs_that_differ_only_in_their_seed_form_a_group() {
        let groups = group_by_settings(vec![
            run("push-mc-q-0.1-seed2", &settings("mc-q:0.1", 2, 0.98), &[0.5]),
            run("push-none-seed1", &settings("none", 1, 0.98), &[0.0]),
            run("push-short-sighted-seed1", &settings("mc-q:0.1", 1, 0.9), &[0.5]),
            run("push-mc-q-0.1-seed1", &settings("mc-q:0.1", 1, 0.98), &[0.5]),
        ]);
        let actual: Vec<(&str, Vec<Option<u64>>)> = groups
            .iter()
            .map(|group| (group.label.as_str(), group.runs.iter().map(Run::seed).collect()))
            .collect();
        let expected = [
            ("none", vec![Some(1)]),
            ("mc-q:0.1", vec![Some(1), Some(2)]),
            ("short-sighted", vec![Some(1)]),
        ];
        assert_eq!(actual, expected);
        assert_eq!(groups[1].paper().map(|row| row.name), Some("MC-Q01"));
        assert_eq!(groups[2].paper().map(|row| row.name), Some("MC-Q01"));
    }

    #[test]
    fn metrics_files_are_grouped_by_their_name_without_the_seed() {
        let groups = group_by_settings(vec![
            run("student-push-mc-q-0.1-seed1", "", &[0.5]),
            run("student-push-mc-q-0.1-seed2", "", &[0.5]),
            run("teacher-push-seed1", "", &[0.5]),
        ]);
        let actual: Vec<(&str, usize, Option<&str>)> = groups
            .iter()
            .map(|group| (group.label.as_str(), group.runs.len(), group.strategy.as_deref()))
            .collect();
        assert_eq!(
            actual,
            [("student-push-mc-q-0.1", 2, Some("mc-q:0.1")), ("teacher-push", 1, None)]
        );
    }

    #[test]
    fn groups_with_equal_labels_are_distinguished_by_the_settings_that_differ() {
        let groups = group_by_settings(vec![
            run("push-2-mc-q-0.1-seed1", &settings("mc-q:0.1", 1, 0.9), &[]),
            run("push-2-mc-q-0.1-seed1.2", &settings("mc-q:0.1", 1, 0.95), &[]),
            run("push-2-mc-q-0.1-seed1", &settings("mc-q:0.1", 1, 0.98), &[]),
        ]);
        let labels: Vec<&str> = groups.iter().map(|group| group.label.as_str()).collect();
        let discounts = ["0.9", "0.95", "0.98"];
        assert_eq!(labels, discounts.map(|value| format!("mc-q:0.1, ddpg.discount={value}")));
    }

    #[test]
    fn groups_without_different_settings_are_numbered() {
        let different = |name: &str, copy: u64| {
            run(name, &format!("task = \"push\"\narms = 2\nname = \"{copy}\""), &[])
        };
        let mut groups =
            vec![SeedGroup::of(different("push-2-a", 1)), SeedGroup::of(different("push-2-a", 2))];
        distinguish_labels(&mut groups);
        let labels: Vec<&str> = groups.iter().map(|group| group.label.as_str()).collect();
        assert_eq!(labels, ["2-a", "2-a (#2)"]);
    }

    #[test]
    fn a_milestone_has_mean_range_and_number_of_runs_that_reached_it() {
        let group = group_by_settings(vec![
            run("push-ea-seed1", &settings("ea", 1, 0.98), &[0.0, 0.3, 0.9, 0.96, 0.9]),
            run("push-ea-seed2", &settings("ea", 2, 0.98), &[0.2, 0.5, 0.5, 0.6, 0.5]),
        ])
        .remove(0);
        let fifty = group.at_milestone((Quantity::Success, 0.5), |row| Some(row.env_steps as f64));
        assert_eq!(fifty, Spread { n: 2, n_runs: 2, mean: 2500.0, min: 2000.0, max: 3000.0 });
        let ninety = group.at_milestone((Quantity::Success, 0.9), |row| Some(row.wall_s / 60.0));
        assert_eq!(ninety, Spread { n: 1, n_runs: 2, mean: 3.0, min: 3.0, max: 3.0 });
        assert_eq!(group.at_milestone((Quantity::Success, 0.99), |row| Some(row.wall_s)).n, 0);
        let inspired = group.measure(|measures| measures.inspired_epoch);
        assert_eq!((inspired.mean, inspired.min, inspired.max), (1.5, 1.0, 2.0));
        let rate = group.measure(|measures| measures.learning_rate);
        assert!(
            (rate.max - 0.9 * 0.96 / 3.0).abs() < 1e-12
                && (rate.min - 0.9 * 0.6 / 4.0).abs() < 1e-12
        );
    }

    #[test]
    fn the_interval_of_a_group_covers_the_episodes_of_all_runs() {
        let group = group_by_settings(vec![
            run("push-ea-seed1", &settings("ea", 1, 0.98), &[0.5]),
            run("push-ea-seed2", &settings("ea", 2, 0.98), &[0.75]),
        ])
        .remove(0);
        let (spread, interval) =
            group.share(|run| run.last().map(|row| (row.success, row.n_episodes)));
        assert_eq!((spread.mean, spread.min, spread.max), (0.625, 0.5, 0.75));
        assert_eq!(interval, Some(Wilson::of(120 + 180, 480)));
        assert_eq!(group.share(|_| None).1, None);
    }
}
