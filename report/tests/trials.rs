//! Reports on trials: tables, plots, pages and JSON.

use tandem_report::{Comparison, PlottedTrials, Trials, report_html, trial_svg, trials};
use tandem_telemetry::{ToolPathPoint, TrialRow};

use crate::report_tests::well_formed::assert_well_formed;

/// A trial of push with two arms. Paths have a point per centimetre; the planned ones end after two thirds.
fn row(trial: u64, cause: Option<&str>) -> TrialRow {
    let tools = |step: u32, off_m: f64| {
        let x = 0.01 * f64::from(step);
        vec![[x - 0.2, 0.1 + off_m, 0.05], [0.2 - x, off_m - 0.1, 0.05]]
    };
    let path = (0..30).map(|step| ToolPathPoint {
        time_s: 0.04 * f64::from(step),
        planned: if step < 20 { tools(step, 0.0) } else { Vec::new() },
        measured: tools(step, 0.004),
    });
    TrialRow {
        policy: "student-push".to_owned(),
        mode: "closed-loop".to_owned(),
        task: "push".to_owned(),
        trial,
        seed: 777,
        success: cause.is_none(),
        cause: cause.map(str::to_owned),
        detail: cause.map(|cause| format!("{cause} & more: arm 0 < arm 1")),
        goal_distances_m: vec![0.012, 0.0834],
        rehearsed_m: None,
        duration_s: 10.0 + trial as f64,
        n_steps: 40,
        n_shortened: 3,
        arms_gap_m: Some(0.0305),
        table_gap_m: 0.0061,
        tolerance_m: Some(0.05),
        starts: vec![[-0.05, 0.15, 0.0], [0.05, -0.15, 0.0]],
        goals: vec![[-0.1, -0.05, 0.0], [0.1, 0.05, 0.0]],
        ends: vec![[-0.1, -0.06, 0.0], [0.1, 0.1, 0.0]],
        path: path.collect(),
        log: Some(format!("trial-{trial}.mcap")),
    }
}

/// Number of points of each polyline, in order.
fn points_of_polylines(svg: &str) -> Vec<usize> {
    let lines = svg.split("<polyline points=\"").skip(1);
    lines.map(|line| line.split('"').next().unwrap().split_whitespace().count()).collect()
}

/// Two successes and one failure of each cause, unsorted.
fn of_every_cause() -> Vec<TrialRow> {
    let causes = trials::CAUSES.iter().rev().map(|cause| Some(*cause));
    (0..).zip(causes.chain([None, None])).map(|(trial, cause)| row(trial, cause)).collect()
}

#[test]
fn the_table_has_successes_intervals_causes_and_the_papers_rows() {
    let mut rows = of_every_cause();
    for trial in 0..4 {
        rows.push(TrialRow { mode: "open-loop".to_owned(), ..row(trial, None) });
    }
    let text = Trials::of(rows).text();
    let expected = "\
push: trials, as the paper's Table 4
policy, mode                success  share [95 % interval]  median time
student-push, closed-loop      2/11      18.2 % [5.1–47.7]       15.0 s
student-push, open-loop         4/4   100.0 % [51.0–100.0]       11.5 s
the paper, proposed method    40/50     80.0 % [67.0–88.8]            –
the paper, from scratch        0/50        0.0 % [0.0–7.1]            –
failures of student-push, closed-loop: 1 not-reached, 1 condition-unmet, 1
object-lost, 1 timed-out, 1 arms-touched, 1 table-touched, 1 refused, 1
not-rehearsed, 1 stopped
";
    assert_eq!(text, expected);
}

#[test]
fn a_task_with_a_shared_object_is_not_compared_with_the_paper() {
    let carried = |trial, cause| TrialRow { task: "carry-bar".to_owned(), ..row(trial, cause) };
    let trials = Trials::of(vec![carried(1, None), carried(2, Some("condition-unmet"))]);
    let text = trials.text();
    assert!(text.starts_with("carry-bar: trials\n") && !text.contains("the paper"), "{text}");
    assert!(text.contains("1 condition-unmet"), "{text}");
    let json = trials::json(&trials);
    assert!(json.to_string().contains("\"paper\":null"), "{json}");
}

