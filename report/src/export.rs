//! Export of a comparison as JSON and CSV.

use serde_json::{Value, json};
use tandem_core::Wilson;
use tandem_telemetry::MetricsRow;

use crate::comparison::{
    Comparison, Section, success_joint, success_per_arm, success_without_contact,
    test_collision_rate, test_success,
};
use crate::group::{MILESTONES, SeedGroup};
use crate::measures::{CostOf, LearningMeasures, first_reaching};
use crate::quantity::Quantity;
use crate::run::Run;
use crate::spread::{MeanInterval, Spread};

/// Header of [`csv`]. Steps are environment steps, epochs are the paper's, shares are in [0, 1].
///
/// The columns `held_out_*` are the evaluation on test goals. A list of one number per arm is separated by spaces.
/// `*_seeds_low` and `*_seeds_high` are Student's interval of the mean over the runs of the line's group; they are
/// empty for fewer than three runs.
pub const CSV_HEADER: &str = "task,arms,group,strategy,run,seed,evaluations,env_steps,wall_s,inspired_epoch,rise_epochs,max_success,\
     effective_learning_rate,env_steps_to_50,env_steps_to_90,env_steps_to_95,minutes_to_50,minutes_to_90,minutes_to_95,\
     advice_spent,last_success,last_low,last_high,collision_rate,held_out_success,held_out_low,held_out_high,\
     held_out_collision_rate,held_out_success_without_contact,held_out_arm_contact_rate,advice_queries,\
     held_out_success_joint,held_out_success_per_arm,held_out_success_seeds_low,held_out_success_seeds_high,\
      held_out_success_without_contact_seeds_low,held_out_success_without_contact_seeds_high";

/// Returns a comparison as CSV with one line per run. Values that do not exist are empty.
#[must_use]
pub fn csv(comparison: &Comparison) -> String {
    let mut text = format!("{CSV_HEADER}\n");
    for section in &comparison.sections {
        for (group, run) in
            section.groups.iter().flat_map(|group| group.runs.iter().map(move |run| (group, run)))
        {
            let cells: Vec<String> =
                run_cells(group, run).iter().map(|cell| quoted(cell)).collect();
            text.push_str(&cells.join(","));
            text.push('\n');
        }
    }
    text
}

fn run_cells(group: &SeedGroup, run: &Run) -> Vec<String> {
    let number = |value: Option<f64>| {
        value.filter(|v| v.is_finite()).map(|v| v.to_string()).unwrap_or_default()
    };
    let count = |value: Option<u64>| value.map(|v| v.to_string()).unwrap_or_default();
    let list = |values: &[f64]| values.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    let measures = LearningMeasures::for_comparison(&run.rows);
    let last = run.last();
    let test = run.test.as_ref();
    let mut cells = vec![
        group.setup.task.clone().unwrap_or_default(),
        count(group.setup.n_arms),
        group.label.clone(),
        group.strategy.clone().unwrap_or_default(),
        run.name.clone(),
        count(run.seed()),
        run.rows.len().to_string(),
        count(last.map(|row| row.env_steps)),
        number(last.map(|row| row.wall_s)),
        number(measures.and_then(|measures| measures.inspired_epoch)),
        number(measures.and_then(|measures| measures.rising_epochs)),
        number(measures.map(|measures| measures.max_success)),
        number(measures.and_then(|measures| measures.learning_rate)),
    ];
    let reached = MILESTONES.map(|success| first_reaching(&run.rows, Quantity::Success, success));
    cells.extend(reached.map(|row| count(row.map(|row| row.env_steps))));
    cells.extend(reached.map(|row| number(row.map(|row| row.wall_s / 60.0))));
    cells.push(count(last.map(|row| row.advice_spent)));
    let of_last: [fn(&MetricsRow) -> f64; 3] =
        [|row| row.success, |row| row.success_low, |row| row.success_high];
    cells.extend(of_last.map(|value| number(last.map(value))));
    let has_contacts = run.reports_contacts();
    cells.push(number(last.filter(|_| has_contacts).map(|row| row.collision_rate)));
    cells.extend([
        number(test.map(|test| test.success)),
        number(test.map(|test| test.interval.low)),
        number(test.map(|test| test.interval.high)),
        number(test.filter(|_| has_contacts).and_then(|test| test.collision_rate)),
        number(test.and_then(|test| test.contacts.success_without_contact)),
        number(test.and_then(|test| test.contacts.arm_contact_rate)),
        count(last.and_then(|row| row.advice_queries)),
        number(test.map(|test| test.success_joint)),
        test.map(|test| list(&test.success_per_arm)).unwrap_or_default(),
    ]);
    for share in [group.share(test_success), group.share(success_without_contact)] {
        let ends = share.over_seeds.map(|MeanInterval { low, high }| (low, high)).unzip();
        cells.extend([number(ends.0), number(ends.1)]);
    }
    cells
}

