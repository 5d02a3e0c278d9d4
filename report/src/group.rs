//! Runs that differ in nothing but their seed, and what they say together.

use tandem_core::{Task, Wilson};
use tandem_telemetry::MetricsRow;
use toml::{Table, Value};

use crate::measures::{LearningMeasures, first_reaching};
use crate::paper::PaperRow;
use crate::run::Run;

/// Successes of which a report tells what it cost to reach them.
pub const MILESTONES: [f64; 3] = [0.5, 0.9, 0.95];
/// Settings in which runs of one group may differ: they decide no result.
const FREE_SETTINGS: [&str; 3] = ["name", "seed", "checkpoint"];

/// What a run's arms do: runs of one subject stand in one table. `None` is unknown, and comes last.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Subject {
    /// The task.
    pub task: Option<Task>,
    /// Arms of the learning policy.
    pub n_arms: Option<u64>,
}

impl Subject {
    fn of(run: &Run, settings: &Table) -> Self {
        let n_arms = settings.get("arms").and_then(Value::as_integer);
        Self { task: run.task(), n_arms: n_arms.and_then(|n| u64::try_from(n).ok()) }
    }

    /// As a heading: "push, 2 arms".
    #[must_use]
    pub fn title(&self) -> String {
        let task = self.task.map_or("unknown task", Task::name);
        match self.n_arms {
            Some(1) => format!("{task}, 1 arm"),
            Some(n_arms) => format!("{task}, {n_arms} arms"),
            None => task.to_owned(),
        }
    }

    /// As part of a file's name: "push-2".
    pub(crate) fn slug(&self) -> String {
        let task = self.task.map_or("unknown", Task::name);
        self.n_arms.map_or_else(|| task.to_owned(), |n_arms| format!("{task}-{n_arms}"))
    }

    pub(crate) fn order(&self) -> (bool, Option<Task>, bool, std::cmp::Reverse<Option<u64>>) {
        (self.task.is_none(), self.task, self.n_arms.is_none(), std::cmp::Reverse(self.n_arms))
    }
}

/// Runs that differ in nothing but their seed.
#[derive(Debug, Clone, PartialEq)]
pub struct Group {
    /// The strategy, or the runs' common name where that says more.
    pub label: String,
    /// What the arms do.
    pub subject: Subject,
    /// Who was asked for advice, and when, as on the command line; by the configuration, or else by the runs' name.
    pub strategy: Option<String>,
    /// The runs, by seed.
    pub runs: Vec<Run>,
}

/// Sorts runs into groups: those with a configuration by it, others by their name without the seed. Groups come in the
/// order of subjects, then of the paper's Table 2, then by label.
#[must_use]
pub fn groups(runs: Vec<Run>) -> Vec<Group> {
    let mut keyed: Vec<(String, Group)> = Vec::new();
    for run in runs {
        let key = key(&run);
        match keyed.iter_mut().find(|(other, _)| *other == key) {
            Some((_, group)) => group.runs.push(run),
            None => keyed.push((key, Group::of(run))),
        }
    }
    let mut groups: Vec<Group> = keyed.into_iter().map(|(_, group)| group).collect();
    for group in &mut groups {
        group.runs.sort_by_key(|run| (run.seed(), run.name.clone()));
    }
    groups.sort_by_key(|group| {
        (group.subject.order(), group.paper_index().unwrap_or(usize::MAX), group.label.clone())
    });
    number_equal_labels(&mut groups);
    groups
}

/// What the runs of a group have in common.
fn key(run: &Run) -> String {
    let mut settings = run.settings();
    if settings.is_empty() {
        return format!("named {}", run.stem());
    }
    for free in FREE_SETTINGS {
        settings.remove(free);
    }
    // These do not affect training; the intervals show how many episodes were tested.
    if let Some(evaluation) = settings.get_mut("evaluation").and_then(Value::as_table_mut) {
        evaluation.remove("recorded_episodes");
        evaluation.remove("test_episodes");
    }
    settings.to_string()
}

/// Two groups of one subject never look the same.
fn number_equal_labels(groups: &mut [Group]) {
    for idx in 1..groups.len() {
        let (before, rest) = groups.split_at_mut(idx);
        let group = &mut rest[0];
        let same = |other: &&Group| {
            other.subject == group.subject
                && other.label.split(" (#").next() == Some(group.label.as_str())
        };
        let n_same = before.iter().filter(same).count();
        if n_same > 0 {
            group.label = format!("{} (#{})", group.label, n_same + 1);
        }
    }
}

