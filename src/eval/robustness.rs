//! The robustness of a policy: its success in worlds and with errors that it was not trained for.

use indicatif::{ProgressBar, ProgressStyle};
use serde_json::{Value, json};
use tandem_core::Task;
use tandem_report::Table;
use tandem_sim::WorldConfig;
use tandem_worker::Perturbation;

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

/// The results under all conditions. The first one has no perturbation.
pub(super) struct Robustness {
    n_arms: usize,
    results: Vec<(String, EvaluationResult)>,
}

impl Robustness {
    /// Evaluates the policy on the same starts and goals under every condition.
    pub(super) fn measure(args: &EvalArgs, subject: &EvaluatedPolicy) -> Result<Self, Failed> {
        let EvaluatedPolicy::Policy(policy) = subject else {
            return Err(Failed::usage("--robustness needs --policy"));
        };
        let layout = subject.layout();
        let conditions = conditions(layout.task);
        let progress = progress(conditions.len());
        let mut results = Vec::with_capacity(conditions.len());
        for Condition { name, world, perturbation } in conditions {
            progress.set_message(name.clone());
            let goals = (args.episodes, args.seed);
            let result =
                measure_perturbed(policy, layout, (&world, perturbation), goals, &mut |_| {})?;
            results.push((name, result));
            progress.inc(1);
        }
        progress.finish_and_clear();
        Ok(Self { n_arms: layout.n_arms, results })
    }

    /// Prints the table, or one JSON object with an entry `conditions`.
    pub(super) fn print(&self, args: &EvalArgs) -> Result<(), Failed> {
        if args.json {
            return output::print(self.json(args));
        }
        let task = self.results.first().map_or("", |(_, result)| result.task.name());
        let goals = format!("{} episodes of seed {} each", args.episodes, args.seed);
        output::print(format_args!("{task}, {goals}"))?;
        output::print(self.table().text().trim_end())
    }

    fn json(&self, args: &EvalArgs) -> Value {
        let conditions = self.results.iter().map(|(name, result)| {
            let mut value = result.json();
            value["condition"] = json!(name);
            value
        });
        json!({ "seed": args.seed, "conditions": conditions.collect::<Value>() })
    }

    fn table(&self) -> Table {
        let has_other_arm = self.n_arms > 1;
        let mut header = vec!["condition".to_owned(), "success [95 % interval]".to_owned()];
        header.extend(has_other_arm.then(|| "success without contact".to_owned()));
        let rows = self.results.iter().map(|(name, EvaluationResult { summary, .. })| {
            let without_contact = summary.success_without_contact.filter(|_| has_other_arm);
            let shares = std::iter::once(summary.success).chain(without_contact);
            let cells = shares.map(|share| share_text(summary, share));
            std::iter::once(name.clone()).chain(cells).collect()
        });
        Table { title: String::new(), header, rows: rows.collect() }
    }
}

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
fn progress(n_conditions: usize) -> ProgressBar {
    let style = ProgressStyle::with_template("{wide_bar} {pos}/{len} {msg}");
    let style = style.unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(n_conditions as u64).with_style(style)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use tandem_core::Episode;

    use super::*;
    use crate::evaluation::measure;
    use crate::policy_file;

    #[test]
    fn without_a_perturbation_the_result_is_that_of_an_evaluation() {
        let path = Path::new("policies/student-push-classic.safetensors");
        let policy = policy_file::load(path).unwrap();
        let subject = EvaluatedPolicy::new(policy.clone(), path).unwrap();
        let (layout, goals) = (subject.layout(), (6, 3));
        let episodes_under = |Condition { world, perturbation, .. }: &Condition| {
            let (conditions, mut played) = ((world, *perturbation), Vec::new());
            let mut take = |mut episodes: Vec<Episode>| played.append(&mut episodes);
            measure_perturbed(&policy, layout, conditions, goals, &mut take).unwrap();
            played
        };
        let mut expected = Vec::new();
        measure(&subject, goals, &mut |mut episodes| expected.append(&mut episodes)).unwrap();
        let conditions = conditions(layout.task);
        assert_eq!(episodes_under(&conditions[0]), expected);
        for condition in &conditions[1..] {
            assert_ne!(episodes_under(condition), expected, "{} has an effect", condition.name);
        }
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
