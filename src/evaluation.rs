//! Evaluations: a policy alone on fixed goals, without noise or advice.

mod served;

use std::num::NonZeroUsize;
use std::ops::Range;
use std::path::Path;
use std::time::Duration;

use serde_json::{Value, json};
use tandem_core::text::counted;
use tandem_core::{Episode, EpisodeOutcome, EvaluationSummary, Layout, Task, TaskSpec, Wilson};
use tandem_policy::{Actor, BlindActor, Policy};
use tandem_sim::WorldConfig;
use tandem_telemetry::ContactMetrics;
use tandem_worker::{Act, ComposedTeachers, Evaluation, Perturbation, PerturbedActor};

use crate::environment_file::server_options;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::shell::shell_word;
use crate::{clock, output};

pub(crate) use served::{Part, measure_served};

/// Largest number of arms in the simulator.
const MAX_ARMS: usize = 2;

/// The policy that acts in an evaluation.
#[derive(Debug, Clone)]
pub(crate) enum EvaluatedPolicy {
    /// A policy for all arms of its layout.
    Policy(Policy),
    /// A policy whose arms do not see each other.
    Blind(Policy),
    /// A one-arm policy that controls each arm of a layout.
    Composed(Policy, Layout),
}

impl EvaluatedPolicy {
    /// Evaluates the policy that was loaded from `path`.
    pub(crate) fn new(policy: Policy, path: &Path) -> Result<Self, Failed> {
        simulated(policy, path).map(Self::Policy)
    }

    /// Composes copies of the one-arm policy that was loaded from `path`, one for each of `n_arms` arms: for `task`, if
    /// the policy performs the part of one of its arms, otherwise for the policy's own task.
    pub(crate) fn composed(
        policy: Policy,
        (task, n_arms): (Option<Task>, usize),
        path: &Path,
    ) -> Result<Self, Failed> {
        let policy = simulated(policy, path)?;
        if policy.task.n_arms() != 1 {
            return Err(Failed::usage(format!(
                "{} drives {} arms: a teacher drives one",
                path.display(),
                policy.task.n_arms()
            )));
        }
        if !(1..=MAX_ARMS).contains(&n_arms) {
            return Err(Failed::usage(format!("--arms {n_arms}: expected 1 or 2")));
        }
        let own = built_in(&policy).task;
        let task = task.filter(|task| task.of_one_arm() == own).unwrap_or(own);
        if n_arms < task.min_arms() {
            return Err(Failed::usage(format!("--arms {n_arms}: {task} takes two arms")));
        }
        Ok(Self::Composed(policy, Layout::new(task, n_arms)))
    }

    pub(crate) fn layout(&self) -> Layout {
        match self {
            Self::Policy(policy) | Self::Blind(policy) => built_in(policy),
            Self::Composed(_, layout) => *layout,
        }
    }

    pub(crate) const fn policy(&self) -> &Policy {
        match self {
            Self::Policy(policy) | Self::Blind(policy) | Self::Composed(policy, _) => policy,
        }
    }

    /// Warns if the run of the policy played training episodes or evaluations from `seed`, so that an evaluation on
    /// these starts and goals is no test.
    pub(crate) fn warn_if_trained_on(&self, seed: u64) {
        let metadata = &self.policy().metadata;
        let is_seed =
            |key: &str| metadata.get(key).is_some_and(|of_run| *of_run == seed.to_string());
        let purpose = match (is_seed("seed"), is_seed("evaluation_seed")) {
            (true, _) => "trained",
            (_, true) => "selected",
            (false, false) => return,
        };
        output::message(format_args!(
            "tandem: warning: the policy was {purpose} on the goals of seed {seed}: choose another --seed for a test"
        ));
    }

    /// Plays the episodes with these numbers, whose goals are fixed by `seed`, on all cores.
    pub(crate) fn play(&self, numbers: Range<u64>, seed: u64) -> Result<Vec<Episode>, Failed> {
        let (actor, layout) = (self.actor()?, self.layout());
        let world = &WorldConfig::default();
        let evaluation = Evaluation { layout, world, seed, numbers, n_threads: n_threads() };
        evaluation.run(|_| actor.clone()).or_exit(Exit::Bug, String::new)
    }

    fn actor(&self) -> Result<EvaluatedActor, Failed> {
        let of_policy = |policy: &Policy| policy.actor().or_exit(Exit::Data, String::new);
        match self {
            Self::Policy(policy) => of_policy(policy).map(EvaluatedActor::Policy),
            Self::Blind(policy) => {
                let blind = BlindActor::new(policy).or_exit(Exit::Data, String::new);
                blind.map(EvaluatedActor::Blind)
            }
            Self::Composed(policy, layout) => {
                let composed = ComposedTeachers::new(of_policy(policy)?, *layout);
                Ok(EvaluatedActor::Composed(composed))
            }
        }
    }
}

