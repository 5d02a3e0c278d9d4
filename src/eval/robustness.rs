//! The robustness of a policy: its success in worlds and with errors that it was not trained for.

use indicatif::{ProgressBar, ProgressStyle};
use serde_json::{Value, json};
use tandem_core::Task;
use tandem_report::Table;
use tandem_sim::WorldConfig;
use tandem_worker::Perturbation;

use super::baselines::{self, Share};
use super::share_text;
use crate::cli::EvalArgs;
use crate::evaluation::{EvaluatedPolicy, EvaluationResult, measure_perturbed};
use crate::exit::Failed;
use crate::output;

/// A world and errors that differ from those of evaluations in one respect.
struct Condition {
    name: String,
    world: WorldConfig,
    perturbation: Perturbation,
}

/// The results of a policy, and of its baselines if there are any, under all conditions.
pub(super) struct Robustness {
    task: Task,
    n_arms: usize,
    /// Names of the conditions. The first one has no perturbation.
    conditions: Vec<String>,
    /// Results of the policy under these conditions.
    policy: Vec<EvaluationResult>,
    /// The same for each baseline, after its name.
    baselines: Vec<(&'static str, Vec<EvaluationResult>)>,
}

impl Robustness {
    /// Evaluates the policy and its baselines on the same starts and goals under every condition.
    pub(super) fn measure(args: &EvalArgs, subject: &EvaluatedPolicy) -> Result<Self, Failed> {
        let baselines = baselines::subjects(args, subject)?;
        let layout = subject.layout();
        let conditions = conditions(layout.task);
        let progress = progress(conditions.len() * (1 + baselines.len()));
        let goals = (args.episodes, args.seed);
        let results = |subject: &EvaluatedPolicy| {
            let results = conditions.iter().map(|Condition { name, world, perturbation }| {
                progress.set_message(name.clone());
                let result =
                    measure_perturbed(subject, (world, *perturbation), goals, &mut |_| {})?;
                progress.inc(1);
                Ok(result)
            });
            results.collect::<Result<Vec<_>, Failed>>()
        };
        let policy = results(subject)?;
        let baselines = baselines.iter().map(|(name, baseline)| Ok((*name, results(baseline)?)));
        let baselines = baselines.collect::<Result<Vec<_>, Failed>>()?;
        progress.finish_and_clear();
        let conditions = conditions.into_iter().map(|condition| condition.name).collect();
        Ok(Self { task: layout.task, n_arms: layout.n_arms, conditions, policy, baselines })
    }

    /// Prints the tables, or one JSON object.
    pub(super) fn print(&self, args: &EvalArgs) -> Result<(), Failed> {
        if args.json {
            return output::print(self.json(args.seed));
        }
        let goals = format!("{} episodes of seed {} each", args.episodes, args.seed);
        output::print(format_args!("{}, {goals}", self.task))?;
        output::print(self.text().trim_end())
    }

    /// Returns the results under each condition in the entry `conditions`, and those of each baseline in an entry of
    /// `baselines` if there are any.
    fn json(&self, seed: u64) -> Value {
        let mut value = json!({ "seed": seed, "conditions": self.conditions_json(&self.policy) });
        if !self.baselines.is_empty() {
            let baselines = self.baselines.iter().map(|(name, results)| {
                json!({ "name": name, "conditions": self.conditions_json(results) })
            });
            value["baselines"] = baselines.collect();
        }
        value
    }

    fn conditions_json(&self, results: &[EvaluationResult]) -> Value {
        let conditions = self.conditions.iter().zip(results).map(|(name, result)| {
            let mut value = result.json();
            value["condition"] = json!(name);
            value
        });
        conditions.collect()
    }

    fn text(&self) -> String {
        if self.baselines.is_empty() {
            return self.table().text();
        }
        let tables = COMPARED.map(|(title, share)| self.comparison(title, share).text());
        tables.join("\n")
    }

    fn table(&self) -> Table {
        let has_other_arm = self.n_arms > 1;
        let mut header = vec!["condition".to_owned(), "success [95 % interval]".to_owned()];
        header.extend(has_other_arm.then(|| "success without contact".to_owned()));
        let results = self.conditions.iter().zip(&self.policy);
        let rows = results.map(|(name, EvaluationResult { summary, .. })| {
            let without_contact = summary.success_without_contact.filter(|_| has_other_arm);
            let shares = std::iter::once(summary.success).chain(without_contact);
            let cells = shares.map(|share| share_text(summary, share));
            std::iter::once(name.clone()).chain(cells).collect()
        });
        Table { title: String::new(), header, rows: rows.collect() }
    }