impl Group {
    fn of(run: Run) -> Self {
        let settings = run.settings();
        let subject = Subject::of(&run, &settings);
        let configured = settings
            .get("advice")
            .and_then(|advice| advice.get("strategy"))
            .and_then(Value::as_str)
            .map(str::to_owned);
        let label = label(run.stem(), &subject, configured.as_deref());
        let strategy = configured.or_else(|| named_strategy(run.stem()));
        Self { label, subject, strategy, runs: vec![run] }
    }

    /// Whether the label is the strategy and nothing else sets these runs apart.
    #[must_use]
    pub fn is_plain_strategy(&self) -> bool {
        self.strategy.as_ref() == Some(&self.label)
    }

    /// Whether nobody was asked for advice.
    #[must_use]
    pub fn is_from_scratch(&self) -> bool {
        self.strategy.as_deref() == Some("none")
    }

    /// The paper's row for these runs: two arms and a strategy of its Table 2.
    #[must_use]
    pub fn paper(&self) -> Option<&'static PaperRow> {
        let is_student = self.subject.n_arms.is_none_or(|n_arms| n_arms == 2);
        let strategy = self.strategy.as_ref().filter(|_| is_student)?;
        Some(PaperRow::of(strategy)?.1)
    }

    fn paper_index(&self) -> Option<usize> {
        Some(PaperRow::of(self.strategy.as_ref()?)?.0)
    }

    /// A figure of each run, where it has one.
    pub fn spread(&self, figure: impl Fn(&Run) -> Option<f64>) -> Spread {
        let values: Vec<f64> =
            self.runs.iter().filter_map(figure).filter(|value| value.is_finite()).collect();
        Spread::of(&values, self.runs.len())
    }

    /// One of the paper's measures.
    pub fn measure(&self, measure: impl Fn(&LearningMeasures) -> Option<f64>) -> Spread {
        self.spread(|run| {
            measure(&LearningMeasures::of(&run.rows)).filter(|_| !run.rows.is_empty())
        })
    }

    /// Something of the evaluation that first reached `success`.
    pub fn at_milestone(&self, success: f64, figure: impl Fn(&MetricsRow) -> f64) -> Spread {
        self.spread(|run| first_reaching(&run.rows, success).map(&figure))
    }

    /// A share that `pick` finds in each run, with the 95 % interval of all their episodes together.
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

/// The whole number of episodes that a share stands for.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a share of few episodes, clamped"
)]
fn hits(share: f64, n_episodes: u64) -> u64 {
    (share.clamp(0.0, 1.0) * n_episodes as f64).round() as u64
}

/// Mean and range of a figure over the runs that have it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// Runs that have the figure.
    pub n: usize,
    /// Runs of the group.
    pub n_runs: usize,
    /// Its mean over those that have it; NaN where none has.
    pub mean: f64,
    /// The smallest; NaN where none has it.
    pub min: f64,
    /// The largest; NaN where none has it.
    pub max: f64,
}

impl Spread {
    /// The spread of `values`, those of `n_runs` runs that have one.
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

/// The strategy where the name says no more than it, else the name without what the table's heading says.
fn label(stem: &str, subject: &Subject, strategy: Option<&str>) -> String {
    let task = subject.task.map_or("", Task::name);
    let rest = without_prefix(stem, task);
    let n_arms = subject.n_arms.map(|n| n.to_string()).unwrap_or_default();
    let shortest = without_prefix(rest, &n_arms);
    match strategy {
        Some(strategy) if shortest == dashed(strategy) || rest == dashed(strategy) => {
            strategy.to_owned()
        }
        _ => rest.to_owned(),
    }
}

/// `text` without `prefix-`; whole where there would be nothing left.
fn without_prefix<'a>(text: &'a str, prefix: &str) -> &'a str {
    if prefix.is_empty() {
        return text;
    }
    text.strip_prefix(prefix)
        .and_then(|rest| rest.strip_prefix('-'))
        .filter(|rest| !rest.is_empty())
        .unwrap_or(text)
}

/// A strategy as it stands in the name of a directory.
fn dashed(strategy: &str) -> String {
    strategy.replace(':', "-")
}

