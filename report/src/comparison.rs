//! Comparison of runs: the tables of a report, in one section for each task and number of arms.

use crate::group::{MILESTONES, SeedGroup, TaskSetup, group_by_settings};
use crate::paper::{PaperRow, TABLE_2};
use crate::run::Run;
use crate::table::{NONE, Table, optional, share_spread, short_number, spread};
use crate::test_evaluation::TestEvaluation;

/// Runs and baselines, by task and number of arms.
#[derive(Debug, Clone, PartialEq)]
pub struct Comparison {
    /// Sections, push before pick and place and two arms before one.
    pub sections: Vec<Section>,
}

/// The runs of one task and number of arms.
#[derive(Debug, Clone, PartialEq)]
pub struct Section {
    /// Task and number of arms.
    pub setup: TaskSetup,
    /// Groups of runs that differ only in their seed.
    pub groups: Vec<SeedGroup>,
    /// Policies that these runs did not train, such as composed teachers.
    pub baselines: Vec<Baseline>,
}

/// A policy that no run of the report trained, with its evaluation.
#[derive(Debug, Clone, PartialEq)]
pub struct Baseline {
    /// Name in the table.
    pub label: String,
    /// Evaluation on test goals.
    pub test: TestEvaluation,
}

impl Comparison {
    /// Compares `runs` with each other and with `baselines`.
    #[must_use]
    pub fn of(runs: Vec<Run>, baselines: Vec<Baseline>) -> Self {
        let mut sections: Vec<Section> = Vec::new();
        for group in group_by_settings(runs) {
            match sections.iter_mut().find(|section| section.setup == group.setup) {
                Some(section) => section.groups.push(group),
                None => sections.push(Section {
                    setup: group.setup.clone(),
                    groups: vec![group],
                    baselines: Vec::new(),
                }),
            }
        }
        for baseline in baselines {
            add_baseline(&mut sections, baseline);
        }
        sections.sort_by_key(|section| section.setup.sort_key());
        Self { sections }
    }

    /// Formats all tables for a terminal.
    #[must_use]
    pub fn text(&self) -> String {
        let tables = self.sections.iter().flat_map(Section::tables);
        tables.map(|table| table.text()).collect::<Vec<_>>().join("\n")
    }
}

/// Adds a baseline to the section of its task and number of arms, or else to runs of its task with an unknown number.
fn add_baseline(sections: &mut Vec<Section>, baseline: Baseline) {
    let TestEvaluation { task, n_arms, .. } = &baseline.test;
    let setup = TaskSetup { task: Some(task.clone()), n_arms: Some(*n_arms as u64) };
    let unknown = TaskSetup { n_arms: None, ..setup.clone() };
    let index =
        |setup: &TaskSetup| sections.iter().position(|section: &Section| section.setup == *setup);
    match index(&setup).or_else(|| index(&unknown)) {
        Some(idx) => sections[idx].baselines.push(baseline),
        None => {
            sections.push(Section { setup, groups: Vec::new(), baselines: vec![baseline] });
        }
    }
}

impl Section {
    /// Returns the tables of the paper's measures, of the cost of success, and of success itself.
    #[must_use]
    pub fn tables(&self) -> Vec<Table> {
        let mut tables = Vec::new();
        if !self.groups.is_empty() {
            tables.extend([self.measures(), self.cost()]);
        }
        tables.push(self.success());
        tables
    }

    /// Returns the measures of the paper's Table 2, beside the paper's own values for strategies that it has.
    fn measures(&self) -> Table {
        let has_paper = self.groups.iter().any(|group| group.paper().is_some());
        let mut header = vec!["strategy", "runs", "IE", "RT", "MSR", "ELR"];
        if has_paper {
            header.extend(["paper", "IE", "RT", "MSR", "ELR"]);
        }
        let title =
            format!("{}: measures of the paper's Table 2, epochs of 50 rounds", self.setup.title());
        let mut table = Table::new(title, &header);
        for group in &self.groups {
            let mut row = vec![group.label.clone(), group.runs.len().to_string()];
            row.extend([
                spread(&group.measure(|measures| measures.inspired_epoch), epochs),
                spread(&group.measure(|measures| measures.rising_epochs), epochs),
                spread(&group.measure(|measures| Some(measures.max_success)), four_digits),
                spread(&group.measure(|measures| measures.learning_rate), four_digits),
            ]);
            if has_paper {
                row.extend(self.paper_cells(group.paper()));
            }
            table.rows.push(row);
        }
        table
    }

    fn paper_cells(&self, row: Option<&PaperRow>) -> [String; 5] {
        let Some((row, task)) = row.zip(self.setup.built_in()) else {
            return std::array::from_fn(|_| NONE.to_owned());
        };
        paper_row(row, row.measures(task))
    }

