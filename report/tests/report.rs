//! Plots and pages are well-formed and complete for any names and numbers.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use tandem_report::{
    Axis, Baseline, Comparison, CurveOptions, CurvePoint, FilmStrip, PlottedTrials, Quantity,
    ReportInputs, Section, Series, TestEvaluation, Trials, curve_svg, report_html, run_report_html,
};
use tandem_telemetry::ContactMetrics;
use tandem_telemetry::{MetricsLog, MetricsRow};

#[path = "support/well_formed.rs"]
pub(crate) mod well_formed;

use well_formed::assert_well_formed;

/// An evaluation in which `n_hits` of 240 episodes succeeded.
fn row(round: u32, n_hits: u8) -> MetricsRow {
    let success = f64::from(n_hits) / 240.0;
    let interval = tandem_core::Wilson::of(usize::from(n_hits), 240);
    MetricsRow {
        round: u64::from(round),
        env_steps: u64::from(round) * 1600,
        wall_s: 60.0 * f64::from(round),
        updates: u64::from(round) * 40,
        paper_epochs: f64::from(round) / 50.0,
        advice_spent: u64::from(round),
        success,
        success_low: interval.low,
        success_high: interval.high,
        success_per_arm: vec![success, success],
        mean_q: -5.0,
        n_episodes: 240,
        ..MetricsRow::default()
    }
}

fn run_dir(rows: &[MetricsRow]) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let (mut log, _) = MetricsLog::restore(&dir.path().join("metrics.jsonl"), &[]).unwrap();
    rows.iter().for_each(|row| log.append(row).unwrap());
    dir
}

#[test]
fn several_curves_have_bands_and_a_legend() {
    let rows = [row(0, 0), row(10, 120), row(20, 216)];
    let series = ["none", "mc-q:0.1 <&>"]
        .map(|name| Series::of(name, &rows, Axis::EnvSteps, Quantity::Success));
    let svg =
        curve_svg(&series, &CurveOptions::of("Two arms push", Quantity::Success, Axis::EnvSteps))
            .unwrap();
    assert_well_formed(&svg);
    assert_eq!(svg.matches("<polygon opacity=\"0.16\"").count(), 2, "a band each");
    for text in [
        "Two arms push",
        "none",
        "mc-q:0.1 &lt;&amp;&gt;",
        "environment steps",
        "success rate",
        "100 %",
        "20k",
    ] {
        assert!(svg.contains(text), "{text}");
    }
}

#[test]
fn a_single_curve_has_no_legend_and_may_be_empty() {
    let point = CurvePoint { x: 1.0, y: -2.0, band: None };
    let check = |points: Vec<CurvePoint>| {
        let series = [Series { name: "hidden".to_owned(), points }];
        let svg = curve_svg(&series, &CurveOptions::of("Mean Q", Quantity::MeanQ, Axis::Updates))
            .unwrap();
        assert_well_formed(&svg);
        assert!(!svg.contains("hidden") && svg.contains("Mean Q") && svg.contains("updates"));
    };
    check(Vec::new());
    check(vec![point]);
    check(vec![point, CurvePoint { x: 2.0, ..point }]);
}

#[test]
fn curves_beyond_the_number_of_colours_are_dashed() {
    let rows = [row(0, 0), row(10, 120)];
    let n_lines = |n: usize| {
        let series: Vec<Series> = (0..n)
            .map(|idx| Series::of(&idx.to_string(), &rows, Axis::EnvSteps, Quantity::Success))
            .collect();
        let options = CurveOptions::of("Success", Quantity::Success, Axis::EnvSteps);
        curve_svg(&series, &options).unwrap().matches("stroke=\"#005FA8\"").count()
    };
    assert!(n_lines(6) < n_lines(7) - 10, "{} {}", n_lines(6), n_lines(7));
}

#[test]
fn curves_can_be_drawn_against_every_axis() {
    let rows = [row(10, 120)];
    let x = |axis| Series::of("", &rows, axis, Quantity::Success).points[0].x;
    assert_eq!(
        [Axis::EnvSteps, Axis::Updates, Axis::Minutes, Axis::PaperEpochs].map(x),
        [16_000.0, 400.0, 10.0, 0.2]
    );
}