/// The actor of an [`EvaluatedPolicy`].
#[derive(Debug, Clone)]
enum EvaluatedActor {
    Policy(Actor),
    Blind(BlindActor),
    Composed(ComposedTeachers<Actor>),
}

impl Act for EvaluatedActor {
    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
        match self {
            Self::Policy(actor) => actor.act(observations, goals, actions),
            Self::Blind(actor) => actor.act(observations, goals, actions),
            Self::Composed(actor) => actor.act(observations, goals, actions),
        }
    }
}

/// Returns the layout of a policy that [`simulated`] has not refused.
fn built_in(policy: &Policy) -> Layout {
    policy.task.as_built_in().expect("the constructors refuse policies of other tasks")
}

/// Refuses a policy of a task, or of a number of arms, that the simulator does not have.
fn simulated(policy: Policy, path: &Path) -> Result<Policy, Failed> {
    match policy.task.as_built_in() {
        Some(Layout { task, n_arms }) if (task.min_arms()..=MAX_ARMS).contains(&n_arms) => {
            Ok(policy)
        }
        Some(Layout { task, n_arms }) => Err(Failed::usage(format!(
            "{} drives {}, with which the simulator has no {task}",
            path.display(),
            counted(n_arms, "arm")
        ))),
        None => Err(Failed::usage(format!(
            "{} is for task {:?}, which the simulator does not have: evaluate it with {}",
            path.display(),
            policy.task.name(),
            evaluation_command(path)
        ))),
    }
}

/// Returns the command that evaluates the policy of a task of a server, with the server of its run if that is known.
fn evaluation_command(path: &Path) -> String {
    let run = if path.is_dir() { Some(path) } else { path.parent().and_then(Path::parent) };
    match run.and_then(server_options) {
        Some(options) => format!("`tandem eval --policy {} {options}`", shell_word(path)),
        None => "`tandem eval --env ADDR` or `--env-command CMD`".to_owned(),
    }
}

/// The result of an evaluation.
pub(crate) struct EvaluationResult {
    pub(crate) task: TaskSpec,
    pub(crate) summary: EvaluationSummary,
    pub(crate) steps_per_s: f64,
    pub(crate) policy_digest: String,
}

/// Receives the episodes of an evaluation, some at a time, in the order of their numbers.
pub(crate) type Take<'a> = &'a mut dyn FnMut(Vec<Episode>);

/// Number of episodes that are in memory at once.
const N_AT_ONCE: u64 = 2_000;

/// Plays episodes and summarizes them. `goals` is the number of episodes, and the seed of their starts and goals.
pub(crate) fn measure(
    subject: &EvaluatedPolicy,
    goals: (u64, u64),
    take: Take<'_>,
) -> Result<EvaluationResult, Failed> {
    let (task, digest) = (subject.layout().into(), subject.policy().digest());
    let outcomes =
        Outcomes::of_parts(goals.0, take, &mut |numbers| subject.play(numbers, goals.1))?;
    Ok(outcomes.result(task, digest))
}

/// Plays episodes in another world or with errors, and summarizes them. The pair of numbers is the number of episodes,
/// and the seed of their starts and goals.
pub(crate) fn measure_perturbed(
    subject: &EvaluatedPolicy,
    (world, perturbation): (&WorldConfig, Perturbation),
    (n_episodes, seed): (u64, u64),
    take: Take<'_>,
) -> Result<EvaluationResult, Failed> {
    let (actor, layout) = (subject.actor()?, subject.layout());
    let perturbed = |number| PerturbedActor::new(actor.clone(), layout, perturbation, seed, number);
    let outcomes = Outcomes::of_parts(n_episodes, take, &mut |numbers| {
        let evaluation = Evaluation { layout, world, seed, numbers, n_threads: n_threads() };
        evaluation.run(perturbed).or_exit(Exit::Bug, String::new)
    })?;
    Ok(outcomes.result(layout.into(), subject.policy().digest()))
}

/// The outcomes of episodes that were played, and the time that this took.
#[derive(Default)]
struct Outcomes {
    outcomes: Vec<EpisodeOutcome>,
    n_steps: usize,
    elapsed: Duration,
}

impl Outcomes {
    /// Plays `n_episodes` episodes in parts, and calls `take` with each.
    fn of_parts(
        n_episodes: u64,
        take: Take<'_>,
        play: &mut dyn FnMut(Range<u64>) -> Result<Vec<Episode>, Failed>,
    ) -> Result<Self, Failed> {
        let mut outcomes = Self::default();
        let mut first = 0;
        while first < n_episodes {
            let end = n_episodes.min(first + N_AT_ONCE);
            let start = clock::now();
            let episodes = play(first..end)?;
            outcomes.elapsed += start.elapsed();
            outcomes.add(&episodes);
            take(episodes);
            first = end;
        }
        Ok(outcomes)
    }