#[test]
fn pick_and_place_follows_push_and_unknown_causes_are_last() {
    let other_task = |trial, cause| TrialRow {
        task: "pick-and-place".to_owned(),
        policy: "a".to_owned(),
        ..row(trial, cause)
    };
    let mut without_cause = row(3, None);
    without_cause.success = false;
    let mut contradictory = row(4, Some("stopped"));
    contradictory.success = true;
    let rows = vec![
        other_task(1, None),
        row(1, Some("lightning")),
        row(2, Some("not-reached")),
        without_cause,
        contradictory,
    ];
    let tables = Trials::of(rows).tables();
    assert_eq!(tables.len(), 2);
    assert!(tables[0].title.starts_with("push:") && tables[1].title.starts_with("pick-and-place:"));
    let cell = |head: &str| {
        let column = tables[0].header.iter().position(|cell| cell == head).unwrap();
        tables[0].rows[0][column].as_str()
    };
    assert_eq!(
        ["success", "not-reached", "stopped", "other"].map(cell),
        ["0/4", "1", "1", "2"],
        "a trial with a cause is not a success"
    );
    assert!(!tables[1].header.contains(&"other".to_owned()));
    let papers: Vec<&str> = tables[1].rows[1..].iter().map(|line| line[1].as_str()).collect();
    assert_eq!(papers, ["38/50", "30/50"]);
}

#[test]
fn trials_with_one_arm_are_not_compared_with_the_papers_two() {
    let mut lone = row(1, Some("timed-out"));
    for positions in [&mut lone.starts, &mut lone.goals, &mut lone.ends] {
        positions.truncate(1);
    }
    for tools in &mut lone.path {
        tools.planned.truncate(1);
        tools.measured.truncate(1);
    }
    (lone.arms_gap_m, lone.goal_distances_m, lone.detail) = (None, vec![0.07], None);
    let trials = Trials::of(vec![lone.clone()]);
    assert_eq!(trials.tables()[0].rows.len(), 1);
    let svg = trial_svg(&lone);
    assert_well_formed(&svg);
    assert_eq!(points_of_polylines(&svg), [30, 20, 30, 20]);
    assert!(svg.contains("arm 0<") && !svg.contains("arm 1<"));
}

#[test]
fn a_plot_has_both_paths_of_both_arms_in_both_views() {
    let svg = trial_svg(&row(7, Some("arms-touched")));
    assert_well_formed(&svg);
    assert_eq!(points_of_polylines(&svg), [30, 20, 30, 20, 30, 20, 30, 20]);
    let dashed = svg
        .split("<polyline")
        .skip(1)
        .filter(|line| line.split("/>").next().unwrap().contains("stroke-dasharray"));
    assert_eq!(dashed.count(), 4, "planned paths");
    for text in [
        "push, trial 7: arms-touched",
        "12 / 83 mm",
        "arms-touched &amp; more: arm 0 &lt; arm 1",
        "3 of them shortened",
        "10 cm",
        "when the trial failed",
    ] {
        assert!(svg.contains(text), "{text}");
    }
    let success = trial_svg(&row(8, None));
    assert!(success.contains("trial 8: success") && !success.contains("when the trial failed"));
}

#[test]
fn a_trial_without_motion_or_without_positions_is_drawn() {
    let still = TrialRow { path: Vec::new(), ..row(1, Some("refused")) };
    let unknown = TrialRow {
        starts: Vec::new(),
        goals: Vec::new(),
        ends: Vec::new(),
        goal_distances_m: Vec::new(),
        ..still.clone()
    };
    for row in [still, unknown] {
        let svg = trial_svg(&row);
        assert_well_formed(&svg);
        assert!(points_of_polylines(&svg).is_empty() && svg.contains("trial 1: refused"));
    }
}

