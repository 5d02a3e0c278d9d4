//! Comparison of runs: the tables of a report, in one section for each task and number of arms.

use tandem_core::Wilson;

use crate::group::{MILESTONES, SeedGroup, TaskSetup, group_by_settings};
use crate::measures::CostOf;
use crate::quantity::Quantity;
use crate::run::Run;
use crate::table::{NONE, Table, paragraph, share_spread, short_number, spread};
use crate::test_evaluation::TestEvaluation;

mod contents;
mod paper_table;
mod summary;
mod values;

pub use paper_table::paper_table;
use values::{advice_queries, advice_spent, best_success, collision_rate, env_steps};
pub(crate) use values::{
    success_joint, success_per_arm, success_without_contact, test_collision_rate, test_success,
};

/// Runs and baselines, by task and number of arms.
#[derive(Debug, Clone, PartialEq)]
pub struct Comparison {
    /// Sections, push before pick and place and two arms before one.
    pub sections: Vec<Section>,
    /// Film strips of episodes.
    pub films: Vec<FilmStrip>,
    /// One line for each problem that limits what the values mean.
    pub warnings: Vec<String>,
}

/// A film strip of an episode, for the page of a report.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FilmStrip {
    /// Describes the episode.
    pub title: String,
    /// Name of the strip's own file, without a directory: `film-NUMBER-OUTCOME.png`.
    pub file_name: String,
    /// Content of the PNG file.
    pub png: Vec<u8>,
    /// Width and height of each of its pictures, pixels.
    pub picture_px: (usize, usize),
}

/// Explains the paper's measures.
pub const LEGEND: &str = "IE: epochs until success is 10 % of its maximum. RT: epochs from there to 90 % of it. MSR: maximum \
     success. ELR: 90 % of MSR per epoch until it was reached. IE, RT and ELR are – if MSR is below 0.5 or a run has fewer \
     than 5 evaluations. An epoch is `rounds.per_epoch` rounds, 50 by default.";

/// Explains the intervals of groups.
pub const INTERVALS: &str = "95 % intervals: three or more runs have Student's t interval of their mean, within [0, 1]. It \
     includes the variation between seeds, on the same goals. Fewer runs, and runs with equal rates, have Wilson's \
     interval over the episodes of all runs, which does not include it: Student's interval of equal rates has no width, \
     although their mean is not certain. A policy without runs has Wilson's interval, too.";