/// The strategy of the paper's table with which a name ends; for files that stand by themselves.
fn named_strategy(stem: &str) -> Option<String> {
    let written = crate::paper::TABLE_2.iter().map(|row| match row.threshold {
        Some(threshold) => format!("{}:{threshold}", row.strategy),
        None => row.strategy.to_owned(),
    });
    let mut ending = written.filter(|strategy| {
        stem.strip_suffix(&dashed(strategy)).is_some_and(|rest| rest.ends_with('-'))
    });
    ending.next()
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
            held_out: None,
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
        let groups = groups(vec![
            run("push-mc-q-0.1-seed2", &settings("mc-q:0.1", 2, 0.98), &[0.5]),
            run("push-none-seed1", &settings("none", 1, 0.98), &[0.0]),
            run("push-short-sighted-seed1", &settings("mc-q:0.1", 1, 0.9), &[0.5]),
            run("push-mc-q-0.1-seed1", &settings("mc-q:0.1", 1, 0.98), &[0.5]),
        ]);
        let seen: Vec<(&str, Vec<Option<u64>>)> = groups
            .iter()
            .map(|group| (group.label.as_str(), group.runs.iter().map(Run::seed).collect()))
            .collect();
        let expected = [
            ("none", vec![Some(1)]),
            ("mc-q:0.1", vec![Some(1), Some(2)]),
            ("short-sighted", vec![Some(1)]),
        ];
        assert_eq!(seen, expected);
        assert_eq!(groups[1].paper().map(|row| row.name), Some("MC-Q01"));
        assert_eq!(groups[2].paper().map(|row| row.name), Some("MC-Q01"));
    }

    #[test]
    fn bare_metrics_are_grouped_by_their_name_without_the_seed() {
        let groups = groups(vec![
            run("student-push-mc-q-0.1-seed1", "", &[0.5]),
            run("student-push-mc-q-0.1-seed2", "", &[0.5]),
            run("teacher-push-seed1", "", &[0.5]),
        ]);
        let seen: Vec<(&str, usize, Option<&str>)> = groups
            .iter()
            .map(|group| (group.label.as_str(), group.runs.len(), group.strategy.as_deref()))
            .collect();
        assert_eq!(
            seen,
            [("student-push-mc-q-0.1", 2, Some("mc-q:0.1")), ("teacher-push", 1, None)]
        );
    }

    #[test]
    fn groups_of_one_name_are_told_apart() {
        let groups = groups(vec![
            run("push-2-mc-q-0.1-seed1", &settings("mc-q:0.1", 1, 0.9), &[]),
            run("push-2-mc-q-0.1-seed1", &settings("mc-q:0.1", 1, 0.95), &[]),
            run("push-2-mc-q-0.1-seed1", &settings("mc-q:0.1", 1, 0.98), &[]),
        ]);
        let labels: Vec<&str> = groups.iter().map(|group| group.label.as_str()).collect();
        assert_eq!(labels, ["mc-q:0.1", "mc-q:0.1 (#2)", "mc-q:0.1 (#3)"]);
    }

    #[test]
    fn seeds_give_mean_and_range_and_say_how_many_got_there() {
        let group = groups(vec![
            run("push-ea-seed1", &settings("ea", 1, 0.98), &[0.0, 0.3, 0.9, 0.96]),
            run("push-ea-seed2", &settings("ea", 2, 0.98), &[0.2, 0.5, 0.5, 0.6]),
        ])
        .remove(0);
        let fifty = group.at_milestone(0.5, |row| row.env_steps as f64);
        assert_eq!(fifty, Spread { n: 2, n_runs: 2, mean: 2500.0, min: 2000.0, max: 3000.0 });
        let ninety = group.at_milestone(0.9, |row| row.wall_s / 60.0);
        assert_eq!(ninety, Spread { n: 1, n_runs: 2, mean: 3.0, min: 3.0, max: 3.0 });
        assert_eq!(group.at_milestone(0.99, |row| row.wall_s).n, 0);
        let inspired = group.measure(|measures| measures.inspired_epoch);
        assert_eq!((inspired.mean, inspired.min, inspired.max), (1.5, 1.0, 2.0));
        let rate = group.measure(|measures| measures.learning_rate);
        assert!(
            (rate.max - 0.9 * 0.96 / 3.0).abs() < 1e-12
                && (rate.min - 0.9 * 0.6 / 4.0).abs() < 1e-12
        );
    }

    #[test]
    fn the_interval_of_a_group_is_that_of_all_its_episodes() {
        let group = groups(vec![
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
