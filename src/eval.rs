//! `tandem eval`: a policy alone on fixed goals.

use std::num::NonZeroUsize;
use std::path::Path;

use rayon::iter::{IntoParallelRefIterator as _, ParallelIterator as _};
use serde_json::{Value, json};
use tandem_core::work::{EpisodeOrder, RunTerms};
use tandem_core::{
    Episode, EpisodeOutcome, EvaluationSummary, Exploration, Layout, Task, Wilson, WorldSettings,
};
use tandem_policy::Policy;
use tandem_sim::WorldConfig;
use tandem_telemetry::EpisodeMetadata;
use tandem_worker::record::{RecordError, log_name, metadata_of, record_episode};
use tandem_worker::{ComposedTeachers, evaluate};

use crate::cli::{EvalArgs, TaskName};
use crate::clock;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::files::load_policy;
use crate::output;

/// Who acts in an evaluation.
#[derive(Debug, Clone)]
pub(crate) enum Subject {
    /// A policy for all arms of its layout.
    Policy(Policy),
    /// A one-arm policy for each of so many arms.
    Composed(Policy, usize),
}

impl Subject {
    pub(crate) fn layout(&self) -> Layout {
        match self {
            Self::Policy(policy) => policy.layout,
            Self::Composed(policy, n_arms) => Layout::new(policy.layout.task, *n_arms),
        }
    }

    pub(crate) const fn policy(&self) -> &Policy {
        match self {
            Self::Policy(policy) | Self::Composed(policy, _) => policy,
        }
    }

    /// Plays `n_episodes` fixed goals on every core.
    pub(crate) fn play(&self, n_episodes: u64, seed: u64) -> Result<Vec<Episode>, Failed> {
        let actor = self.policy().actor().or_exit(Exit::Data, String::new)?;
        let (layout, world) = (self.layout(), WorldConfig::default());
        let n_threads = std::thread::available_parallelism().unwrap_or(NonZeroUsize::MIN);
        let episodes = match self {
            Self::Policy(_) => {
                evaluate(|| actor.clone(), layout, &world, n_episodes, seed, n_threads)
            }
            Self::Composed(..) => evaluate(
                || ComposedTeachers(actor.clone()),
                layout,
                &world,
                n_episodes,
                seed,
                n_threads,
            ),
        };
        episodes.or_exit(Exit::Bug, String::new)
    }
}

/// An evaluation's episodes and figures, and how fast it went.
pub(crate) struct Measured {
    pub(crate) episodes: Vec<Episode>,
    pub(crate) layout: Layout,
    pub(crate) summary: EvaluationSummary,
    pub(crate) steps_per_s: f64,
    pub(crate) policy_digest: String,
}

/// Plays and sums up.
pub(crate) fn measure(subject: &Subject, n_episodes: u64, seed: u64) -> Result<Measured, Failed> {
    let start = clock::now();
    let episodes = subject.play(n_episodes, seed)?;
    let n_steps = episodes.len() * tandem_core::layout::EPISODE_STEPS;
    let steps_per_s = n_steps as f64 / start.elapsed().as_secs_f64();
    let outcomes: Vec<EpisodeOutcome> = episodes.iter().map(EpisodeOutcome::of).collect();
    let summary = EvaluationSummary::of(&outcomes);
    Ok(Measured {
        episodes,
        layout: subject.layout(),
        summary,
        steps_per_s,
        policy_digest: subject.policy().digest(),
    })
}

impl Measured {
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

    /// The figures for a person, a line each.
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

pub(crate) fn eval(args: &EvalArgs) -> Result<(), Failed> {
    let subject = subject(args)?;
    let measured = measure(&subject, args.episodes, args.seed)?;
    let terms = terms(&subject);
    if let (Some(path), Some(first)) = (&args.record, measured.episodes.first()) {
        record(&subject, &terms, args.seed, first, path)?;
    }
    if let Some(directory) = &args.record_dir {
        std::fs::create_dir_all(directory)
            .or_cannot_write(|| format!("cannot create {}", directory.display()))?;
        measured.episodes.par_iter().try_for_each(|episode| {
            let path = directory.join(log_name(episode));
            record(&subject, &terms, args.seed, episode, &path)
        })?;
    }
    if args.json {
        output::print(measured.json())?;
    } else {
        let layout = measured.layout;
        output::print(format_args!(
            "task          {}, arms {}, seed {}",
            layout.task, layout.n_arms, args.seed
        ))?;
        measured.lines().iter().try_for_each(output::print)?;
        output::print(format_args!("speed         {:.0} env steps/s", measured.steps_per_s))?;
        for path in args.record.iter().chain(&args.record_dir) {
            output::print(format_args!("recorded      {}", path.display()))?;
        }
    }
    Ok(())
}

/// The terms on which an evaluation plays.
fn terms(subject: &Subject) -> RunTerms {
    RunTerms {
        layout: subject.layout(),
        account: None,
        exploration: Exploration::NONE,
        world: WorldSettings::default(),
    }
}

/// Writes the log of one episode of the goals that `seed` fixes.
fn record(
    subject: &Subject,
    terms: &RunTerms,
    seed: u64,
    episode: &Episode,
    path: &Path,
) -> Result<(), Failed> {
    // The whole log takes the place of what has its name: that must not be a device or a pipe.
    if std::fs::metadata(path).is_ok_and(|there| !there.is_file() && !there.is_dir()) {
        return Err(Failed::usage(format!("cannot write {path:?}: it is not a regular file")));
    }
    let number = episode.number;
    let order = EpisodeOrder { number, seed, advised: false, uniform: false, record: true };
    let metadata = EpisodeMetadata {
        policy_digest: subject.policy().digest(),
        ..metadata_of(order, episode, terms)
    };
    match record_episode(&metadata, episode, path) {
        Ok(_) => Ok(()),
        Err(error @ RecordError::Log(_)) => Err(error).or_cannot_write(String::new),
        Err(error) => Err(Failed::new(Exit::Bug, error)),
    }
}

fn subject(args: &EvalArgs) -> Result<Subject, Failed> {
    let subject = match (&args.policy, &args.composed_teachers) {
        (Some(path), _) => Subject::Policy(load_policy(path)?),
        (None, Some(path)) => composed(load_policy(path)?, args.arms.unwrap_or(2), path)?,
        (None, None) => return Err(Failed::usage("give --policy or --composed-teachers")),
    };
    let layout = subject.layout();
    let asked_task = args.task.map_or(layout.task, task);
    let asked_arms = args.arms.unwrap_or(layout.n_arms);
    if (asked_task, asked_arms) != (layout.task, layout.n_arms) {
        return Err(Failed::usage(format!(
            "the policy is for {} with {} arm(s), not {asked_task} with {asked_arms}",
            layout.task, layout.n_arms
        )));
    }
    Ok(subject)
}

/// A one-arm policy for `n_arms` arms.
pub(crate) fn composed(policy: Policy, n_arms: usize, path: &Path) -> Result<Subject, Failed> {
    if policy.layout.n_arms != 1 {
        return Err(Failed::usage(format!(
            "{} drives {} arms: a teacher drives one",
            path.display(),
            policy.layout.n_arms
        )));
    }
    if !(1..=2).contains(&n_arms) {
        return Err(Failed::usage(format!("--arms {n_arms}: expected 1 or 2")));
    }
    Ok(Subject::Composed(policy, n_arms))
}

pub(crate) const fn task(name: TaskName) -> Task {
    match name {
        TaskName::Push => Task::Push,
        TaskName::PickAndPlace => Task::PickAndPlace,
    }
}