    /// Returns the environment steps, minutes and advice that the runs needed to reach the [`MILESTONES`].
    fn cost(&self) -> Table {
        let title = format!("{}: cost of a success in an evaluation", self.setup.title());
        let mut table = Table::new(
            title,
            &[
                "strategy",
                "env steps to 50 %",
                "90 %",
                "95 %",
                "minutes to 50 %",
                "90 %",
                "95 %",
                "advice spent",
            ],
        );
        for group in &self.groups {
            let mut row = vec![group.label.clone()];
            row.extend(MILESTONES.map(|success| {
                spread(&group.at_milestone(success, |row| row.env_steps as f64), short_number)
            }));
            row.extend(MILESTONES.map(|success| {
                spread(&group.at_milestone(success, |row| row.wall_s / 60.0), minutes)
            }));
            let advice = |run: &Run| Some(run.last()?.advice_spent as f64);
            row.push(spread(&group.spread(advice), short_number));
            table.rows.push(row);
        }
        table
    }

    /// Returns the success, with intervals, of the last and the best evaluation and of the best policy on test goals.
    fn success(&self) -> Table {
        let title = format!("{}: success of the policy alone [95 % interval]", self.setup.title());
        let header = [
            "strategy",
            "env steps",
            "last",
            "best",
            "test goals",
            "without arm contact",
            "joint norm",
            "contacts",
        ];
        let mut table = Table::new(title, &header);
        for group in &self.groups {
            let env_steps = |run: &Run| Some(run.last()?.env_steps as f64);
            let last = |run: &Run| run.last().map(|row| (row.success, row.n_episodes));
            let best = |run: &Run| run.best().map(|row| (row.success, row.n_episodes));
            let test = |run: &Run| run.test.as_ref().map(|test| (test.success, test.n_episodes));
            table.rows.push(vec![
                group.label.clone(),
                spread(&group.spread(env_steps), short_number),
                share_spread(&group.share(last)),
                share_spread(&group.share(best)),
                share_spread(&group.share(test)),
                share_spread(&group.share(success_without_contact)),
                spread(&group.spread(success_joint), three_digits),
                spread(&group.spread(collision_rate), three_digits),
            ]);
        }
        table.rows.extend(self.baselines.iter().map(baseline_row));
        table
    }
}

/// Returns the success by the joint norm, on test goals or else of the last evaluation.
fn success_joint(run: &Run) -> Option<f64> {
    let test = run.test.as_ref().map(|test| test.success_joint);
    test.or_else(|| run.last().map(|row| row.success_joint))
}

/// Returns the success without contact between the arms on test goals, and their number, if it is known.
pub(crate) fn success_without_contact(run: &Run) -> Option<(f64, u64)> {
    let test = run.test.as_ref()?;
    Some((test.contacts.success_without_contact?, test.n_episodes))
}

/// Returns the share of episodes with a contact, on test goals or else of the last evaluation.
///
/// A task that reports no contacts has no such share.
fn collision_rate(run: &Run) -> Option<f64> {
    if !run.reports_contacts() {
        return None;
    }
    let test = run.test.as_ref().map(|test| test.collision_rate);
    test.or_else(|| run.last().map(|row| row.collision_rate))
}

fn baseline_row(Baseline { label, test }: &Baseline) -> Vec<String> {
    let (low, high) = test.interval;
    let none = || NONE.to_owned();
    vec![
        label.clone(),
        none(),
        none(),
        none(),
        format!("{:.3} [{low:.3}, {high:.3}]", test.success),
        test.contacts.success().map_or_else(none, |[success, low, high]| {
            format!("{success:.3} [{low:.3}, {high:.3}]")
        }),
        three_digits(test.success_joint),
        three_digits(test.collision_rate),
    ]
}

/// Returns the paper's Table 2 with the paper's values.
#[must_use]
pub fn paper_table() -> Table {
    let header =
        ["strategy", "push: IE", "RT", "MSR", "ELR", "pick and place: IE", "RT", "MSR", "ELR"];
    let mut table = Table::new("the paper's Table 2".to_owned(), &header);
    table.rows.extend(TABLE_2.iter().map(|row| {
        let [name, push @ ..] = paper_row(row, &row.push);
        let [_, pick_and_place @ ..] = paper_row(row, &row.pick_and_place);
        std::iter::once(name).chain(push).chain(pick_and_place).collect()
    }));
    table
}

fn paper_row(row: &PaperRow, measures: &crate::paper::PaperMeasures) -> [String; 5] {
    let whole = |epochs: f64| format!("{epochs:.0}");
    [
        row.name.to_owned(),
        optional(measures.inspired_epoch, whole),
        optional(measures.rising_epochs, whole),
        four_digits(measures.max_success),
        four_digits(measures.learning_rate),
    ]
}

