//! Baselines of an evaluation: policies that cannot take account of the other arm.

use serde_json::{Value, json};
use tandem_core::Wilson;
use tandem_report::Table;

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
        if !args.baselines {
            return Ok(Self::none());
        }
        let layout = subject.layout();
        if layout.n_arms < 2 {
            return Err(Failed::usage(
                "--baselines: the policy drives one arm, so there is no other arm to take account of",
            ));
        }
        let path = match &args.teacher {
            Some(path) => path.clone(),
            None => policy_file::shipped_teacher(layout.task.name())?,
        };
        let teacher = policy_file::load(&path)?;
        let composed = EvaluatedPolicy::composed(teacher, layout.n_arms, &path)?;
        if composed.layout() != layout {
            return Err(Failed::usage(format!(
                "{} is a teacher for {}, the policy is for {}",
                path.display(),
                composed.layout().task,
                layout.task
            )));
        }
        let blind = EvaluatedPolicy::Blind(subject.policy().clone());
        let subjects = [("composed teachers", composed), ("blind policy", blind)];
        let results = subjects
            .into_iter()
            .map(|(name, subject)| Ok((name, measure(&subject, args.episodes, args.seed)?)));
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
        let header = ["", "no contact", "success", "arm contact", "table contact", "any contact"];
        let rows = std::iter::once(("policy", of_policy));
        let rows = rows.chain(self.0.iter().map(|(name, result)| (*name, result)));
        let table = Table {
            title: "share of episodes [95 % interval]; no contact: success without contact between the arms".to_owned(),
            header: header.map(str::to_owned).to_vec(),
            rows: rows.map(|(name, result)| row(name, result)).collect(),
        };
        Some(table.text().trim_end().to_owned())
    }
}

fn row(name: &str, result: &EvaluationResult) -> Vec<String> {
    let summary = &result.summary;
    let shares = [
        summary.success_without_contact,
        Some(summary.success),
        summary.arm_contact_rate,
        summary.table_contact_rate,
        Some(summary.collision_rate),
    ];
    let cell = |share: Option<f64>| {
        share.map_or_else(String::new, |share| {
            let Wilson { low, high } = summary.interval_of(share);
            format!("{share:.3} [{low:.3}, {high:.3}]")
        })
    };
    std::iter::once(name.to_owned()).chain(shares.map(cell)).collect()
}