    fn add(&mut self, episodes: &[Episode]) {
        self.n_steps += episodes.iter().map(Episode::n_steps).sum::<usize>();
        self.outcomes.extend(episodes.iter().map(EpisodeOutcome::of));
    }

    fn result(self, task: TaskSpec, policy_digest: String) -> EvaluationResult {
        EvaluationResult {
            summary: EvaluationSummary::of(&self.outcomes),
            steps_per_s: self.n_steps as f64 / self.elapsed.as_secs_f64(),
            task,
            policy_digest,
        }
    }
}

/// Returns the number of threads that play episodes.
fn n_threads() -> NonZeroUsize {
    std::thread::available_parallelism().unwrap_or(NonZeroUsize::MIN)
}

impl EvaluationResult {
    pub(crate) fn json(&self) -> Value {
        let contacts = ContactMetrics::of(&self.summary);
        let reported = |rate: f64| self.task.reports_contacts().then_some(rate);
        let mut value = json!({
            "task": self.task.name(),
            "arms": self.task.n_arms(),
            "episodes": self.summary.n_episodes,
            "success_without_contact": contacts.success_without_contact,
            "success_without_contact_low": contacts.success_without_contact_low,
            "success_without_contact_high": contacts.success_without_contact_high,
            "success": self.summary.success,
            "success_low": self.summary.interval.low,
            "success_high": self.summary.interval.high,
            "success_joint": self.summary.success_joint,
            "success_per_arm": self.summary.success_per_arm,
            "arm_contact_rate": contacts.arm_contact_rate,
            "table_contact_rate": contacts.table_contact_rate,
            "collision_rate": reported(self.summary.collision_rate),
            "collision_rate_before_success": reported(self.summary.collision_rate_before_success),
            "lost_goal_rate": self.summary.lost_goal_rate,
            "mean_return": self.summary.mean_return,
            "steps_per_s": self.steps_per_s,
            "policy_digest": self.policy_digest,
        });
        if let Some(avoidance_rate) = contacts.avoidance_rate {
            value["avoidance_rate"] = avoidance_rate.into();
        }
        value
    }

    /// Returns the results as text, one line each.
    pub(crate) fn lines(&self) -> Vec<String> {
        let (summary, n_arms) = (&self.summary, self.task.n_arms());
        let share = |label: &str, share: f64| {
            let Wilson { low, high } = summary.interval_of(share);
            format!("{label:<13} {share:.3}   95 % interval {low:.3} to {high:.3}")
        };
        let mut lines = Vec::new();
        if let Some(without_contact) = summary.success_without_contact.filter(|_| n_arms > 1) {
            let without_contact = share("no contact", without_contact);
            lines.push(format!("{without_contact}: success, arms never touch"));
        }
        lines.push(format!(
            "{}, {}",
            share("success", summary.success),
            counted(summary.n_episodes, "episode")
        ));
        if n_arms > 1 {
            let joint = share("joint goal", summary.success_joint);
            lines.push(format!("{joint}: norm of all distances"));
        }
        let arms = summary.success_per_arm.iter().enumerate().filter(|_| n_arms > 1);
        lines.extend(arms.map(|(arm, success)| share(&format!("arm {arm}"), *success)));
        let between_arms = summary.arm_contact_rate.filter(|_| n_arms > 1);
        let contacts =
            [("arm contact", between_arms), ("table contact", summary.table_contact_rate)];
        let known = contacts.into_iter().filter_map(|(label, rate)| Some(share(label, rate?)));
        lines.extend(known);
        if self.task.reports_contacts() {
            lines.push(format!(
                "{}, {:.3} before success",
                share("any contact", summary.collision_rate),
                summary.collision_rate_before_success
            ));
        }
        let avoidance = summary.avoidance_rate.map(|rate| share("avoidance", rate));
        lines.extend(avoidance.map(|avoidance| format!("{avoidance}: links kept apart")));
        let lost = share("lost goal", summary.lost_goal_rate);
        lines.push(format!("{lost}: achieved, not at the end"));
        lines.push(format!("mean return   {:.1}", summary.mean_return));
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_bounded_and_have_all_episodes_in_order() {
        let layout = Layout::new(Task::Push, 1);
        let mut numbers = Vec::new();
        let mut take = |episodes: Vec<Episode>| {
            assert!(episodes.len() as u64 <= N_AT_ONCE);
            numbers.extend(episodes.iter().map(|episode| episode.number));
        };
        let n_episodes = 2 * N_AT_ONCE + 1;
        let mut play = |numbers: Range<u64>| {
            Ok(numbers.map(|number| Episode::zeros(layout, number)).collect())
        };
        let outcomes = Outcomes::of_parts(n_episodes, &mut take, &mut play).expect("nothing fails");
        assert!(numbers.into_iter().eq(0..n_episodes));
        let summary = outcomes.result(layout.into(), String::new()).summary;
        assert_eq!(summary.n_episodes as u64, n_episodes);
    }
}
