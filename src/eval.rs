//! `tandem eval`: evaluates a policy on fixed goals.

use std::path::Path;

use rayon::iter::{IntoParallelRefIterator as _, ParallelIterator as _};
use tandem_core::work::{EpisodeOrder, RunTerms};
use tandem_core::{AdviceTerms, Episode, Exploration, Task, WorldSettings};
use tandem_worker::record::{RecordError, log_name, metadata_of, record_episode};

use crate::cli::EvalArgs;
use crate::evaluation::{EvaluatedPolicy, measure};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{output, policy_file};

pub(crate) fn eval(args: &EvalArgs) -> Result<(), Failed> {
    let subject = subject(args)?;
    let result = measure(&subject, args.episodes, args.seed)?;
    let terms = terms(&subject);
    if let (Some(path), Some(first)) = (&args.record, result.episodes.first()) {
        record(&subject, &terms, args.seed, first, path)?;
    }
    if let Some(directory) = &args.record_dir {
        std::fs::create_dir_all(directory)
            .or_cannot_write(|| format!("cannot create {}", directory.display()))?;
        result.episodes.par_iter().try_for_each(|episode| {
            let path = directory.join(log_name(episode));
            record(&subject, &terms, args.seed, episode, &path)
        })?;
    }
    if args.json {
        output::print(result.json())?;
    } else {
        let layout = result.layout;
        output::print(format_args!(
            "task          {}, arms {}, seed {}",
            layout.task, layout.n_arms, args.seed
        ))?;
        result.lines().iter().try_for_each(output::print)?;
        output::print(format_args!("speed         {:.0} env steps/s", result.steps_per_s))?;
        for path in args.record.iter().chain(&args.record_dir) {
            output::print(format_args!("recorded      {}", path.display()))?;
        }
    }
    Ok(())
}

/// Returns the terms of an evaluation, for the metadata of its logs.
fn terms(subject: &EvaluatedPolicy) -> RunTerms {
    RunTerms {
        run: String::new(),
        layout: subject.layout().into(),
        account: None,
        advice: AdviceTerms::default(),
        exploration: Exploration::NONE,
        world: WorldSettings::default(),
    }
}

/// Writes the log of one episode of an evaluation with `seed`.
fn record(
    subject: &EvaluatedPolicy,
    terms: &RunTerms,
    seed: u64,
    episode: &Episode,
    path: &Path,
) -> Result<(), Failed> {
    // The complete log replaces the file of its name, which must not be a device or a pipe.
    if std::fs::metadata(path).is_ok_and(|there| !there.is_file() && !there.is_dir()) {
        return Err(Failed::usage(format!("cannot write {path:?}: it is not a regular file")));
    }
    let number = episode.number;
    let order = EpisodeOrder { number, seed, advised: false, uniform: false, record: true };
    let metadata = metadata_of(order, episode, terms, subject.policy().digest());
    let metadata = metadata.expect("an evaluated policy is for a simulated task");
    match record_episode(&metadata, episode, path) {
        Ok(_) => Ok(()),
        Err(error @ RecordError::Log(_)) => Err(error).or_cannot_write(String::new),
        Err(error) => Err(Failed::new(Exit::Bug, error)),
    }
}

fn subject(args: &EvalArgs) -> Result<EvaluatedPolicy, Failed> {
    let subject = match (&args.policy, &args.composed_teachers) {
        (Some(path), _) => EvaluatedPolicy::new(policy_file::load(path)?, path)?,
        (None, Some(path)) => {
            EvaluatedPolicy::composed(policy_file::load(path)?, args.arms.unwrap_or(2), path)?
        }
        (None, None) => return Err(Failed::usage("give --policy or --composed-teachers")),
    };
    let layout = subject.layout();
    let required_task = args.task.map_or(layout.task, Task::from);
    let required_arms = args.arms.unwrap_or(layout.n_arms);
    if (required_task, required_arms) != (layout.task, layout.n_arms) {
        return Err(Failed::usage(format!(
            "the policy is for {} with {} arm(s), not {required_task} with {required_arms}",
            layout.task, layout.n_arms
        )));
    }
    Ok(subject)
}
