//! Runs side by side: the tables of a report, one section for each task and number of arms.

use crate::group::{Group, MILESTONES, Subject, groups};
use crate::held_out::HeldOut;
use crate::paper::{PaperRow, TABLE_2};
use crate::run::Run;
use crate::table::{NONE, Table, optional, share_spread, short_number, spread};

/// Runs side by side.
#[derive(Debug, Clone, PartialEq)]
pub struct Comparison {
    /// Push before pick and place, two arms before one.
    pub sections: Vec<Section>,
}

/// The runs of one task and number of arms.
#[derive(Debug, Clone, PartialEq)]
pub struct Section {
    /// What the arms do.
    pub subject: Subject,
    /// Runs that differ only in their seed, together.
    pub groups: Vec<Group>,
    /// Policies that were not trained by these runs: composed teachers, for one.
    pub baselines: Vec<Baseline>,
}

/// A policy to compare with, measured by `tandem eval`.
#[derive(Debug, Clone, PartialEq)]
pub struct Baseline {
    /// Its name in the table.
    pub label: String,
    /// What it reached.
    pub held_out: HeldOut,
}

impl Comparison {
    /// Sets `runs` and `baselines` side by side.
    #[must_use]
    pub fn of(runs: Vec<Run>, baselines: Vec<Baseline>) -> Self {
        let mut sections: Vec<Section> = Vec::new();
        for group in groups(runs) {
            match sections.iter_mut().find(|section| section.subject == group.subject) {
                Some(section) => section.groups.push(group),
                None => sections.push(Section {
                    subject: group.subject,
                    groups: vec![group],
                    baselines: Vec::new(),
                }),
            }
        }
        for baseline in baselines {
            place(&mut sections, baseline);
        }
        sections.sort_by_key(|section| section.subject.order());
        Self { sections }
    }

    /// Every table, ready for a terminal.
    #[must_use]
    pub fn text(&self) -> String {
        let tables = self.sections.iter().flat_map(Section::tables);
        tables.map(|table| table.text()).collect::<Vec<_>>().join("\n")
    }
}

/// Puts a baseline where its like are: runs of which the number of arms is unknown will do.
fn place(sections: &mut Vec<Section>, baseline: Baseline) {
    let HeldOut { task, n_arms, .. } = baseline.held_out;
    let subject = Subject { task: Some(task), n_arms: Some(n_arms as u64) };
    let unknown = Subject { n_arms: None, ..subject };
    let at = |subject| sections.iter().position(|section: &Section| section.subject == subject);
    match at(subject).or_else(|| at(unknown)) {
        Some(idx) => sections[idx].baselines.push(baseline),
        None => {
            sections.push(Section { subject, groups: Vec::new(), baselines: vec![baseline] });
        }
    }
}

impl Section {
    /// The paper's measures, what success cost, and success itself.
    #[must_use]
    pub fn tables(&self) -> Vec<Table> {
        let mut tables = Vec::new();
        if !self.groups.is_empty() {
            tables.extend([self.measures(), self.cost()]);
        }
        tables.push(self.success());
        tables
    }

    /// The paper's Table 2 for these runs; the paper's values beside ours where it has a row for the strategy.
    fn measures(&self) -> Table {
        let has_paper = self.groups.iter().any(|group| group.paper().is_some());
        let mut header = vec!["strategy", "runs", "IE", "RT", "MSR", "ELR"];
        if has_paper {
            header.extend(["paper", "IE", "RT", "MSR", "ELR"]);
        }
        let title = format!(
            "{}: measures of the paper's Table 2, epochs of 50 rounds",
            self.subject.title()
        );
        let mut table = Table::new(title, &header);
        for group in &self.groups {
            let mut line = vec![group.label.clone(), group.runs.len().to_string()];
            line.extend([
                spread(&group.measure(|measures| measures.inspired_epoch), epochs),
                spread(&group.measure(|measures| measures.rising_epochs), epochs),
                spread(&group.measure(|measures| Some(measures.max_success)), four_digits),
                spread(&group.measure(|measures| measures.learning_rate), four_digits),
            ]);
            if has_paper {
                line.extend(self.paper_cells(group.paper()));
            }
            table.lines.push(line);
        }
        table
    }

    fn paper_cells(&self, row: Option<&PaperRow>) -> [String; 5] {
        let Some((row, task)) = row.zip(self.subject.task) else {
            return std::array::from_fn(|_| NONE.to_owned());
        };
        paper_line(row, row.measures(task))
    }

    /// Environment steps and minutes to successes worth naming.
    fn cost(&self) -> Table {
        let title = format!("{}: cost of a success in an evaluation", self.subject.title());
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
            let mut line = vec![group.label.clone()];
            line.extend(MILESTONES.map(|success| {
                spread(&group.at_milestone(success, |row| row.env_steps as f64), short_number)
            }));
            line.extend(MILESTONES.map(|success| {
                spread(&group.at_milestone(success, |row| row.wall_s / 60.0), minutes)
            }));
            let advice = |run: &Run| Some(run.last()?.advice_spent as f64);
            line.push(spread(&group.spread(advice), short_number));
            table.lines.push(line);
        }
        table
    }

    /// Success with its intervals: the last and the best evaluation, and the best policy on held-out goals.
    fn success(&self) -> Table {
        let title =
            format!("{}: success of the policy alone [95 % interval]", self.subject.title());
        let header =
            ["strategy", "env steps", "last", "best", "held-out goals", "joint norm", "contacts"];
        let mut table = Table::new(title, &header);
        for group in &self.groups {
            let env_steps = |run: &Run| Some(run.last()?.env_steps as f64);
            let last = |run: &Run| run.last().map(|row| (row.success, row.n_episodes));
            let best = |run: &Run| run.best().map(|row| (row.success, row.n_episodes));
            let held_out = |run: &Run| {
                Some((run.held_out.as_ref()?.success, run.held_out.as_ref()?.n_episodes))
            };
            table.lines.push(vec![
                group.label.clone(),
                spread(&group.spread(env_steps), short_number),
                share_spread(&group.share(last)),
                share_spread(&group.share(best)),
                share_spread(&group.share(held_out)),
                spread(&group.spread(joint), three_digits),
                spread(&group.spread(contacts), three_digits),
            ]);
        }
        table.lines.extend(self.baselines.iter().map(baseline_line));
        table
    }
}