    /// Returns the table of one share, with a column for the policy and for each baseline.
    fn comparison(&self, title: &str, share: Share) -> Table {
        let baselines = self.baselines.iter().map(|(name, results)| (*name, results));
        let columns: Vec<(&str, &Vec<EvaluationResult>)> =
            std::iter::once(("policy", &self.policy)).chain(baselines).collect();
        let header = std::iter::once("condition").chain(columns.iter().map(|(name, _)| *name));
        let rows = self.conditions.iter().enumerate().map(|(idx, condition)| {
            let results: Vec<(&str, &EvaluationResult)> =
                columns.iter().map(|(name, results)| (*name, &results[idx])).collect();
            baselines::row(condition, share, &results)
        });
        Table {
            title: format!("{title} [95 % interval]"),
            header: header.map(str::to_owned).collect(),
            rows: rows.collect(),
        }
    }
}

/// The shares that are compared with those of baselines, each in a table of its own.
const COMPARED: [(&str, Share); 2] = [
    ("success without contact", |summary| summary.success_without_contact),
    ("success", |summary| Some(summary.success)),
];

/// Returns the conditions for `task`, that without a perturbation first.
fn conditions(task: Task) -> Vec<Condition> {
    let default = WorldConfig::default;
    let in_world = |name: &str, world: WorldConfig| Condition {
        name: name.to_owned(),
        world,
        perturbation: Perturbation::default(),
    };
    let with_error = |name: &str, perturbation: Perturbation| Condition {
        name: name.to_owned(),
        world: default(),
        perturbation,
    };
    let mut conditions = vec![in_world("none", default())];
    // The bar has a size and a mass of its own.
    if !task.shares_object() {
        conditions.extend([0.040, 0.055, 0.070, 0.090].map(|edge_m| {
            let name = format!("edge of the cubes {:.1} cm", 100.0 * edge_m);
            in_world(&name, WorldConfig { object_half_size_m: 0.5 * edge_m, ..default() })
        }));
        conditions.extend(
            [("mass of the cubes -50 %", 0.5), ("mass of the cubes +50 %", 1.5)].map(
                |(name, factor)| {
                    let object_mass_kg = factor * default().object_mass_kg;
                    in_world(name, WorldConfig { object_mass_kg, ..default() })
                },
            ),
        );
    }
    conditions.extend([
        in_world("all friction -50 %", with_friction(0.5)),
        in_world("all friction +50 %", with_friction(1.5)),
        with_error(
            "noise of 1 cm in positions",
            Perturbation { position_noise_m: 0.01, ..Perturbation::default() },
        ),
        with_error(
            "actions one step late",
            Perturbation { delay_steps: 1, ..Perturbation::default() },
        ),
        with_error(
            "bases displaced by 2 cm",
            Perturbation { base_offset_m: 0.02, ..Perturbation::default() },
        ),
    ]);
    conditions
}

/// Returns a world in which the friction of table, pads and objects is `factor` times as large.
fn with_friction(factor: f32) -> WorldConfig {
    let mut world = WorldConfig::default();
    world.table_friction *= factor;
    world.rubber_pads *= factor;
    for friction in [&mut world.push, &mut world.pick_and_place, &mut world.carry_bar] {
        friction.pads *= factor;
        friction.object *= factor;
    }
    world
}

/// Returns a progress bar on standard error, hidden unless that is a terminal.
fn progress(n_evaluations: usize) -> ProgressBar {
    let style = ProgressStyle::with_template("{wide_bar} {pos}/{len} {msg}");
    let style = style.unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(n_evaluations as u64).with_style(style)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use tandem_core::{Episode, EpisodeOutcome, EvaluationSummary, Layout};

    use super::*;
    use crate::evaluation::measure;
    use crate::policy_file;

    /// Checks that the conditions, other than the first, change the episodes of `subject`, and returns its episodes.
    fn episodes_that_conditions_change(subject: &EvaluatedPolicy) -> Vec<Episode> {
        let goals = (6, 3);
        let episodes_under = |Condition { world, perturbation, .. }: &Condition| {
            let (conditions, mut played) = ((world, *perturbation), Vec::new());
            let mut take = |mut episodes: Vec<Episode>| played.append(&mut episodes);
            measure_perturbed(subject, conditions, goals, &mut take).unwrap();
            played
        };
        let mut expected = Vec::new();
        measure(subject, goals, &mut |mut episodes| expected.append(&mut episodes)).unwrap();
        let conditions = conditions(subject.layout().task);
        assert_eq!(episodes_under(&conditions[0]), expected);
        for condition in &conditions[1..] {
            assert_ne!(episodes_under(condition), expected, "{} has an effect", condition.name);
        }
        expected
    }

    #[test]
    fn without_a_perturbation_the_result_is_that_of_an_evaluation() {
        let path = Path::new("policies/student-push-classic.safetensors");
        let policy = policy_file::load(path).unwrap();
        let subject = EvaluatedPolicy::new(policy.clone(), path).unwrap();
        let layout = subject.layout();
        let path = Path::new("policies/teacher-push-classic.safetensors");
        let teacher = policy_file::load(path).unwrap();
        let composed = EvaluatedPolicy::composed(teacher, (None, layout.n_arms), path).unwrap();
        let blind = EvaluatedPolicy::Blind(policy);
        let [policy, composed, blind] =
            [subject, composed, blind].map(|subject| episodes_that_conditions_change(&subject));
        assert!(policy != composed && policy != blind && composed != blind);
    }

    /// Results of a policy and two baselines for push under two conditions.
    fn robustness() -> Robustness {
        let layout = Layout::new(Task::Push, 2);
        let results = || {
            let result = || EvaluationResult {
                task: layout.into(),
                summary: EvaluationSummary::of(&[EpisodeOutcome::of(&Episode::zeros(layout, 0))]),
                steps_per_s: 1.0,
                policy_digest: String::new(),
            };
            vec![result(), result()]
        };
        Robustness {
            task: layout.task,
            n_arms: layout.n_arms,
            conditions: vec!["none".to_owned(), "noise of 1 cm in positions".to_owned()],
            policy: results(),
            baselines: vec![("composed teachers", results()), ("blind policy", results())],
        }
    }

    #[test]
    fn baselines_have_lists_with_the_keys_of_the_policy() {
        let mut robustness = robustness();
        let value = robustness.json(3);
        let policy = &value["conditions"];
        assert_eq!(policy[1]["condition"], "noise of 1 cm in positions");
        for (idx, name) in ["composed teachers", "blind policy"].into_iter().enumerate() {
            let baseline = &value["baselines"][idx];
            assert_eq!((&baseline["name"], &baseline["conditions"]), (&json!(name), policy));
        }
        robustness.baselines.clear();
        let alone = robustness.json(3);
        assert_eq!((&alone["conditions"], alone.get("baselines")), (policy, None));
    }

    #[test]
    fn baselines_have_a_column_in_a_table_for_each_kind_of_success() {
        let mut robustness = robustness();
        let text = robustness.text();
        let titles: Vec<&str> = text.lines().filter(|line| line.starts_with("success")).collect();
        assert_eq!(titles, ["success without contact [95 % interval]", "success [95 % interval]"]);
        for head in ["policy", "composed teachers", "blind policy"] {
            let table = robustness.comparison(COMPARED[0].0, COMPARED[0].1);
            assert!(table.header.iter().any(|other| other == head), "{head}");
            assert!(table.rows.iter().all(|row| row.len() == 4 && row[1] == row[3]), "{text}");
        }
        assert!(text.lines().all(|line| line.chars().count() <= 80), "{text}");
        robustness.baselines.clear();
        assert_eq!(robustness.text(), robustness.table().text(), "one table of the policy");
    }

    #[test]
    fn every_world_can_be_built_for_every_task() {
        for task in Task::ALL {
            let conditions = conditions(task);
            assert_eq!(conditions[0].perturbation, Perturbation::default());
            assert_eq!(conditions[0].world, WorldConfig::default());
            for Condition { name, world, perturbation } in conditions.into_iter().skip(1) {
                let is_perturbed = perturbation != Perturbation::default();
                assert_ne!(is_perturbed, world != WorldConfig::default(), "{task}, {name}");
                assert!(world.checked().is_ok(), "{task}, {name}");
            }
        }
    }
}
