//! Plots of a comparison: the curves of the paper's Figures 4 to 8 for Tandem's runs, with bands over seeds.

use std::collections::BTreeMap;

use tandem_core::{Task, Wilson};

use crate::comparison::{Baseline, Comparison, Section};
use crate::curve::{Axis, CurveOptions, CurvePoint, Drawing, Series, curve_drawing};
use crate::error::Error;
use crate::group::SeedGroup;
use crate::quantity::Quantity;
use panels::{FAMILIES, STRATEGIES, panels};

mod panels;

/// Maximum number of curves in a plot of other runs, or of learning from scratch.
const MAX_CURVES: usize = 6;

/// A plot and the name of its file.
#[derive(Debug, Clone, PartialEq)]
pub struct Plot {
    /// File name, without a directory.
    pub file_name: String,
    /// Title.
    pub title: String,
    /// The plot as SVG.
    pub svg: String,
    /// The same for narrow screens, as SVG 360 pixels wide.
    pub narrow_svg: String,
}

/// Plots of each panel: name, quantity, axis, and the number of the paper's figure for push and for pick and place.
const VIEWS: [(&str, Quantity, Axis, Option<[u32; 2]>); 7] = [
    ("success", Quantity::Success, Axis::EnvSteps, None),
    ("success without contact", Quantity::SuccessWithoutContact, Axis::EnvSteps, None),
    ("success", Quantity::Success, Axis::Updates, None),
    ("success", Quantity::Success, Axis::Minutes, None),
    ("advice spent", Quantity::AdviceSpent, Axis::EnvSteps, None),
    ("success", Quantity::Success, Axis::PaperEpochs, Some([5, 7])),
    ("mean Q", Quantity::MeanQ, Axis::PaperEpochs, Some([6, 8])),
];
/// End of the slug of a plot of learning from scratch, after the task.
const FROM_SCRATCH: &str = "-from-scratch";
/// Number of [`VIEWS`] that a page shows first.
const N_FIRST_VIEWS: usize = 5;

/// The plots of a comparison.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ComparisonPlots {
    /// The plots of each section, those of the first panel first.
    pub sections: Vec<Vec<Plot>>,
    /// Learning from scratch, with one arm and with two.
    pub from_scratch: Vec<Plot>,
}

impl ComparisonPlots {
    /// Returns all plots.
    pub fn all(&self) -> impl Iterator<Item = &Plot> {
        self.sections.iter().flatten().chain(&self.from_scratch)
    }
}

/// Returns the number of a section's plots that a page shows first.
pub(crate) fn n_first_plots(section: &Section) -> usize {
    VIEWS[..N_FIRST_VIEWS].iter().filter(|(_, quantity, ..)| section.shows(*quantity)).count()
}

/// Draws all plots of a comparison.
///
/// # Errors
/// If the plotting library fails.
pub fn comparison_plots(comparison: &Comparison) -> Result<ComparisonPlots, Error> {
    let sections = comparison.sections.iter().map(section_plots).collect::<Result<_, Error>>()?;
    Ok(ComparisonPlots { sections, from_scratch: from_scratch(comparison)? })
}

/// Draws the plots of one section.
fn section_plots(section: &Section) -> Result<Vec<Plot>, Error> {
    let mut plots = Vec::new();
    let panels = panels(&section.groups);
    for panel in &panels {
        let of_panel = match panels.len() {
            1 => String::new(),
            _ => format!(", {}", panel.title),
        };
        for (name, quantity, axis, paper) in VIEWS {
            if !section.shows(quantity) {
                continue;
            }
            let reference = paper.zip(panel.letter).zip(section.setup.built_in());
            let reference =
                reference.filter(|(_, task)| section.setup.n_arms != Some(1) && task.is_in_paper());
            let reference =
                reference.map_or_else(String::new, |(([push, other], letter), task)| {
                    let number = if task.grasps() { other } else { push };
                    format!(" (the paper's Figure {number}{letter})")
                });
            let (setup, against) = (section.setup.title(), axis.against());
            let title = format!("{setup}: {name} {against}{of_panel}{reference}");
            let slug = format!("{}-{name}-{}-{}", section.setup.slug(), axis.slug(), panel.slug);
            let curves = (panel.groups.as_slice(), section.baselines.as_slice());
            plots.push(draw(curves, &title, &slug, quantity, axis)?);
        }
    }
    Ok(plots)
}