#[test]
fn the_page_of_a_run_loads_nothing_from_elsewhere() {
    let dir = run_dir(&[row(0, 0), row(5, 60), row(10, 225)]);
    std::fs::write(dir.path().join("run.toml"), "name = \"<push>\"\n").unwrap();
    let path = run_report_html(dir.path(), &[]).unwrap();
    assert_eq!(path, dir.path().join("report.html"));
    let page = std::fs::read_to_string(path).unwrap();
    assert_eq!(page.matches("<div class=wide><svg").count(), 4);
    let narrow = "<div class=narrow><svg width=\"360\"";
    assert_eq!(page.matches(narrow).count(), 4, "each can be read on a phone too");
    for text in [
        "93.8 %",
        "16,000",
        "Mean Q",
        "Advice spent",
        "Episodes with contact",
        "name = &quot;&lt;push&gt;&quot;",
    ] {
        assert!(page.contains(text), "{text}");
    }
    for reference in ["<script", "<link", "src=\"http", "@import", "url(http"] {
        assert!(!page.contains(reference), "{reference}");
    }
}

#[test]
fn the_page_of_one_arm_without_advice_has_nothing_about_either() {
    let alone = |round, n_hits| MetricsRow {
        advice_spent: 0,
        contacts: ContactMetrics {
            success_without_contact: Some(0.5),
            success_without_contact_low: Some(0.4),
            success_without_contact_high: Some(0.6),
            ..ContactMetrics::default()
        },
        ..row(round, n_hits)
    };
    let dir = run_dir(&[alone(0, 0), alone(5, 60)]);
    std::fs::write(dir.path().join("run.toml"), "task = \"push\"\narms = 1\n").unwrap();
    let page = std::fs::read_to_string(run_report_html(dir.path(), &[]).unwrap()).unwrap();
    for text in ["without contact", "Advice spent", "<span>advice spent"] {
        assert!(!page.contains(text), "{text}");
    }
    assert!(page.contains("tabindex=0 role=region aria-label=\"Evaluations\""));
    std::fs::write(dir.path().join("run.toml"), "task = \"push\"\narms = 2\n").unwrap();
    let page = std::fs::read_to_string(run_report_html(dir.path(), &[]).unwrap()).unwrap();
    assert_eq!(
        page.matches("without contact").count(),
        4,
        "a tile, a column, and the legend in two sizes"
    );
}

#[test]
fn a_run_without_an_evaluation_has_a_page() {
    let dir = run_dir(&[]);
    let page = std::fs::read_to_string(run_report_html(dir.path(), &[]).unwrap()).unwrap();
    assert!(page.contains("No evaluation yet"));
    assert!(run_report_html(Path::new("/nowhere"), &[]).is_err());
}

/// A run directory below `parent` with its configuration and metrics.
fn seed_of(parent: &Path, strategy: &str, seed: u64, rows: &[MetricsRow]) {
    let dir = parent.join(format!("push-{}-seed{seed}", strategy.replace(':', "-")));
    std::fs::create_dir(&dir).unwrap();
    let settings =
        format!("task = \"push\"\narms = 2\nseed = {seed}\n[advice]\nstrategy = \"{strategy}\"\n");
    std::fs::write(dir.join("run.toml"), settings).unwrap();
    let (mut log, _) = MetricsLog::restore(&dir.join("metrics.jsonl"), &[]).unwrap();
    rows.iter().for_each(|row| log.append(row).unwrap());
}

