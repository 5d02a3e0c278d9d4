//! Baselines of an evaluation: policies that cannot take account of the other arm.

use serde_json::{Value, json};
use tandem_core::EvaluationSummary;
use tandem_report::Table;

use super::share_text;
use crate::cli::EvalArgs;
use crate::evaluation::{EvaluatedPolicy, EvaluationResult, measure};
use crate::exit::Failed;
use crate::policy_file;

/// The results of the baselines that the command line asks for, by name.
pub(super) struct Baselines(Vec<(&'static str, EvaluationResult)>);

impl Baselines {
    /// Returns no baselines.
    pub(super) const fn none() -> Self {
        Self(Vec::new())
    }

    /// Evaluates composed teachers and the blind policy on the goals of the policy, or nothing without `--baselines`.
    pub(super) fn measure(args: &EvalArgs, subject: &EvaluatedPolicy) -> Result<Self, Failed> {
        let goals = (args.episodes, args.seed);
        let results = subjects(args, subject)?
            .into_iter()
            .map(|(name, subject)| Ok((name, measure(&subject, goals, &mut |_| {})?)));
        results.collect::<Result<_, Failed>>().map(Self)
    }

    /// Returns the result of the policy as JSON, with an entry `baselines` if there are any.
    pub(super) fn json(&self, of_policy: &EvaluationResult) -> Value {
        let mut value = of_policy.json();
        if self.0.is_empty() {
            return value;
        }
        let baselines = self.0.iter().map(|(name, result)| {
            let mut value = result.json();
            value["name"] = json!(name);
            value
        });
        value["baselines"] = baselines.collect();
        value
    }

    /// Returns the table of the policy and its baselines, if there are any.
    pub(super) fn table(&self, of_policy: &EvaluationResult) -> Option<String> {
        if self.0.is_empty() {
            return None;
        }
        let columns: Vec<(&str, &EvaluationResult)> = std::iter::once(("policy", of_policy))
            .chain(self.0.iter().map(|(name, result)| (*name, result)))
            .collect();
        let names = columns.iter().map(|(name, _)| (*name).to_owned());
        let table = Table {
            title: "share of episodes [95 % interval]; no contact: success, arms never touch"
                .to_owned(),
            header: std::iter::once(String::new()).chain(names).collect(),
            rows: MEASURES.iter().map(|(label, share)| row(label, *share, &columns)).collect(),
        };
        Some(table.text().trim_end().to_owned())
    }
}

/// Returns composed teachers and the blind policy with their names, or nothing without `--baselines`.
pub(super) fn subjects(
    args: &EvalArgs,
    subject: &EvaluatedPolicy,
) -> Result<Vec<(&'static str, EvaluatedPolicy)>, Failed> {
    if !args.baselines {
        return Ok(Vec::new());
    }
    let EvaluatedPolicy::Policy(policy) = subject else {
        return Err(Failed::usage("--baselines needs --policy"));
    };
    let layout = subject.layout();
    if layout.n_arms < 2 {
        return Err(Failed::usage(
            "--baselines: the policy drives one arm, so there is no other arm to take account of",
        ));
    }
    let path = match &args.teacher {
        Some(path) => path.clone(),
        None => policy_file::shipped_teacher(layout.task.of_one_arm().name())?,
    };
    let teacher = policy_file::load(&path)?;
    let composed = EvaluatedPolicy::composed(teacher, (Some(layout.task), layout.n_arms), &path)?;
    if composed.layout() != layout {
        return Err(Failed::usage(format!(
            "{} is a teacher for {}, the policy is for {}",
            path.display(),
            composed.layout().task,
            layout.task
        )));
    }
    let blind = EvaluatedPolicy::Blind(policy.clone());
    Ok(vec![("composed teachers", composed), ("blind policy", blind)])
}

/// Returns a share of the evaluated episodes, if the task has it.
pub(super) type Share = fn(&EvaluationSummary) -> Option<f64>;

/// The rows of the table.
const MEASURES: [(&str, Share); 6] = [
    ("no contact", |summary| summary.success_without_contact),
    ("success", |summary| Some(summary.success)),
    ("arm contact", |summary| summary.arm_contact_rate),
    ("table contact", |summary| summary.table_contact_rate),
    ("any contact", |summary| Some(summary.collision_rate)),
    ("lost goal", |summary| Some(summary.lost_goal_rate)),
];

/// Returns the row of one share, with a cell for each policy.
pub(super) fn row(label: &str, share: Share, columns: &[(&str, &EvaluationResult)]) -> Vec<String> {
    let cell = |(_, result): &(&str, &EvaluationResult)| {
        share(&result.summary).map_or_else(String::new, |share| share_text(&result.summary, share))
    };
    std::iter::once(label.to_owned()).chain(columns.iter().map(cell)).collect()
}