/// Quotes a cell if CSV requires it.
fn quoted(cell: &str) -> String {
    match cell.contains([',', '"', '\n', '\r']) {
        true => format!("\"{}\"", cell.replace('"', "\"\"")),
        false => cell.to_owned(),
    }
}

/// Returns a comparison as one JSON object: `sections`, each with `groups` and `baselines`.
///
/// The key `held_out_success` is the success on test goals. For a share, `low` and `high` are Wilson's interval over the
/// episodes of all runs. `seeds_low` and `seeds_high` are Student's interval of the mean over three or more runs.
#[must_use]
pub fn json(comparison: &Comparison) -> Value {
    json!({ "sections": comparison.sections.iter().map(section_json).collect::<Vec<_>>() })
}

fn section_json(section: &Section) -> Value {
    let reports_contacts = section.reports_contacts();
    let baselines = section.baselines.iter().map(|baseline| {
        let test = &baseline.test;
        json!({
            "label": baseline.label, "episodes": test.n_episodes, "success": test.success,
            "success_low": test.interval.low, "success_high": test.interval.high,
            "success_joint": test.success_joint,
            "success_per_arm": test.success_per_arm,
            "collision_rate": test.collision_rate.filter(|_| reports_contacts),
            "success_without_contact": test.contacts.success_without_contact,
            "success_without_contact_low": test.contacts.success_without_contact_low,
            "success_without_contact_high": test.contacts.success_without_contact_high,
            "arm_contact_rate": test.contacts.arm_contact_rate,
            "table_contact_rate": test.contacts.table_contact_rate,
            "avoidance_rate": test.contacts.avoidance_rate,
        })
    });
    json!({
        "task": section.setup.task,
        "arms": section.setup.n_arms,
        "groups": section.groups.iter().map(group_json).collect::<Vec<_>>(),
        "baselines": baselines.collect::<Vec<_>>(),
    })
}

fn group_json(group: &SeedGroup) -> Value {
    let paper = group.paper().zip(group.setup.built_in()).map(|(row, task)| {
        let measures = row.measures(task);
        json!({
            "row": row.name, "inspired_epoch": measures.inspired_epoch, "rise_epochs": measures.rising_epochs,
            "max_success": measures.max_success, "effective_learning_rate": measures.learning_rate,
        })
    });
    let milestones = |measure| MILESTONES.map(|success| milestone_json(group, (measure, success)));
    json!({
        "label": group.label,
        "strategy": group.strategy,
        "runs": group.runs.iter().map(|run| run.name.clone()).collect::<Vec<_>>(),
        "inspired_epoch": spread_json(&group.measure(|measures| measures.inspired_epoch)),
        "rise_epochs": spread_json(&group.measure(|measures| measures.rising_epochs)),
        "max_success": spread_json(&group.measure(|measures| Some(measures.max_success))),
        "effective_learning_rate": spread_json(&group.measure(|measures| measures.learning_rate)),
        "paper": paper,
        "milestones": milestones(Quantity::Success),
        "milestones_without_contact": milestones(Quantity::SuccessWithoutContact),
        "env_steps": spread_json(&group.spread(|run| Some(run.last()?.env_steps as f64))),
        "advice_spent": spread_json(&group.spread(|run| Some(run.last()?.advice_spent as f64))),
        "advice_queries": spread_json(&group.spread(|run| Some(run.last()?.advice_queries? as f64))),
        "last_success": share_json(group, |run| run.last().map(|row| (row.success, row.n_episodes))),
        "best_success": share_json(group, |run| run.best().map(|row| (row.success, row.n_episodes))),
        "held_out_success": share_json(group, test_success),
        "held_out_success_without_contact": share_json(group, success_without_contact),
        "held_out_collision_rate": share_json(group, test_collision_rate),
        "success_joint": spread_json(&group.spread(success_joint)),
        "success_per_arm": per_arm_json(group),
        "collision_rate": share_json(group, |run| {
            let last = run.last().filter(|_| run.reports_contacts());
            last.map(|row| (row.collision_rate, row.n_episodes))
        }),
    })
}