/// Share by the joint norm: of the held-out evaluation, or else of the last.
fn joint(run: &Run) -> Option<f64> {
    let held_out = run.held_out.as_ref().map(|held_out| held_out.success_joint);
    held_out.or_else(|| run.last().map(|row| row.success_joint))
}

/// Share of episodes with a contact: of the held-out evaluation, or else of the last.
fn contacts(run: &Run) -> Option<f64> {
    let held_out = run.held_out.as_ref().map(|held_out| held_out.collision_rate);
    held_out.or_else(|| run.last().map(|row| row.collision_rate))
}

fn baseline_line(Baseline { label, held_out }: &Baseline) -> Vec<String> {
    let (low, high) = held_out.interval;
    let none = || NONE.to_owned();
    vec![
        label.clone(),
        none(),
        none(),
        none(),
        format!("{:.3} [{low:.3}, {high:.3}]", held_out.success),
        three_digits(held_out.success_joint),
        three_digits(held_out.collision_rate),
    ]
}

/// The paper's Table 2 as the paper prints it.
#[must_use]
pub fn paper_table() -> Table {
    let header =
        ["strategy", "push: IE", "RT", "MSR", "ELR", "pick and place: IE", "RT", "MSR", "ELR"];
    let mut table = Table::new("the paper's Table 2".to_owned(), &header);
    table.lines.extend(TABLE_2.iter().map(|row| {
        let [name, push @ ..] = paper_line(row, &row.push);
        let [_, pick_and_place @ ..] = paper_line(row, &row.pick_and_place);
        std::iter::once(name).chain(push).chain(pick_and_place).collect()
    }));
    table
}

fn paper_line(row: &PaperRow, measures: &crate::paper::PaperMeasures) -> [String; 5] {
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
    use tandem_telemetry::MetricsRow;

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
            held_out: None,
        }
    }

    fn baseline(label: &str, task: Task) -> Baseline {
        let held_out = HeldOut {
            task,
            n_arms: 2,
            n_episodes: 240,
            success: 0.958,
            interval: (0.925, 0.977),
            success_joint: 0.908,
            collision_rate: 0.175,
        };
        Baseline { label: label.to_owned(), held_out }
    }

    fn line<'a>(text: &'a str, first: &str) -> Vec<&'a str> {
        let line = text.lines().find(|line| line.split_whitespace().next() == Some(first));
        line.unwrap_or_else(|| panic!("no line {first} in\n{text}")).split_whitespace().collect()
    }

    #[test]
    fn ours_and_the_papers_values_stand_on_one_line() {
        let runs = vec![
            run("push", "mc-q:0.1", 1, &[0.0, 0.1, 0.5, 0.9, 0.95]),
            run("push", "mc-q:0.1", 2, &[0.1, 0.5, 0.9, 0.9, 0.85]),
            run("push", "none", 1, &[0.0, 0.0]),
        ];
        let comparison = Comparison::of(runs, Vec::new());
        let measures = comparison.sections[0].measures().text();
        assert_eq!(
            line(&measures, "mc-q:0.1")[..],
            "mc-q:0.1 2 15.0 (10.0–20.0) 20.0 (20.0–20.0) 0.9250 (0.9000–0.9500) 0.0242 (0.0214–0.0270) \
             MC-Q01 63 229 0.9583 0.0030"
                .split_whitespace()
                .collect::<Vec<_>>()
        );
        assert_eq!(
            line(&measures, "none"),
            ["none", "1", "–", "–", "0.0000", "–", "NA", "–", "–", "0.0000", "0.0000"]
        );
        let cost = comparison.sections[0].cost().text();
        assert_eq!(
            line(&cost, "mc-q:0.1")[..],
            "mc-q:0.1 50k (40k–60k) 70k (60k–80k) 100k, 1 of 2 3.8 (3.0–4.5) 5.2 (4.5–6.0) 7.5, 1 of 2 20k (20k–20k)"
                .split_whitespace()
                .collect::<Vec<_>>()
        );
    }

    #[test]
    fn baselines_stand_with_the_runs_of_their_task() {
        let runs = vec![run("pick-and-place", "ea", 1, &[0.5]), run("push", "ea", 1, &[0.5])];
        let baselines =
            vec![baseline("composed-teachers", Task::Push), baseline("others", Task::PickAndPlace)];
        let comparison = Comparison::of(runs, baselines);
        let titles: Vec<String> =
            comparison.sections.iter().map(|section| section.subject.title()).collect();
        assert_eq!(titles, ["push, 2 arms", "pick-and-place, 2 arms"]);
        let success = comparison.sections[0].success().text();
        assert_eq!(
            line(&success, "composed-teachers"),
            ["composed-teachers", "–", "–", "–", "0.958", "[0.925,", "0.977]", "0.908", "0.175"]
        );
        assert_eq!(comparison.sections[1].baselines.len(), 1);
        assert_eq!(paper_table().lines.len(), 12);
    }
}
