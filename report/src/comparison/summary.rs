//! The tables of means, which fit into a terminal.

use super::{
    Baseline, Section, advice_spent, best_success, cost_title, env_steps, epochs, four_digits,
    minutes, range, success_without_contact, test_success, three_digits,
};
use crate::group::MILESTONES;
use crate::measures::CostOf;
use crate::quantity::Quantity;
use crate::table::{NONE, Table, mean, optional, short_number};

/// Head of the column of success without contact between the arms.
const NO_CONTACT: &str = "no contact";

impl Section {
    /// Returns the success on test goals with its interval, and that of the runs' best policies, on the goals that
    /// selected them.
    pub(super) fn success_summary(&self) -> Table {
        let title = format!("{}: success of the policy alone, on test goals", self.setup.title());
        let (label, success) = (self.label_head(), "success");
        let header = [label, "runs", success, "95 % interval", NO_CONTACT, "best policy"];
        let mut table = Table::new(title, &header);
        for group in &self.groups {
            let test = group.share(test_success);
            let interval = test.shown_interval().map(|(low, high)| range(low, high));
            table.rows.push(vec![
                group.label.clone(),
                group.runs.len().to_string(),
                mean(&test.values, three_digits),
                interval.unwrap_or_else(|| NONE.to_owned()),
                mean(&group.share(success_without_contact).values, three_digits),
                mean(&group.share(best_success).values, three_digits),
            ]);
        }
        table.rows.extend(self.baselines.iter().map(|Baseline { label, test }| {
            let without_contact = test.contacts.success_without_contact;
            vec![
                label.clone(),
                NONE.to_owned(),
                three_digits(test.success),
                range(test.interval.low, test.interval.high),
                optional(without_contact, three_digits),
                NONE.to_owned(),
            ]
        }));
        if !self.may_have_arm_contact() {
            table.remove_column(NO_CONTACT);
        }
        table
    }

    /// Returns the mean cost of a success, or of one without contact if all runs have evaluated that.
    pub(super) fn cost_summary(&self) -> Table {
        let measure = match self.has_success_without_contact() {
            true => Quantity::SuccessWithoutContact,
            false => Quantity::Success,
        };
        let title = cost_title(self, measure);
        let header =
            [self.label_head(), "steps to 50 %", "90 %", "95 %", "min to 90 %", "advice", "steps"];
        let mut table = Table::new(title, &header);
        for group in &self.groups {
            let at = |success, value: CostOf| group.at_milestone((measure, success), value);
            let mut row = vec![group.label.clone()];
            row.extend(
                MILESTONES
                    .map(|success| mean(&at(success, |row| Some(row.env_steps as f64)), rounded)),
            );
            row.push(mean(&at(0.9, |row| Some(row.wall_s / 60.0)), minutes));
            row.push(mean(&group.spread(advice_spent), rounded));
            row.push(mean(&group.spread(env_steps), rounded));
            table.rows.push(row);
        }
        table
    }

    /// Returns the means of the paper's measures.
    pub(super) fn measures_summary(&self) -> Table {
        let title = format!("{}: measures of the paper's Table 2", self.setup.title());
        let mut table = Table::new(title, &[self.label_head(), "IE", "RT", "MSR", "ELR"]);
        for group in &self.groups {
            table.rows.push(vec![
                group.label.clone(),
                mean(&group.measure(|measures| measures.inspired_epoch), epochs),
                mean(&group.measure(|measures| measures.rising_epochs), epochs),
                mean(&group.measure(|measures| Some(measures.max_success)), three_digits),
                mean(&group.measure(|measures| measures.learning_rate), four_digits),
            ]);
        }
        table
    }
}

/// Formats a mean count: 33,333 as 33.3k, and counts below 10,000 to one.
fn rounded(count: f64) -> String {
    let unit = if count < 10_000.0 { 1.0 } else { 100.0 };
    short_number(unit * (count / unit).round())
}

#[cfg(test)]
mod tests {
    use tandem_core::Wilson;
    use tandem_telemetry::{ContactMetrics, MetricsRow};

    use crate::comparison::{Comparison, INTERVALS};
    use crate::run::Run;
    use crate::table::paragraph;
    use crate::test_evaluation::TestEvaluation;

    /// Compares runs of one strategy with these rates of success on 240 test goals.
    fn compared(successes: &[f64]) -> Comparison {
        let run = |(seed, success): (u64, &f64)| Run {
            name: format!("push-ea-seed{seed}"),
            rows: vec![MetricsRow { env_steps: 100, n_episodes: 240, ..MetricsRow::default() }],
            configuration: format!(
                "task = \"push\"\narms = 2\nseed = {seed}\n[advice]\nstrategy = \"ea\""
            )
            .parse()
            .ok(),
            test: Some(TestEvaluation {
                task: "push".to_owned(),
                n_arms: 2,
                n_episodes: 240,
                success: *success,
                interval: Wilson { low: 0.0, high: 1.0 },
                success_joint: *success,
                success_per_arm: Vec::new(),
                collision_rate: Some(0.0),
                contacts: ContactMetrics::default(),
            }),
            ..Run::default()
        };
        Comparison::of((1..).zip(successes).map(run).collect(), Vec::new())
    }

    #[test]
    fn the_interval_is_over_seeds_if_there_are_three_that_differ() {
        let check = |successes: &[f64], cell: &str, low: f64, high: f64| {
            let comparison = compared(successes);
            let (text, markdown) = (comparison.text(), comparison.markdown());
            let line = text.lines().find(|line| line.starts_with("ea ")).unwrap();
            assert!(line.contains(&format!("  {low:.3}–{high:.3}")), "{text}");
            let n = successes.len();
            let row = format!("| ea | {n} | 100 | {cell} [{low:.3}, {high:.3}] |");
            assert!(markdown.contains(&row), "{row}\n{markdown}");
            assert!(markdown.ends_with(&format!("\n\n{}", paragraph(INTERVALS))), "{markdown}");
            assert!(comparison.notes().contains(paragraph(INTERVALS).trim_end()));
        };
        let over_episodes = |n_hits: usize, n: usize| {
            let Wilson { low, high } = Wilson::of(n_hits, n);
            (low, high)
        };
        let (low, high) = over_episodes(300, 480);
        check(&[0.5, 0.75], "0.625 (0.500–0.750)", low, high);
        check(&[0.4, 0.5, 0.6], "0.500 (0.400–0.600)", 0.2516, 0.7484);
        let (low, high) = over_episodes(360, 720);
        check(&[0.5; 3], "0.500", low, high);
    }
}
