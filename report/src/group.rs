//! Groups of runs that differ only in their seed, and statistics over them.

mod labels;

use std::collections::{BTreeMap, BTreeSet};

use tandem_core::Task;
use tandem_telemetry::MetricsRow;
use toml::{Table, Value};

use crate::measures::{LearningMeasures, first_reaching};
use crate::paper::PaperRow;
use crate::quantity::Quantity;
use crate::run::Run;
use crate::spread::{ShareSpread, Spread};

/// Success rates for which reports give the cost of reaching them.
pub const MILESTONES: [f64; 3] = [0.5, 0.9, 0.95];
/// Settings in which runs of one group may differ, besides the number of recorded episodes. None affects a result.
const FREE_SETTINGS: [&str; 3] = ["name", "seed", "checkpoint"];

/// Task and number of arms. Runs with the same task setup share tables. Unknown values sort last.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TaskSetup {
    /// Name of the task.
    pub task: Option<String>,
    /// Number of arms of the policy.
    pub n_arms: Option<u64>,
}

impl TaskSetup {
    fn of(run: &Run) -> Self {
        let n_arms = run.setting("arms").and_then(Value::as_integer);
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
    labels::distinguish(&mut groups);
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

/// Returns the settings in which runs of one group are equal, among them the digest of the teacher. Empty if they are
/// unknown.
fn compared_settings(run: &Run) -> Table {
    let mut settings = run.settings_with_teacher();
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

impl SeedGroup {
    fn of(run: Run) -> Self {
        let setup = TaskSetup::of(&run);
        let configured = run
            .setting("advice")
            .and_then(|advice| advice.get("strategy"))
            .and_then(Value::as_str)
            .map(str::to_owned);
        let label = labels::label(run.stem(), &setup, configured.as_deref());
        let strategy = configured.or_else(|| labels::strategy_from_name(run.stem()));
        Self { label, setup, strategy, runs: vec![run] }
    }

    /// Returns true if the strategy alone identifies these runs.
    #[must_use]
    pub fn is_plain_strategy(&self) -> bool {
        self.strategy.as_ref() == Some(&self.label)
    }

    /// Returns true if these runs got no advice.
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

    /// Removes runs that have the digest of another, and returns a warning about each: a copy of a run, or its repetition
    /// with the same bits, is no further seed.
    pub(crate) fn remove_copies(&mut self) -> Vec<String> {
        let (title, label) = (self.setup.title(), self.label.clone());
        let mut counted: BTreeMap<String, String> = BTreeMap::new();
        let mut warnings = Vec::new();
        self.runs.retain(|run| {
            let Some(digest) = &run.digest else { return true };
            let original = counted.get(digest).cloned();
            match &original {
                Some(original) => warnings.push(format!(
                    "{title}, {label}: {} has the settings and the digest of {original} and is not counted",
                    run.name
                )),
                None => drop(counted.insert(digest.clone(), run.name.clone())),
            }
            original.is_none()
        });
        warnings
    }

    /// Returns a warning if some runs have the same seed.
    pub(crate) fn repetition_warning(&self) -> Option<String> {
        let seeds: Vec<u64> = self.runs.iter().filter_map(Run::seed).collect();
        let n_repeated = seeds.len() - seeds.iter().collect::<BTreeSet<_>>().len();
        (n_repeated > 0).then(|| {
            format!(
                "{}, {}: {n_repeated} of {} runs repeat the seed of another; all are counted, so the interval is too narrow",
                self.setup.title(),
                self.label,
                self.runs.len()
            )
        })
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

    /// Returns true if the evaluations of all runs that have any contain the success without contact.
    pub(crate) fn has_success_without_contact(&self) -> bool {
        let is_known = |row: &MetricsRow| Quantity::SuccessWithoutContact.of(row).is_finite();
        let evaluated = |run: &&Run| !run.rows.is_empty();
        self.runs.iter().filter(evaluated).all(|run| run.rows.iter().any(is_known))
    }

    /// Returns the spread of a share, with its 95 % intervals.
    ///
    /// `pick` returns a run's share, in [0, 1], and the number of its episodes.
    pub fn share(&self, pick: impl Fn(&Run) -> Option<(f64, u64)>) -> ShareSpread {
        let picked: Vec<(f64, u64)> = self.runs.iter().filter_map(pick).collect();
        ShareSpread::of(&picked, self.runs.len())
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::Wilson;

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
            configuration: settings.parse().ok(),
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
        let share = group.share(|run| run.last().map(|row| (row.success, row.n_episodes)));
        let Spread { mean, min, max, .. } = share.values;
        assert_eq!((mean, min, max), (0.625, 0.5, 0.75));
        assert_eq!(share.pooled, Some(Wilson::of(120 + 180, 480)));
        assert_eq!(group.share(|_| None).pooled, None);
    }

    #[test]
    fn a_copy_of_a_run_is_left_out_and_a_repeated_seed_is_reported() {
        let with_digest = |name: &str, seed: u64, discount: f64, digest: &str| Run {
            digest: Some(digest.to_owned()),
            ..run(name, &settings("ea", seed, discount), &[0.5])
        };
        let of = |last: Run| {
            let (one, two) =
                (with_digest("a-seed1", 1, 0.98, "d1"), with_digest("b-seed2", 2, 0.98, "d2"));
            let mut groups = group_by_settings(vec![one, two, last]);
            let copies: Vec<String> =
                groups.iter_mut().flat_map(SeedGroup::remove_copies).collect();
            (groups, copies)
        };
        let (copied, warnings) = of(with_digest("copy", 1, 0.98, "d1"));
        let names: Vec<&str> = copied[0].runs.iter().map(|run| run.name.as_str()).collect();
        assert_eq!(names, ["a-seed1", "b-seed2"]);
        let expected = "copy has the settings and the digest of a-seed1 and is not counted";
        assert!(warnings.len() == 1 && warnings[0].ends_with(expected), "{warnings:?}");
        assert_eq!(copied[0].repetition_warning(), None);
        let (repeated, warnings) = of(with_digest("longer", 1, 0.98, "d3"));
        assert_eq!((repeated[0].runs.len(), warnings.len()), (3, 0));
        let warning = repeated[0].repetition_warning().unwrap();
        assert!(warning.contains("1 of 3 runs repeat the seed of another"), "{warning}");
        // Runs with other settings may end in the same state, such as strategies that never ask.
        let (others, warnings) = of(with_digest("other", 1, 0.9, "d1"));
        assert_eq!((others.len(), warnings.len()), (2, 0));
    }
}
