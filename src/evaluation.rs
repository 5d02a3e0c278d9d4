//! Evaluations: a policy alone on fixed goals, without noise or advice.

use std::num::NonZeroUsize;
use std::path::Path;

use serde_json::{Value, json};
use tandem_core::{Episode, EpisodeOutcome, EvaluationSummary, Layout, Wilson};
use tandem_policy::Policy;
use tandem_sim::WorldConfig;
use tandem_worker::{evaluate, evaluate_composed};

use crate::clock;
use crate::exit::{Exit, Failed, OrExit as _};

/// The policy that acts in an evaluation.
#[derive(Debug, Clone)]
pub(crate) enum EvaluatedPolicy {
    /// A policy for all arms of its layout.
    Policy(Policy),
    /// A one-arm policy that controls each of so many arms.
    Composed(Policy, usize),
}

impl EvaluatedPolicy {
    /// Evaluates the policy that was loaded from `path`.
    pub(crate) fn new(policy: Policy, path: &Path) -> Result<Self, Failed> {
        simulated(policy, path).map(Self::Policy)
    }

    /// Composes `n_arms` copies of the one-arm policy that was loaded from `path`.
    pub(crate) fn composed(policy: Policy, n_arms: usize, path: &Path) -> Result<Self, Failed> {
        let policy = simulated(policy, path)?;
        if policy.layout.n_arms() != 1 {
            return Err(Failed::usage(format!(
                "{} drives {} arms: a teacher drives one",
                path.display(),
                policy.layout.n_arms()
            )));
        }
        if !(1..=2).contains(&n_arms) {
            return Err(Failed::usage(format!("--arms {n_arms}: expected 1 or 2")));
        }
        Ok(Self::Composed(policy, n_arms))
    }

    pub(crate) fn layout(&self) -> Layout {
        let layout = self.policy().layout.as_built_in();
        let layout = layout.expect("the constructors refuse policies of other tasks");
        match self {
            Self::Policy(_) => layout,
            Self::Composed(_, n_arms) => Layout::new(layout.task, *n_arms),
        }
    }

    pub(crate) const fn policy(&self) -> &Policy {
        match self {
            Self::Policy(policy) | Self::Composed(policy, _) => policy,
        }
    }

    /// Plays `n_episodes` episodes, whose goals are fixed by `seed`, on all cores.
    pub(crate) fn play(&self, n_episodes: u64, seed: u64) -> Result<Vec<Episode>, Failed> {
        let actor = self.policy().actor().or_exit(Exit::Data, String::new)?;
        let (layout, world) = (self.layout(), WorldConfig::default());
        let n_threads = std::thread::available_parallelism().unwrap_or(NonZeroUsize::MIN);
        let episodes = match self {
            Self::Policy(_) => evaluate(&actor, layout, &world, n_episodes, seed, n_threads),
            Self::Composed(..) => {
                evaluate_composed(&actor, layout, &world, n_episodes, seed, n_threads)
            }
        };
        episodes.or_exit(Exit::Bug, String::new)
    }
}

/// Refuses a policy of a task that the simulator does not have.
fn simulated(policy: Policy, path: &Path) -> Result<Policy, Failed> {
    match policy.layout.as_built_in() {
        Some(_) => Ok(policy),
        None => Err(Failed::usage(format!(
            "{} is for task {:?}, which the simulator does not have: evaluate it with the learner of its run",
            path.display(),
            policy.layout.name()
        ))),
    }
}

/// The episodes and the results of an evaluation.
pub(crate) struct EvaluationResult {
    pub(crate) episodes: Vec<Episode>,
    pub(crate) layout: Layout,
    pub(crate) summary: EvaluationSummary,
    pub(crate) steps_per_s: f64,
    pub(crate) policy_digest: String,
}

/// Plays `n_episodes` episodes and summarizes them.
pub(crate) fn measure(
    subject: &EvaluatedPolicy,
    n_episodes: u64,
    seed: u64,
) -> Result<EvaluationResult, Failed> {
    let start = clock::now();
    let episodes = subject.play(n_episodes, seed)?;
    let n_steps = episodes.len() * tandem_core::layout::EPISODE_STEPS;
    let steps_per_s = n_steps as f64 / start.elapsed().as_secs_f64();
    let outcomes: Vec<EpisodeOutcome> = episodes.iter().map(EpisodeOutcome::of).collect();
    let summary = EvaluationSummary::of(&outcomes);
    Ok(EvaluationResult {
        episodes,
        layout: subject.layout(),
        summary,
        steps_per_s,
        policy_digest: subject.policy().digest(),
    })
}

impl EvaluationResult {
    pub(crate) fn json(&self) -> Value {
        json!({
            "task": self.layout.task.name(),
            "arms": self.layout.n_arms,
            "episodes": self.summary.n_episodes,
            "success": self.summary.success,
            "success_low": self.summary.interval.low,
            "success_high": self.summary.interval.high,
            "success_joint": self.summary.success_joint,
            "success_per_arm": self.summary.success_per_arm,
            "collision_rate": self.summary.collision_rate,
            "collision_rate_before_success": self.summary.collision_rate_before_success,
            "mean_return": self.summary.mean_return,
            "steps_per_s": self.steps_per_s,
            "policy_digest": self.policy_digest,
        })
    }

    /// Returns the results as text, one line each.
    pub(crate) fn lines(&self) -> Vec<String> {
        let summary = &self.summary;
        let share = |label: &str, share: f64| {
            let Wilson { low, high } = summary.interval_of(share);
            format!("{label:<13} {share:.3}   95 % interval {low:.3} to {high:.3}")
        };
        let mut lines = vec![
            format!("{}, {} episodes", share("success", summary.success), summary.n_episodes),
            share("joint norm", summary.success_joint),
        ];
        let arms = summary.success_per_arm.iter().enumerate();
        lines.extend(arms.map(|(arm, success)| share(&format!("arm {}", arm + 1), *success)));
        lines.push(format!(
            "{}, {:.3} before success",
            share("collisions", summary.collision_rate),
            summary.collision_rate_before_success
        ));
        lines.push(format!("mean return   {:.1}", summary.mean_return));
        lines
    }
}