/// Heads of columns that a table of few contacts lacks.
const WITHOUT_CONTACT: &str = "without contact";
const CONTACTS: &str = "contacts";

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
    /// Compares `runs` with each other and with `baselines`. Copies of a run add to the warnings and are left out.
    #[must_use]
    pub fn of(runs: Vec<Run>, baselines: Vec<Baseline>) -> Self {
        let mut sections: Vec<Section> = Vec::new();
        let mut warnings = Vec::new();
        for mut group in group_by_settings(runs) {
            warnings.extend(group.remove_copies());
            warnings.extend(group.repetition_warning());
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
        Self { sections, films: Vec::new(), warnings }
    }

    /// Formats the tables of all values as Markdown, with an explanation of the intervals if there are runs.
    #[must_use]
    pub fn markdown(&self) -> String {
        let tables = self.sections.iter().flat_map(Section::tables);
        let mut parts: Vec<String> = tables.map(|table| table.markdown()).collect();
        if self.sections.iter().any(|section| !section.groups.is_empty()) {
            parts.push(paragraph(INTERVALS));
        }
        parts.join("\n")
    }

    /// Returns the notes to [`Comparison::text`], for a terminal.
    #[must_use]
    pub fn notes(&self) -> String {
        let notes = "Means over runs, with the number of runs that have the value if some do not. The page has curves, \
             ranges and all intervals.";
        let legend = if self.is_in_paper() { paragraph(LEGEND) } else { String::new() };
        format!("{}{}{legend}", paragraph(notes), paragraph(INTERVALS)).trim_end().to_owned()
    }

    /// Formats the means of all groups for a terminal of 80 columns, and the names of runs without an evaluation.
    #[must_use]
    pub fn text(&self) -> String {
        let sections = self.sections.iter().map(|section| {
            let tables = section.summaries();
            let texts: Vec<String> = tables.iter().map(Table::text).collect();
            let hint = section.hint().map(|hint| format!("\n{}", paragraph(&hint)));
            format!("{}{}", texts.join("\n"), hint.unwrap_or_default())
        });
        sections.collect::<Vec<_>>().join("\n")
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
    /// Returns all values: success, its cost, and the measures of the paper's Table 2, with ranges and intervals.
    #[must_use]
    pub fn tables(&self) -> Vec<Table> {
        let mut tables = vec![self.success()];
        if !self.groups.is_empty() {
            tables.push(self.cost(Quantity::Success));
            if self.has_success_without_contact() {
                tables.push(self.cost(Quantity::SuccessWithoutContact));
            }
            tables.extend(self.is_in_paper().then(|| self.measures()));
        }
        tables
    }

    /// Returns the means: success on test goals first, then its cost and the measures of the paper's Table 2.
    #[must_use]
    pub fn summaries(&self) -> Vec<Table> {
        let mut tables = vec![self.success_summary()];
        if !self.groups.is_empty() {
            tables.push(self.cost_summary());
            tables.extend(self.is_in_paper().then(|| self.measures_summary()));
        }
        tables
    }

    /// Returns a hint for groups without an evaluation, whose rows are empty.
    #[must_use]
    pub fn hint(&self) -> Option<String> {
        let is_empty = |group: &&SeedGroup| group.runs.iter().all(|run| run.rows.is_empty());
        let empty: Vec<&str> =
            self.groups.iter().filter(is_empty).map(|group| group.label.as_str()).collect();
        let names = empty.join("; ");
        (!empty.is_empty()).then(|| {
            format!(
                "No evaluation yet: {names}. A run is evaluated every evaluation.every_env_steps environment steps."
            )
        })
    }

    /// Returns the measures of the paper's Table 2.
    fn measures(&self) -> Table {
        let title =
            format!("{}: measures of the paper's Table 2, in the runs' epochs", self.setup.title());
        let mut table = Table::new(title, &[self.label_head(), "runs", "IE", "RT", "MSR", "ELR"]);
        for group in &self.groups {
            table.rows.push(vec![
                group.label.clone(),
                group.runs.len().to_string(),
                spread(&group.measure(|measures| measures.inspired_epoch), epochs),
                spread(&group.measure(|measures| measures.rising_epochs), epochs),
                spread(&group.measure(|measures| Some(measures.max_success)), four_digits),
                spread(&group.measure(|measures| measures.learning_rate), four_digits),
            ]);
        }
        table
    }

    /// Returns what the runs needed to reach the [`MILESTONES`] of `measure`.
    fn cost(&self, measure: Quantity) -> Table {
        let mut table = Table::new(
            cost_title(self, measure),
            &[
                self.label_head(),
                "env steps to 50 %",
                "90 %",
                "95 %",
                "minutes to 50 %",
                "90 %",
                "95 %",
                "updates to 90 %",
                "advice to 90 %",
                "queries to 90 %",
                "advice in all",
                "queries",
            ],
        );
        for group in &self.groups {
            let at = |success, value: CostOf| group.at_milestone((measure, success), value);
            let at_90 = |value| spread(&at(0.9, value), short_number);
            let mut row = vec![group.label.clone()];
            row.extend(MILESTONES.map(|success| {
                spread(&at(success, |row| Some(row.env_steps as f64)), short_number)
            }));
            row.extend(
                MILESTONES
                    .map(|success| spread(&at(success, |row| Some(row.wall_s / 60.0)), minutes)),
            );
            row.extend([
                at_90(|row| Some(row.updates as f64)),
                at_90(|row| Some(row.advice_spent as f64)),
                at_90(|row| Some(row.advice_queries? as f64)),
                spread(&group.spread(advice_spent), short_number),
                spread(&group.spread(advice_queries), short_number),
            ]);
            table.rows.push(row);
        }
        table
    }

    /// Returns the success, with intervals, of the runs' best policies, on test goals and on the goals that selected
    /// them, and of the last evaluation.
    fn success(&self) -> Table {
        let title = format!("{}: success of the policy alone [95 % interval]", self.setup.title());
        let header = [
            self.label_head(),
            "runs",
            "env steps",
            "test goals",
            WITHOUT_CONTACT,
            "best policy",
            "last evaluation",
            "joint goal",
            CONTACTS,
        ];
        let mut table = Table::new(title, &header);
        for group in &self.groups {
            let last = |run: &Run| run.last().map(|row| (row.success, row.n_episodes));
            table.rows.push(vec![
                group.label.clone(),
                group.runs.len().to_string(),
                spread(&group.spread(env_steps), short_number),
                share_spread(&group.share(test_success)),
                share_spread(&group.share(success_without_contact)),
                share_spread(&group.share(best_success)),
                share_spread(&group.share(last)),
                spread(&group.spread(success_joint), three_digits),
                spread(&group.spread(collision_rate), three_digits),
            ]);
        }
        let reports_contacts = self.reports_contacts();
        let baselines = self.baselines.iter();
        table.rows.extend(baselines.map(|baseline| baseline_row(baseline, reports_contacts)));
        if !self.may_have_arm_contact() {
            table.remove_column(WITHOUT_CONTACT);
        }
        if !reports_contacts {
            table.remove_column(CONTACTS);
        }
        table
    }
}

/// Returns the title of a table of costs.
fn cost_title(section: &Section, measure: Quantity) -> String {
    let of_what = match measure {
        Quantity::SuccessWithoutContact => "success without contact",
        _ => "success",
    };
    format!("{}: cost of reaching a rate of {of_what}", section.setup.title())
}

fn baseline_row(Baseline { label, test }: &Baseline, reports_contacts: bool) -> Vec<String> {
    let Wilson { low, high } = test.interval;
    let none = || NONE.to_owned();
    vec![
        label.clone(),
        none(),
        none(),
        format!("{:.3} [{low:.3}, {high:.3}]", test.success),
        test.contacts.success().map_or_else(none, |(success, Wilson { low, high })| {
            format!("{success:.3} [{low:.3}, {high:.3}]")
        }),
        none(),
        none(),
        three_digits(test.success_joint),
        test.collision_rate.filter(|_| reports_contacts).map_or_else(none, three_digits),
    ]
}

fn range(low: f64, high: f64) -> String {
    format!("{low:.3}–{high:.3}")
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
    use crate::plots::comparison_plots;

    fn run(task: &str, strategy: &str, seed: u64, successes: &[f64]) -> Run {
        let row = |(idx, success): (u64, &f64)| MetricsRow {
            env_steps: 20_000 * idx,
            paper_epochs: 10.0 * idx as f64,
            wall_s: 90.0 * idx as f64,
            success: *success,
            n_episodes: 240,
            advice_spent: 4000 * idx,
            updates: 10_000 * idx,
            ..MetricsRow::default()
        };
        Run {
            name: format!("{task}-{}-seed{seed}", strategy.replace(':', "-")),
            rows: (1..).zip(successes).map(row).collect(),
            configuration: format!(
                "task = \"{task}\"\narms = 2\nseed = {seed}\n[advice]\nstrategy = \"{strategy}\""
            )
            .parse()
            .ok(),
            ..Run::default()
        }
    }

    fn baseline(label: &str, task: Task) -> Baseline {
        let test = TestEvaluation {
            task: task.name().to_owned(),
            n_arms: 2,
            n_episodes: 240,
            success: 0.958,
            interval: Wilson { low: 0.925, high: 0.977 },
            success_joint: 0.908,
            success_per_arm: vec![0.967, 0.971],
            collision_rate: Some(0.175),
            contacts: ContactMetrics::default(),
        };
        Baseline { label: label.to_owned(), test }
    }

    fn cells<'a>(text: &'a str, first: &str) -> Vec<&'a str> {
        let row = text.lines().find(|line| line.split_whitespace().next() == Some(first));
        row.unwrap_or_else(|| panic!("no row {first} in\n{text}")).split_whitespace().collect()
    }

    #[test]
    fn a_row_has_the_values_of_the_runs() {
        let runs = vec![
            run("push", "mc-q:0.1", 1, &[0.0, 0.1, 0.5, 0.9, 0.95]),
            run("push", "mc-q:0.1", 2, &[0.1, 0.5, 0.9, 0.9, 0.85]),
            run("push", "none", 1, &[0.0, 0.0]),
        ];
        let comparison = Comparison::of(runs, Vec::new());
        let section = &comparison.sections[0];
        let row = |table: &Table, strategy: &str| {
            table.rows.iter().find(|row| row[0] == strategy).unwrap()[1..].join("; ")
        };
        assert_eq!(
            row(&section.measures(), "mc-q:0.1"),
            "2; 15.0 (10.0–20.0); 20.0; 0.9250 (0.9000–0.9500); 0.0242 (0.0214–0.0270)"
        );
        assert_eq!(row(&section.measures(), "none"), "1; –; –; 0.0000; –");
        assert_eq!(
            row(&section.cost(Quantity::Success), "mc-q:0.1"),
            "50k (40k–60k); 70k (60k–80k); 100k, 1 of 2; 3.8 (3.0–4.5); 5.2 (4.5–6.0); 7.5, 1 of 2; 35k (30k–40k); \
             14k (12k–16k); –; 20k; –"
        );
        let text = comparison.text();
        assert_eq!(
            cells(&text, "mc-q:0.1")[..],
            ["mc-q:0.1", "2", "–", "–", "–", "0.925"],
            "the success comes first"
        );
        assert!(text.lines().all(|line| line.chars().count() <= 80), "{text}");
        assert!(!text.contains("No evaluation yet"));
    }

    #[test]
    fn a_success_without_contact_has_its_own_cost_and_curve() {
        let mut touching = run("shared-push", "mc-q:0.1", 1, &[0.2, 0.9, 0.95]);
        for (row, share) in touching.rows.iter_mut().zip([0.1, 0.6, 0.92]) {
            row.contacts.success_without_contact = Some(share);
            row.advice_queries = Some(row.advice_spent * 2);
        }
        let comparison = Comparison::of(vec![touching], Vec::new());
        let section = &comparison.sections[0];
        let row = |table: &Table| table.rows[0][1..].join("; ");
        assert_eq!(
            row(&section.cost(Quantity::SuccessWithoutContact)),
            "40k; 60k; –; 3.0; 4.5; –; 30k; 12k; 24k; 12k; 24k"
        );
        let text = comparison.text();
        assert!(text.contains("cost of reaching a rate of success without contact"), "{text}");
        let plots = comparison_plots(&comparison).expect("drawn");
        let names: Vec<&str> = plots.all().map(|plot| plot.file_name.as_str()).collect();
        let name = "shared-push-2-success-without-contact-environment-steps-strategies.svg";
        assert_eq!(names.iter().position(|other| *other == name), Some(1), "{names:?}");
    }

    #[test]
    fn a_run_without_an_evaluation_is_named() {
        let comparison = Comparison::of(vec![run("push", "ea", 1, &[])], Vec::new());
        assert!(comparison.text().contains("No evaluation yet: ea."), "{}", comparison.text());
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
        let row = comparison.sections[0].success().rows.pop().unwrap();
        assert_eq!(
            row,
            [
                "composed-teachers",
                "–",
                "–",
                "0.958 [0.925, 0.977]",
                "–",
                "–",
                "–",
                "0.908",
                "0.175"
            ]
        );
        assert_eq!(
            cells(&comparison.text(), "composed-teachers"),
            ["composed-teachers", "–", "0.958", "0.925–0.977", "–", "–"]
        );
        assert_eq!(comparison.sections[1].baselines.len(), 1);
        assert_eq!(paper_table().rows.len(), 12);
    }
}