#[test]
fn an_object_far_away_does_not_change_the_scale() {
    let circle = |row: &TrialRow| {
        let svg = trial_svg(row);
        assert_well_formed(&svg);
        let radius =
            svg.split("r=\"").skip(1).map(|rest| rest.split('"').next().unwrap().to_owned());
        radius.map(|radius| radius.parse::<f64>().unwrap()).fold(0.0, f64::max)
    };
    let near = row(1, Some("object-lost"));
    let mut far = near.clone();
    far.ends[1] = [3.0, 0.1, -9.0];
    assert_eq!(circle(&near), circle(&far));
}

#[test]
fn the_page_plots_every_failure_and_lists_every_trial() {
    let dir = tempfile::tempdir().unwrap();
    let trials = Trials::of(of_every_cause());
    let comparison = Comparison::of(Vec::new(), Vec::new());
    let page = dir.path().join("report.html");
    let written = report_html(&comparison, &trials, PlottedTrials::Failed, &page).unwrap();
    assert_eq!(written.plots.len(), trials::CAUSES.len());
    assert!(written.plots.iter().all(|path| path.exists()));
    let html = std::fs::read_to_string(&written.page).unwrap();
    assert_eq!(html.matches("<div class=wide><svg").count(), trials::CAUSES.len());
    for (trial, cause) in trials::CAUSES.iter().rev().enumerate() {
        assert!(html.contains(&format!("push, trial {trial}: {cause}")), "{cause}");
    }
    let n_trials = trials::CAUSES.len() + 2;
    for number in 0..n_trials {
        assert!(html.contains(&format!("<td>trial-{number}.mcap</td>")), "{number}");
    }
    assert!(html.contains("Comparison of trials") && html.contains("Tables 2 and 4"));
    assert!(!html.contains("Table 2</h2>"), "the paper's Table 2 is about runs");
    let all = report_html(&comparison, &trials, PlottedTrials::All, &page).unwrap();
    assert_eq!(all.plots.len(), n_trials);
}

#[test]
fn repeated_trials_add_a_warning_and_keep_their_plots() {
    let rows = vec![row(1, Some("stopped")), row(1, Some("stopped")), row(2, None)];
    let trials = Trials::of(rows);
    let [warning] = &trials.warnings[..] else { panic!("{:?}", trials.warnings) };
    assert!(warning.contains("1 of 3 trials repeat"), "{warning}");
    let names: Vec<String> =
        trials.plots(PlottedTrials::Failed).into_iter().map(|plot| plot.file_name).collect();
    assert_eq!(
        names,
        [
            "trial-push-student-push-closed-loop-seed777-1.svg",
            "trial-push-student-push-closed-loop-seed777-1-again2.svg"
        ]
    );
    assert!(Trials::of(of_every_cause()).warnings.is_empty());
}

#[test]
fn json_has_the_statistics_of_every_group() {
    let value = trials::json(&Trials::of(of_every_cause()));
    let group = &value["groups"][0];
    assert_eq!((&group["trials"], &group["successes"]), (&11.into(), &2.into()));
    assert_eq!(group["success"], 2.0 / 11.0);
    assert_eq!(group["success_low"], tandem_core::Wilson::of(2, 11).low);
    assert_eq!(group["failed_by"]["table-touched"], 1);
    assert_eq!(group["failed_by"]["other"], 0);
    assert_eq!(group["median_duration_s"], 15.0);
    assert_eq!(group["median_success_duration_s"], 19.5);
    assert_eq!(group["failures"].as_array().unwrap().len(), trials::CAUSES.len());
    assert_eq!(group["failures"][6]["log"], "trial-6.mcap");
    assert_eq!(group["paper"][0]["successes"], 40);
}