/// Returns what the runs of a group needed to reach a success.
fn milestone_json(group: &SeedGroup, milestone: (Quantity, f64)) -> Value {
    let at = |value: CostOf| spread_json(&group.at_milestone(milestone, value));
    json!({
        "success": milestone.1,
        "env_steps": at(|row| Some(row.env_steps as f64)),
        "updates": at(|row| Some(row.updates as f64)),
        "minutes": at(|row| Some(row.wall_s / 60.0)),
        "advice_spent": at(|row| Some(row.advice_spent as f64)),
        "advice_queries": at(|row| Some(row.advice_queries? as f64)),
    })
}

/// Returns the spread of each arm's success, in the order of the arms.
fn per_arm_json(group: &SeedGroup) -> Value {
    let n_arms = group.runs.iter().map(|run| success_per_arm(run).len()).max().unwrap_or(0);
    let of_arm =
        |arm: usize| spread_json(&group.spread(|run| success_per_arm(run).get(arm).copied()));
    (0..n_arms).map(of_arm).collect()
}

/// Returns a spread as JSON; `null` if no run has the value.
fn spread_json(spread: &Spread) -> Value {
    match spread.n {
        0 => Value::Null,
        n => json!({"mean": spread.mean, "min": spread.min, "max": spread.max, "runs": n}),
    }
}

fn share_json(group: &SeedGroup, pick: impl Fn(&Run) -> Option<(f64, u64)>) -> Value {
    let share = group.share(pick);
    let pooled = share.pooled.map(|Wilson { low, high }| [("low", low), ("high", high)]);
    let over_seeds = share
        .over_seeds
        .map(|MeanInterval { low, high }| [("seeds_low", low), ("seeds_high", high)]);
    let mut value = spread_json(&share.values);
    if let Some(object) = value.as_object_mut() {
        let ends = [pooled, over_seeds].into_iter().flatten().flatten();
        object.extend(ends.map(|(key, end)| (key.to_owned(), json!(end))));
    }
    value
}

#[cfg(test)]
mod tests {
    use tandem_telemetry::ContactMetrics;

    use super::*;
    use crate::test_evaluation::TestEvaluation;

    fn comparison() -> Comparison {
        let row = |(idx, success): (u64, f64)| MetricsRow {
            env_steps: 1000 * idx,
            paper_epochs: idx as f64,
            wall_s: 60.0 * idx as f64,
            success,
            n_episodes: 240,
            ..MetricsRow::default()
        };
        let run = Run {
            name: "odd, name-seed3".to_owned(),
            rows: vec![row((1, 0.25)), row((2, 0.5))],
            configuration: "task = \"push\"\narms = 2\nseed = 3\n[advice]\nstrategy = \"ea\""
                .parse()
                .ok(),
            ..Run::default()
        };
        Comparison::of(
            vec![run, Run { name: "push-empty-seed1".to_owned(), ..Run::default() }],
            Vec::new(),
        )
    }