#[test]
fn the_page_of_a_sweep_has_tables_curves_and_the_papers_values() {
    let dir = tempfile::tempdir().unwrap();
    seed_of(dir.path(), "mc-q:0.1", 1, &[row(0, 0), row(5, 120), row(10, 230)]);
    seed_of(dir.path(), "mc-q:0.1", 2, &[row(0, 0), row(5, 60)]);
    seed_of(dir.path(), "none", 1, &[row(0, 0), row(5, 0)]);
    let inputs = ReportInputs::load(&[dir.path().to_owned()]).unwrap();
    let mut comparison = Comparison::of(inputs.runs, Vec::new());
    comparison.films.push(FilmStrip {
        title: "student <1>: success".to_owned(),
        file_name: "student-1-success.png".to_owned(),
        png: b"png".to_vec(),
        picture_px: (480, 300),
    });
    let page = dir.path().join("report.html");
    let written =
        report_html(&comparison, &Trials::default(), PlottedTrials::Failed, &page).unwrap();
    let page = std::fs::read_to_string(&written.page).unwrap();
    let (svgs, pngs) = written.plots.split_at(6);
    assert_eq!(page.matches("<div class=wide><svg").count(), svgs.len());
    assert_eq!(pngs.len(), 7, "four curves of success, mean Q, advice, and a film strip");
    let contains = [
        "MC-ACTABS005",
        "0.9625",
        "push, 2 arms",
        "0.9583",
        "1 of 2",
        "10.1016/j.engappai",
        "data:image/png;base64,cG5n",
        "student &lt;1&gt;: success",
    ];
    for text in contains {
        assert!(page.contains(text), "{text}");
    }
    let first = |text: &str| page.find(text).unwrap_or_else(|| panic!("{text}"));
    assert!(first("<svg") < first("<table") && first("<table") < first("<details"));
    assert_eq!(std::fs::read(&pngs[6]).unwrap(), b"png");
    for (svg, png) in svgs.iter().zip(pngs) {
        assert_eq!(*png, svg.with_extension("png"));
        assert!(std::fs::read(png).unwrap().starts_with(b"\x89PNG"), "{png:?}");
        let svg = std::fs::read_to_string(svg).unwrap();
        assert_well_formed(&svg);
        assert!(svg.contains("mc-q:0.1") && svg.contains("none"));
    }
    let success = std::fs::read_to_string(&written.plots[0]).unwrap();
    assert!(success.contains("<polygon"), "a band over the seeds");
    for reference in ["<script", "<link", "src=\"http", "@import", "url(http"] {
        assert!(!page.contains(reference), "{reference}");
    }
}

#[test]
fn a_report_removes_the_figures_of_an_earlier_one() {
    let dir = tempfile::tempdir().unwrap();
    let (runs, page) = (dir.path().join("runs"), dir.path().join("report.html"));
    std::fs::create_dir(&runs).unwrap();
    let report = || {
        let inputs = ReportInputs::load(std::slice::from_ref(&runs)).unwrap();
        let comparison = Comparison::of(inputs.runs, Vec::new());
        report_html(&comparison, &Trials::default(), PlottedTrials::Failed, &page).unwrap()
    };
    let figures = || -> BTreeSet<PathBuf> {
        let entries = std::fs::read_dir(dir.path().join("report-figures")).unwrap();
        entries.map(|entry| entry.unwrap().path()).collect()
    };
    seed_of(&runs, "mc-q:0.1", 1, &[row(0, 0), row(5, 120)]);
    seed_of(&runs, "mc-q:0.05", 1, &[row(0, 0), row(5, 120)]);
    seed_of(&runs, "none", 1, &[row(0, 0), row(5, 60)]);
    let first = report();
    assert_eq!(figures(), BTreeSet::from_iter(first.plots.clone()));
    let own = dir.path().join("report-figures/own.svg");
    std::fs::write(&own, "").unwrap();
    std::fs::remove_dir_all(runs.join("push-mc-q-0.05-seed1")).unwrap();
    let second = report();
    assert!(second.plots.len() < first.plots.len(), "{:?}", second.plots);
    assert_eq!(figures(), second.plots.into_iter().chain([own]).collect());
}

/// The settings of a run of a task that is not built-in, with one point per arm and episodes of 100 steps.
const DESCRIBED: &str = r#"task = "lab/reach"
arms = 2
seed = 1
[advice]
strategy = "ea"
[description]
name = "lab/reach"
n_observation = 4
n_goal = 4
n_action = 4
achieved_goal = [0, 1, 2, 3]
episode_steps = 100
tolerance = 0.02
norm = "maximum"
observation_bound = [1.0, 1.0, 1.0, 1.0]
goal_bound = [1.0, 1.0, 1.0, 1.0]
[[description.arms]]
observation = [0, 1]
goal = [0, 1]
action = [0, 1]
[[description.arms]]
observation = [2, 3]
goal = [2, 3]
action = [2, 3]
"#;