/// Draws learning without advice, with one arm and with two (the paper's Figure 4).
fn from_scratch(comparison: &Comparison) -> Result<Vec<Plot>, Error> {
    let mut plots = Vec::new();
    for (task, letter) in Task::CLASSIC.into_iter().zip(['a', 'b']) {
        let of_task = comparison.sections.iter().filter(|one| one.setup.built_in() == Some(task));
        let groups: Vec<SeedGroup> = of_task
            .flat_map(|section| &section.groups)
            .filter(|group| group.is_from_scratch())
            .map(|group| SeedGroup {
                label: format!("{}, {}", group.label, group.setup.title()),
                ..group.clone()
            })
            .collect();
        let n_one_arm = groups.iter().filter(|group| group.setup.n_arms == Some(1)).count();
        if n_one_arm == 0 {
            continue;
        }
        let shown: Vec<&SeedGroup> = groups.iter().take(MAX_CURVES).collect();
        let title = format!("{task}: success from scratch (the paper's Figure 4{letter})");
        let slug = format!("{task}{FROM_SCRATCH}");
        plots.push(draw((&shown, &[]), &title, &slug, Quantity::Success, Axis::PaperEpochs)?);
    }
    Ok(plots)
}

/// Draws the curves of groups and, for success, lines at the success of baselines.
fn draw(
    (groups, baselines): (&[&SeedGroup], &[Baseline]),
    title: &str,
    slug: &str,
    quantity: Quantity,
    axis: Axis,
) -> Result<Plot, Error> {
    let mut series: Vec<Series> =
        groups.iter().map(|group| series(group, axis, quantity)).collect();
    let xs = series.iter().flat_map(|one| &one.points).map(|point| point.x);
    let x_max = xs.fold(0.0, f64::max);
    if x_max > 0.0 {
        series.extend(baselines.iter().filter_map(|baseline| level(baseline, quantity, x_max)));
    }
    let Drawing { wide, narrow } = curve_drawing(&series, CurveOptions::of(title, quantity, axis))?;
    let file_name = format!("{}.svg", file_stem(slug));
    Ok(Plot { file_name, title: title.to_owned(), svg: wide, narrow_svg: narrow })
}

fn file_stem(slug: &str) -> String {
    slug.to_lowercase().replace(' ', "-")
}

/// Returns true if `stem` is the name of a plot's file without its extension, of this comparison or of another.
pub(crate) fn is_file_stem(stem: &str) -> bool {
    let is_panel = |slug: &str| {
        let n_others = slug.strip_prefix("others-").map(str::parse::<usize>);
        slug == STRATEGIES
            || FAMILIES.iter().any(|one| one.0 == slug)
            || matches!(n_others, Some(Ok(_)))
    };
    let is_view = |(name, _, axis, _): &(&str, Quantity, Axis, _)| {
        let middle = file_stem(&format!("-{name}-{}-", axis.slug()));
        stem.rsplit_once(&middle).is_some_and(|(_, panel)| is_panel(panel))
    };
    let is_from_scratch = |task: &Task| stem == format!("{task}{FROM_SCRATCH}");
    VIEWS.iter().any(is_view) || Task::CLASSIC.iter().any(is_from_scratch)
}

/// Returns the line of a policy that does not learn, with the interval of its evaluation on test goals, if `quantity`
/// is a success.
fn level(Baseline { label, test }: &Baseline, quantity: Quantity, x_max: f64) -> Option<Series> {
    let (success, Wilson { low, high }) = match quantity {
        Quantity::Success => (test.success, test.interval),
        Quantity::SuccessWithoutContact => test.contacts.success()?,
        _ => return None,
    };
    let point = |x| CurvePoint { x, y: success, band: Some((low, high)) };
    Some(Series { name: label.clone(), points: vec![point(0.0), point(x_max)] })
}

/// Returns a group's curve.
///
/// The band of a single run is its 95 % interval. Several runs are drawn as their mean, with a band from the smallest
/// to the largest value. Rows are matched by environment steps; a point covers the runs that have a row there.
///
/// Against wall time, whose mean depends on which runs it covers, a point covers all runs that have not ended before
/// it. After the end of a run, the curve continues with those points of the others that are later than its last one.
fn series(group: &SeedGroup, axis: Axis, quantity: Quantity) -> Series {
    if let [run] = group.runs.as_slice() {
        return Series::of(&group.label, &run.rows, axis, quantity);
    }
    let mut values_at: BTreeMap<u64, Vec<(f64, f64)>> = BTreeMap::new();
    let mut ends = Vec::new();
    for run in &group.runs {
        let values = run.rows.iter().map(|row| (row.env_steps, axis.of(row), quantity.of(row)));
        let values: Vec<_> = values.filter(|(_, x, y)| x.is_finite() && y.is_finite()).collect();
        ends.extend(values.iter().map(|(env_steps, ..)| *env_steps).max());
        for (env_steps, x, y) in values {
            values_at.entry(env_steps).or_default().push((x, y));
        }
    }
    if axis == Axis::Minutes {
        let n_left = |env_steps: &u64| ends.iter().filter(|end| *end >= env_steps).count();
        values_at.retain(|env_steps, values| values.len() >= n_left(env_steps));
    }
    let mut points: Vec<CurvePoint> = values_at.values().map(|values| mean(values)).collect();
    if axis == Axis::Minutes {
        let mut latest = f64::NEG_INFINITY;
        points.retain(|point| {
            let is_later = point.x > latest;
            latest = latest.max(point.x);
            is_later
        });
    }
    Series { name: group.label.clone(), points }
}