fn epochs(epochs: f64) -> String {
    format!("{epochs:.1}")
}

fn minutes(minutes: f64) -> String {
    format!("{minutes:.1}")
}

fn three_digits(share: f64) -> String {
    format!("{share:.3}")
}

fn four_digits(share: f64) -> String {
    format!("{share:.4}")
}

#[cfg(test)]
mod tests {
    use tandem_core::Task;
    use tandem_telemetry::{ContactMetrics, MetricsRow};

    use super::*;

    fn run(task: &str, strategy: &str, seed: u64, successes: &[f64]) -> Run {
        let row = |(idx, success): (u64, &f64)| MetricsRow {
            env_steps: 20_000 * idx,
            paper_epochs: 10.0 * idx as f64,
            wall_s: 90.0 * idx as f64,
            success: *success,
            n_episodes: 240,
            advice_spent: 4000 * idx,
            ..MetricsRow::default()
        };
        Run {
            name: format!("{task}-{}-seed{seed}", strategy.replace(':', "-")),
            rows: (1..).zip(successes).map(row).collect(),
            configuration: Some(format!(
                "task = \"{task}\"\narms = 2\nseed = {seed}\n[advice]\nstrategy = \"{strategy}\""
            )),
            test: None,
        }
    }

    fn baseline(label: &str, task: Task) -> Baseline {
        let test = TestEvaluation {
            task: task.name().to_owned(),
            n_arms: 2,
            n_episodes: 240,
            success: 0.958,
            interval: (0.925, 0.977),
            success_joint: 0.908,
            collision_rate: 0.175,
            contacts: ContactMetrics::default(),
        };
        Baseline { label: label.to_owned(), test }
    }

    fn cells<'a>(text: &'a str, first: &str) -> Vec<&'a str> {
        let row = text.lines().find(|line| line.split_whitespace().next() == Some(first));
        row.unwrap_or_else(|| panic!("no row {first} in\n{text}")).split_whitespace().collect()
    }

    #[test]
    fn a_row_has_the_values_of_the_runs_and_of_the_paper() {
        let runs = vec![
            run("push", "mc-q:0.1", 1, &[0.0, 0.1, 0.5, 0.9, 0.95]),
            run("push", "mc-q:0.1", 2, &[0.1, 0.5, 0.9, 0.9, 0.85]),
            run("push", "none", 1, &[0.0, 0.0]),
        ];
        let comparison = Comparison::of(runs, Vec::new());
        let measures = comparison.sections[0].measures().text();
        assert_eq!(
            cells(&measures, "mc-q:0.1")[..],
            "mc-q:0.1 2 15.0 (10.0–20.0) 20.0 (20.0–20.0) 0.9250 (0.9000–0.9500) 0.0242 (0.0214–0.0270) \
             MC-Q01 63 229 0.9583 0.0030"
                .split_whitespace()
                .collect::<Vec<_>>()
        );
        assert_eq!(
            cells(&measures, "none"),
            ["none", "1", "–", "–", "0.0000", "–", "NA", "–", "–", "0.0000", "0.0000"]
        );
        let cost = comparison.sections[0].cost().text();
        assert_eq!(
            cells(&cost, "mc-q:0.1")[..],
            "mc-q:0.1 50k (40k–60k) 70k (60k–80k) 100k, 1 of 2 3.8 (3.0–4.5) 5.2 (4.5–6.0) 7.5, 1 of 2 20k (20k–20k)"
                .split_whitespace()
                .collect::<Vec<_>>()
        );
    }

    #[test]
    fn a_baseline_is_added_to_the_section_of_its_task() {
        let runs = vec![run("pick-and-place", "ea", 1, &[0.5]), run("push", "ea", 1, &[0.5])];
        let baselines =
            vec![baseline("composed-teachers", Task::Push), baseline("others", Task::PickAndPlace)];
        let comparison = Comparison::of(runs, baselines);
        let titles: Vec<String> =
            comparison.sections.iter().map(|section| section.setup.title()).collect();
        assert_eq!(titles, ["push, 2 arms", "pick-and-place, 2 arms"]);
        let success = comparison.sections[0].success().text();
        assert_eq!(
            cells(&success, "composed-teachers"),
            [
                "composed-teachers",
                "–",
                "–",
                "–",
                "0.958",
                "[0.925,",
                "0.977]",
                "–",
                "0.908",
                "0.175"
            ]
        );
        assert_eq!(comparison.sections[1].baselines.len(), 1);
        assert_eq!(paper_table().rows.len(), 12);
    }
}