#[test]
fn a_described_task_has_its_own_section_beside_a_built_in_one() {
    let dir = tempfile::tempdir().unwrap();
    seed_of(dir.path(), "ea", 1, &[row(0, 0), row(5, 120)]);
    let described = dir.path().join("lab-reach-2-ea-seed1");
    std::fs::create_dir(&described).unwrap();
    std::fs::write(described.join("run.toml"), DESCRIBED).unwrap();
    let (mut log, _) = MetricsLog::restore(&described.join("metrics.jsonl"), &[]).unwrap();
    [row(0, 0), row(5, 216)].iter().for_each(|row| log.append(row).unwrap());

    let inputs = ReportInputs::load(&[dir.path().to_owned()]).unwrap();
    assert!(inputs.warnings.is_empty(), "{:?}", inputs.warnings);
    let baseline = Baseline {
        label: "composed".to_owned(),
        test: TestEvaluation {
            task: "lab/reach".to_owned(),
            n_arms: 2,
            n_episodes: 240,
            success: 0.75,
            interval: tandem_core::Wilson { low: 0.69, high: 0.8 },
            success_joint: 0.7,
            success_per_arm: vec![0.85, 0.9],
            collision_rate: None,
            contacts: ContactMetrics::default(),
        },
    };
    let comparison = Comparison::of(inputs.runs, vec![baseline]);
    let titles: Vec<String> =
        comparison.sections.iter().map(|section| section.setup.title()).collect();
    assert_eq!(titles, ["push, 2 arms", "lab/reach, 2 arms"]);
    let [push, reach] = comparison.sections.as_slice() else { panic!("two sections") };
    assert!(push.groups[0].paper().is_some() && reach.groups[0].paper().is_none());
    assert_eq!((reach.groups[0].label.as_str(), reach.baselines.len()), ("ea", 1));
    let success = |section: &Section| section.tables().swap_remove(0);
    let (push, reach) = (success(push), success(reach));
    let contacts = push.header.iter().position(|head| head == "contacts").unwrap();
    assert_eq!(push.rows[0][contacts], "0.000");
    assert!(reach.header.iter().all(|head| !head.contains("contact")), "none reported");
    assert!(comparison.sections[0].tables().iter().any(|table| table.title.contains("Table 2")));
    assert!(comparison.sections[1].tables().iter().all(|table| !table.title.contains("Table 2")));

    let page = dir.path().join("report.html");
    let written =
        report_html(&comparison, &Trials::default(), PlottedTrials::Failed, &page).unwrap();
    let (svgs, pngs) = written.plots.split_at(12);
    assert_eq!(pngs.len(), svgs.len(), "six for each task");
    for svg in svgs {
        let figures = dir.path().join("report-figures");
        assert_eq!(svg.parent(), Some(figures.as_path()), "a task's name makes no directory");
        let name = svg.file_name().unwrap().to_str().unwrap();
        let text = std::fs::read_to_string(svg).unwrap();
        assert_well_formed(&text);
        assert_eq!(text.contains("Figure"), name.starts_with("push") && name.contains("epochs"));
    }
    let csv = tandem_report::export::csv(&comparison);
    assert!(csv.lines().any(|line| line.starts_with("lab/reach,2,ea,ea,lab-reach-2-ea-seed1,1,")));

    check_pages_of_runs(&described, &dir.path().join("push-ea-seed1"));
}

/// Checks the pages of a run of a described task and of one of a built-in task.
fn check_pages_of_runs(described: &Path, push: &Path) {
    let page = std::fs::read_to_string(run_report_html(described, &[]).unwrap()).unwrap();
    assert_eq!(page.matches("<div class=wide><svg").count(), 3, "no curve of contacts");
    assert!(!page.contains("Episodes with contact") && !page.contains("with contact"));
    let line =
        "Task lab/reach: 2 arms, 100 control steps per episode, goals within 0.02 (maximum norm)";
    assert!(page.contains(line), "{page}");
    let page = std::fs::read_to_string(run_report_html(push, &[]).unwrap()).unwrap();
    assert_eq!(page.matches("<div class=wide><svg").count(), 4);
    let line =
        "Task push: 2 arms, 50 control steps per episode, goals within 0.05 m (Euclidean norm)";
    assert!(page.contains(line), "{page}");
}
