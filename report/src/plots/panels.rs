//! The groups that share a plot.

use crate::group::SeedGroup;
use crate::paper::split_strategy;

use super::MAX_CURVES;

/// Threshold that represents a strategy where strategies are compared (the paper's Figures 5a to 8a).
const USUAL_THRESHOLD: f64 = 0.1;
/// Slug and title of the panel that compares strategies.
pub(super) const STRATEGIES: &str = "strategies";
/// Strategies with a threshold, and the letter of the panel that compares their thresholds.
pub(super) const FAMILIES: [(&str, char); 3] =
    [("mc-q", 'b'), ("mc-act", 'c'), ("mc-act-abs", 'd')];

/// Groups that share a plot.
#[derive(Debug, Clone)]
pub(super) struct Panel<'a> {
    /// Part of the file name.
    pub(super) slug: String,
    /// Part of the title.
    pub(super) title: String,
    /// Letter of this panel in the paper's figures, `a` to `d`, if the paper has it.
    pub(super) letter: Option<char>,
    pub(super) groups: Vec<&'a SeedGroup>,
}

/// Distributes all groups over panels: strategies, thresholds of each strategy, and other runs.
pub(super) fn panels(groups: &[SeedGroup]) -> Vec<Panel<'_>> {
    let plain: Vec<&SeedGroup> = groups.iter().filter(|group| group.is_plain_strategy()).collect();
    let mut panels = Vec::new();
    let strategies: Vec<&SeedGroup> =
        plain.iter().filter(|group| represents_strategy(group, &plain)).copied().collect();
    if !strategies.is_empty() {
        panels.push(Panel {
            slug: STRATEGIES.to_owned(),
            title: STRATEGIES.to_owned(),
            letter: Some('a'),
            groups: strategies,
        });
    }
    for (family, letter) in FAMILIES {
        let members: Vec<&SeedGroup> =
            plain.iter().filter(|group| strategy_name(group) == family).copied().collect();
        if members.len() > 1 {
            panels.push(Panel {
                slug: family.to_owned(),
                title: format!("thresholds of {family}"),
                letter: Some(letter),
                groups: members,
            });
        }
    }
    let is_shown = |group: &&SeedGroup| {
        panels.iter().any(|panel| panel.groups.iter().any(|shown| std::ptr::eq(*shown, *group)))
    };
    let others: Vec<&SeedGroup> = groups.iter().filter(|group| !is_shown(group)).collect();
    let n_further = others.len().div_ceil(MAX_CURVES - 2);
    let further = others.chunks(MAX_CURVES - 2).enumerate().map(|(idx, others)| Panel {
        slug: format!("others-{}", idx + 1),
        title: match n_further {
            1 => "other runs".to_owned(),
            _ => format!("other runs, {} of {n_further}", idx + 1),
        },
        letter: None,
        groups: with_their_strategies(others, &plain),
    });
    panels.extend(further.collect::<Vec<_>>());
    panels
}

/// Returns `others`, preceded by the plain strategies of which they are variants.
fn with_their_strategies<'a>(
    others: &[&'a SeedGroup],
    plain: &[&'a SeedGroup],
) -> Vec<&'a SeedGroup> {
    let is_origin = |group: &&&SeedGroup| {
        others.iter().any(|other| {
            (&other.strategy, &other.setup) == (&group.strategy, &group.setup)
                && !std::ptr::eq(**group, *other)
        })
    };
    plain.iter().filter(is_origin).chain(others).copied().collect()
}

/// Returns true if a group represents its strategy: it has the usual threshold, or the largest if no group has that.
fn represents_strategy(group: &SeedGroup, all: &[&SeedGroup]) -> bool {
    let threshold =
        |group: &SeedGroup| split_strategy(group.strategy.as_deref().unwrap_or_default()).1;
    let Some(own) = threshold(group) else { return true };
    let family: Vec<f64> = all
        .iter()
        .filter(|other| strategy_name(other) == strategy_name(group))
        .filter_map(|other| threshold(other))
        .collect();
    let has_usual = family.contains(&USUAL_THRESHOLD);
    let chosen = if has_usual { USUAL_THRESHOLD } else { family.into_iter().fold(own, f64::max) };
    own == chosen
}

fn strategy_name(group: &SeedGroup) -> &str {
    split_strategy(group.strategy.as_deref().unwrap_or_default()).0
}

#[cfg(test)]
mod tests {
    use super::super::tests::{plain, run};
    use super::*;
    use crate::group::group_by_settings;
    use crate::run::Run;

    #[test]
    fn panels_are_those_of_the_paper_and_show_every_group() {
        let strategies = [
            "none",
            "ea",
            "eamc:0.1",
            "mc-q:0.01",
            "mc-q:0.05",
            "mc-q:0.1",
            "mc-act:0.01",
            "mc-act:0.05",
            "mc-act-abs:0.1",
        ];
        let mut runs: Vec<Run> = strategies.map(plain).into();
        runs.push(run("mc-q:0.1", 1, "no-cloning", &[(1000, 60.0, 0.5)]));
        let groups = group_by_settings(runs);
        let actual: Vec<(String, Option<char>, Vec<&str>)> = panels(&groups)
            .into_iter()
            .map(|panel| {
                let labels = panel.groups.iter().map(|group| group.label.as_str()).collect();
                (panel.slug, panel.letter, labels)
            })
            .collect();
        let expected = [
            (
                "strategies",
                Some('a'),
                vec!["none", "ea", "eamc:0.1", "mc-q:0.1", "mc-act:0.05", "mc-act-abs:0.1"],
            ),
            ("mc-q", Some('b'), vec!["mc-q:0.01", "mc-q:0.05", "mc-q:0.1"]),
            ("mc-act", Some('c'), vec!["mc-act:0.01", "mc-act:0.05"]),
            ("others-1", None, vec!["mc-q:0.1", "no-cloning"]),
        ];
        assert_eq!(
            actual,
            expected.map(|(slug, letter, labels)| (slug.to_owned(), letter, labels))
        );
    }
}