    #[test]
    fn every_csv_line_has_a_cell_in_every_column() {
        let text = csv(&comparison());
        let lines: Vec<&str> = text.lines().collect();
        let n_columns = lines[0].split(',').count();
        assert_eq!(lines.len(), 3);
        assert_eq!(
            lines[1],
            "push,2,\"odd, name\",ea,\"odd, name-seed3\",3,2,2000,120,,,0.5,,2000,,,2,,,0,0.5,0,0,0,,,,,,,,,,,,,"
        );
        assert_eq!(lines[2].split(',').count(), n_columns);
    }

    #[test]
    fn a_milestone_that_no_run_reached_is_null_in_json() {
        let value = json(&comparison());
        let group = &value["sections"][0]["groups"][0];
        assert_eq!(group["milestones"][0]["env_steps"]["mean"], 2000.0);
        assert!(group["milestones"][1]["env_steps"].is_null());
        assert_eq!(group["paper"]["row"], "EA");
        assert_eq!(group["last_success"]["mean"], 0.5);
        assert_eq!(group["last_success"]["low"], json!(Wilson::of(120, 240).low));
        assert!(group["held_out_success"].is_null());
    }

    /// An evaluation in which half of 240 episodes succeeded.
    fn half() -> TestEvaluation {
        TestEvaluation {
            task: "push".to_owned(),
            n_arms: 2,
            n_episodes: 240,
            success: 0.5,
            interval: Wilson::of(120, 240),
            success_joint: 0.25,
            success_per_arm: vec![0.75, 0.625],
            collision_rate: Some(0.125),
            contacts: ContactMetrics::default(),
        }
    }

    #[test]
    fn three_runs_have_an_interval_over_seeds_beside_that_over_episodes() {
        let of_runs = |successes: &[f64]| {
            let mut compared = comparison();
            let runs = &mut compared.sections[0].groups[0].runs;
            let run = runs.remove(0);
            runs.extend(successes.iter().map(|success| Run {
                test: Some(TestEvaluation { success: *success, ..half() }),
                ..run.clone()
            }));
            compared
        };
        let [two, three] = [of_runs(&[0.25, 0.75]), of_runs(&[0.25, 0.5, 0.75])];
        let group = |compared: &Comparison| json(compared)["sections"][0]["groups"][0].clone();
        let (of_two, of_three) = (group(&two), group(&three));
        assert!(of_two["held_out_success"].get("seeds_low").is_none(), "{of_two}");
        assert_eq!(of_two["held_out_success"]["low"], json!(Wilson::of(240, 480).low));
        assert_eq!(of_three["held_out_success"]["low"], json!(Wilson::of(360, 720).low));
        assert_eq!(of_three["held_out_success"]["seeds_low"], 0.0, "clipped");
        assert_eq!(of_three["held_out_success"]["seeds_high"], 1.0, "clipped");
        let ends = |compared: &Comparison| {
            let text = csv(compared);
            text.lines().nth(1).is_some_and(|line| line.ends_with(",0,1,,"))
        };
        assert!(ends(&three) && !ends(&two), "{}", csv(&three));
    }

    #[test]
    fn the_evaluation_on_test_goals_is_exported() {
        let mut compared = comparison();
        let [tested] = &mut compared.sections[0].groups[0].runs[..] else { panic!("one run") };
        tested.test = Some(half());
        let value = json(&compared);
        let group = &value["sections"][0]["groups"][0];
        assert_eq!(group["held_out_collision_rate"]["mean"], 0.125);
        assert_eq!(group["held_out_collision_rate"]["low"], json!(Wilson::of(30, 240).low));
        assert_eq!(group["success_joint"]["mean"], 0.25);
        let per_arm = &group["success_per_arm"];
        assert_eq!((&per_arm[0]["mean"], &per_arm[1]["mean"]), (&json!(0.75), &json!(0.625)));
        assert_eq!(per_arm.as_array().map(Vec::len), Some(2));
        assert!(csv(&compared).lines().any(|line| line.contains(",0.25,0.75 0.625,")));
        assert_eq!(group["collision_rate"]["mean"], 0.0, "of the last evaluation");
    }
}
