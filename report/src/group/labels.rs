//! Labels of groups, in tables and legends.

use std::collections::{BTreeMap, BTreeSet};

use toml::Value;

use super::{SeedGroup, TaskSetup, compared_settings};

/// Number of settings in a label at most.
const MAX_DIFFERENCES: usize = 3;

/// Distinguishes equal labels within a task setup by the settings that differ, such as `ea, ddpg.discount=0.9`. Groups
/// without such settings are numbered: `NAME (#2)`.
pub(super) fn distinguish(groups: &mut [SeedGroup]) {
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

/// Returns the label of a table row: the strategy if it identifies the run, else the run name minus the task of the
/// heading.
pub(super) fn label(stem: &str, setup: &TaskSetup, strategy: Option<&str>) -> String {
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
pub(super) fn strategy_from_name(stem: &str) -> Option<String> {
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
    use crate::group::group_by_settings;
    use crate::run::Run;

    fn run(name: &str, configuration: &str) -> Run {
        Run { name: name.to_owned(), configuration: configuration.parse().ok(), ..Run::default() }
    }

    #[test]
    fn groups_with_equal_labels_are_distinguished_by_the_settings_that_differ() {
        let settings = |discount: f64| {
            format!(
                "task = \"push\"\narms = 2\nseed = 1\n[advice]\nstrategy = \"mc-q:0.1\"\n\
                 [ddpg]\ndiscount = {discount}"
            )
        };
        let groups = group_by_settings(vec![
            run("push-2-mc-q-0.1-seed1", &settings(0.9)),
            run("push-2-mc-q-0.1-seed1.2", &settings(0.95)),
            run("push-2-mc-q-0.1-seed1", &settings(0.98)),
        ]);
        let labels: Vec<&str> = groups.iter().map(|group| group.label.as_str()).collect();
        let discounts = ["0.9", "0.95", "0.98"];
        assert_eq!(labels, discounts.map(|value| format!("mc-q:0.1, ddpg.discount={value}")));
    }

    #[test]
    fn groups_without_different_settings_are_numbered() {
        let different = |name: &str, copy: u64| {
            run(name, &format!("task = \"push\"\narms = 2\nname = \"{copy}\""))
        };
        let mut groups =
            vec![SeedGroup::of(different("push-2-a", 1)), SeedGroup::of(different("push-2-a", 2))];
        distinguish(&mut groups);
        let labels: Vec<&str> = groups.iter().map(|group| group.label.as_str()).collect();
        assert_eq!(labels, ["2-a", "2-a (#2)"]);
    }
}