/// Returns the mean of points (x, y), with a band from the smallest to the largest y.
fn mean(values: &[(f64, f64)]) -> CurvePoint {
    let n = values.len() as f64;
    let ys = || values.iter().map(|(_, y)| *y);
    CurvePoint {
        x: values.iter().map(|(x, _)| x).sum::<f64>() / n,
        y: ys().sum::<f64>() / n,
        band: Some((ys().fold(f64::INFINITY, f64::min), ys().fold(f64::NEG_INFINITY, f64::max))),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use tandem_telemetry::{ContactMetrics, MetricsRow};

    use crate::group::group_by_settings;
    use crate::run::{Configuration, Run};
    use crate::test_evaluation::TestEvaluation;

    pub(super) fn run(strategy: &str, seed: u64, name: &str, curve: &[(u64, f64, f64)]) -> Run {
        let row = |(env_steps, wall_s, success): &(u64, f64, f64)| MetricsRow {
            env_steps: *env_steps,
            wall_s: *wall_s,
            success: *success,
            mean_q: f64::NAN,
            ..MetricsRow::default()
        };
        Run {
            name: format!("push-{name}-seed{seed}"),
            rows: curve.iter().map(row).collect(),
            configuration: format!(
                "task = \"push\"\narms = 2\nseed = {seed}\ncopy = \"{name}\"\n[advice]\nstrategy = \"{strategy}\""
            )
            .parse()
            .ok(),
            ..Run::default()
        }
    }

    /// Replaces text in a configuration.
    fn replaced(
        configuration: Option<Configuration>,
        from: &str,
        to: &str,
    ) -> Option<Configuration> {
        configuration?.text().replace(from, to).parse().ok()
    }

    pub(super) fn plain(strategy: &str) -> Run {
        run(strategy, 1, &strategy.replace(':', "-"), &[(1000, 60.0, 0.5)])
    }

    #[test]
    fn seeds_become_a_mean_with_a_band() {
        let groups = group_by_settings(vec![
            run("ea", 1, "ea", &[(1000, 60.0, 0.2), (2000, 120.0, 0.6)]),
            run("ea", 2, "ea", &[(1000, 120.0, 0.4), (2000, 240.0, 0.8), (3000, 360.0, 0.9)]),
        ]);
        let drawn = series(&groups[0], Axis::Minutes, Quantity::Success);
        let [first, second, third] = drawn.points[..] else { panic!("{drawn:?}") };
        assert!((first.x - 1.5).abs() < 1e-12 && (first.y - 0.3).abs() < 1e-12, "{first:?}");
        assert_eq!(second.band, Some((0.6, 0.8)));
        assert_eq!((third.x, third.y, third.band), (6.0, 0.9, Some((0.9, 0.9))));
        assert!(series(&groups[0], Axis::EnvSteps, Quantity::MeanQ).points.is_empty());
    }

    #[test]
    fn a_curve_against_wall_time_never_runs_backwards() {
        let xs = |runs: &[&[(u64, f64, f64)]]| -> Vec<f64> {
            let runs = runs.iter().zip(1..).map(|(rows, seed)| run("ea", seed, "ea", rows));
            let groups = group_by_settings(runs.collect());
            let drawn = series(&groups[0], Axis::Minutes, Quantity::Success);
            let xs: Vec<f64> = drawn.points.iter().map(|point| point.x).collect();
            assert!(xs.is_sorted_by(|a, b| a < b), "{xs:?}");
            xs
        };
        let fast = [1, 2, 3, 4, 5].map(|n: u32| (u64::from(n) * 1000, 60.0 * f64::from(n), 0.5));
        let slow = [(1000, 180.0, 0.2), (2000, 360.0, 0.3)];
        assert_eq!(xs(&[&fast, &slow]), [2.0, 4.0, 5.0]);
        // The last row of a run that a time limit ended is at a step of its own.
        let limited = [slow[0], slow[1], (2400, 420.0, 0.4)];
        assert_eq!(xs(&[&limited, &fast]), [2.0, 4.0, 5.0]);
        assert_eq!(xs(&[&[], &fast, &slow[..1]]), [2.0, 3.0, 4.0, 5.0]);
    }

    #[test]
    fn plots_have_unique_names_and_refer_to_the_papers_figures() {
        let runs = vec![plain("none"), plain("mc-q:0.05"), plain("mc-q:0.1")];
        let plots = comparison_plots(&Comparison::of(runs, Vec::new())).unwrap();
        let plots: Vec<&Plot> = plots.all().collect();
        assert_eq!(plots.len(), 10, "none of advice, which the runs did not take");
        assert_eq!(plots[3].file_name, "push-2-success-paper-epochs-strategies.svg");
        assert!(plots[3].title.ends_with("(the paper's Figure 5a)"), "{}", plots[3].title);
        assert!(plots[9].title.ends_with("(the paper's Figure 6b)"), "{}", plots[9].title);
        for text in [|plot: &Plot| plot.file_name.clone(), |plot: &Plot| plot.title.clone()] {
            let unique: BTreeSet<String> = plots.iter().map(|plot| text(plot)).collect();
            assert_eq!(unique.len(), 10, "{unique:?}");
        }
        let stem = |plot: &&Plot| plot.file_name.trim_end_matches(".svg").to_owned();
        assert!(plots.iter().map(stem).all(|stem| is_file_stem(&stem)));
    }

    #[test]
    fn titles_name_a_panel_only_if_there_are_several() {
        let title = |runs| {
            let plots = comparison_plots(&Comparison::of(runs, Vec::new())).unwrap();
            plots.sections[0][0].title.clone()
        };
        let alone = title(vec![plain("none"), plain("mc-q:0.1")]);
        assert_eq!(alone, "push, 2 arms: success against environment steps");
        let several = title(vec![plain("mc-q:0.05"), plain("mc-q:0.1")]);
        assert_eq!(several, "push, 2 arms: success against environment steps, strategies");
    }

    #[test]
    fn a_task_that_the_paper_lacks_has_none_of_its_figures_and_values() {
        let mut bar = plain("mc-q:0.1");
        bar.configuration = replaced(bar.configuration, "\"push\"", "\"carry-bar\"");
        let comparison = Comparison::of(vec![bar], Vec::new());
        assert!(comparison.sections[0].groups[0].paper().is_none());
        let plots = comparison_plots(&comparison).unwrap();
        assert!(plots.all().all(|plot| !plot.title.contains("Figure")));
        let push = Comparison::of(vec![plain("mc-q:0.1")], Vec::new());
        assert!(push.sections[0].groups[0].paper().is_some());
    }

    #[test]
    fn a_baseline_is_a_line_in_plots_of_success() {
        let test = TestEvaluation {
            task: "push".to_owned(),
            n_arms: 2,
            n_episodes: 240,
            success: 0.95,
            interval: Wilson { low: 0.94, high: 0.96 },
            success_joint: 0.9,
            success_per_arm: Vec::new(),
            collision_rate: Some(0.2),
            contacts: ContactMetrics::default(),
        };
        let baseline = Baseline { label: "composed teachers".to_owned(), test };
        let line = level(&baseline, Quantity::Success, 10.0).unwrap();
        assert_eq!(level(&baseline, Quantity::SuccessWithoutContact, 10.0), None);
        assert_eq!(
            line.points.iter().map(|point| (point.x, point.y)).collect::<Vec<_>>(),
            [(0.0, 0.95), (10.0, 0.95)]
        );
        let runs = vec![run("none", 1, "none", &[(10, 1.0, 0.1)])];
        let plots = comparison_plots(&Comparison::of(runs, vec![baseline])).unwrap();
        let shown = plots.all().filter(|plot| plot.svg.contains("composed teachers"));
        let names: Vec<&str> = shown.map(|plot| plot.file_name.as_str()).collect();
        assert!(
            !names.is_empty() && names.iter().all(|name| name.contains("success")),
            "{names:?}"
        );
    }

    #[test]
    fn one_and_two_arms_from_scratch_share_a_plot() {
        let mut one_arm = plain("none");
        one_arm.configuration = replaced(one_arm.configuration, "arms = 2", "arms = 1");
        let comparison = Comparison::of(vec![plain("none"), one_arm], Vec::new());
        let drawn = from_scratch(&comparison).unwrap();
        assert_eq!(drawn.len(), 1);
        assert!(drawn[0].svg.contains("1 arm") && drawn[0].svg.contains("2 arms"));
        let without = Comparison::of(vec![plain("none")], Vec::new());
        assert!(from_scratch(&without).unwrap().is_empty());
    }
}
