//! The tables and columns of a section.

use super::{Comparison, Section};
use crate::group::SeedGroup;
use crate::quantity::Quantity;
use crate::run::Run;

impl Section {
    /// Returns the head of the first column, which has the labels of the groups.
    pub(super) fn label_head(&self) -> &'static str {
        match self.groups.as_slice() {
            [] => "policy",
            groups if groups.iter().all(is_labelled_by_strategy) => "strategy",
            groups if groups.iter().all(|group| group.runs.len() == 1) => "run",
            _ => "group",
        }
    }

    /// Returns true if the task may have contacts between arms: it reports contacts and has several arms. True if the
    /// task is unknown.
    pub(super) fn may_have_arm_contact(&self) -> bool {
        self.setup.n_arms != Some(1) && self.reports_contacts()
    }

    /// Returns true if all runs have evaluated the success without contact between the arms, of which there are several.
    pub(crate) fn has_success_without_contact(&self) -> bool {
        self.may_have_arm_contact()
            && self.groups.iter().all(SeedGroup::has_success_without_contact)
    }

    /// Returns true if the task reports contacts or is unknown.
    pub(crate) fn reports_contacts(&self) -> bool {
        self.groups.iter().flat_map(|group| &group.runs).all(Run::reports_contacts)
    }

    /// Returns true if plots of this metric show something: advice is that of runs that took some.
    pub(crate) fn shows(&self, quantity: Quantity) -> bool {
        match quantity {
            Quantity::SuccessWithoutContact => self.has_success_without_contact(),
            Quantity::AdviceSpent => {
                self.groups.iter().flat_map(|group| &group.runs).any(Run::took_advice)
            }
            _ => true,
        }
    }

    /// Returns true if the paper has the task or the task is unknown.
    pub(crate) fn is_in_paper(&self) -> bool {
        let built_in = self.setup.built_in();
        self.setup.task.is_none() || built_in.is_some_and(tandem_core::Task::is_in_paper)
    }
}

impl Comparison {
    /// Returns true if the paper has one of the tasks.
    pub(crate) fn is_in_paper(&self) -> bool {
        self.sections.iter().any(Section::is_in_paper)
    }
}

/// Returns true if the label of a group is its strategy, with the settings in which it differs from others.
fn is_labelled_by_strategy(group: &SeedGroup) -> bool {
    let after = group.strategy.as_deref().and_then(|strategy| group.label.strip_prefix(strategy));
    after.is_some_and(|rest| rest.is_empty() || rest.starts_with([',', ' ']))
}

#[cfg(test)]
mod tests {
    use tandem_telemetry::MetricsRow;

    use super::*;

    fn text(task: &str, n_arms: u64, names: &[&str]) -> String {
        let run = |name: &&str| Run {
            name: (*name).to_owned(),
            rows: vec![MetricsRow { env_steps: 100, n_episodes: 8, ..MetricsRow::default() }],
            configuration: format!(
                "task = {task:?}\narms = {n_arms}\nlabel = {:?}\n[advice]\nstrategy = \"ea\"",
                name.split("-seed").next().unwrap_or_default()
            )
            .parse()
            .ok(),
            ..Run::default()
        };
        let comparison = Comparison::of(names.iter().map(run).collect(), Vec::new());
        format!("{}{}", comparison.text(), comparison.notes())
    }

    fn first_heads(text: &str) -> Vec<&str> {
        let heads = text.lines().filter(|line| line.contains("  runs  ") || line.contains("  IE "));
        heads.filter_map(|line| line.split_whitespace().next()).collect()
    }

    #[test]
    fn the_first_column_is_headed_by_what_it_shows() {
        assert_eq!(first_heads(&text("push", 2, &["push-ea"])), ["strategy", "strategy"]);
        assert_eq!(first_heads(&text("push", 2, &["push-ea", "mine"])), ["run", "run"]);
        assert_eq!(first_heads(&text("push", 2, &["mine", "yours"])), ["run", "run"]);
        let names = ["push-ea", "mine-seed1", "mine-seed2"];
        assert_eq!(first_heads(&text("push", 2, &names)), ["group", "group"]);
    }

    #[test]
    fn one_arm_has_no_column_of_contacts_between_arms() {
        assert!(text("push", 2, &["push-ea"]).contains("no contact"));
        assert!(!text("push", 1, &["push-ea"]).contains("no contact"));
    }

    #[test]
    fn only_tasks_of_the_paper_have_its_measures_and_their_legend() {
        let (of_paper, other) = (text("shared-push", 2, &["a"]), text("carry-bar", 2, &["a"]));
        for part in ["measures of the paper's Table 2", "MSR: maximum"] {
            assert!(of_paper.contains(part) && !other.contains(part), "{part}: {other}");
        }
    }
}
