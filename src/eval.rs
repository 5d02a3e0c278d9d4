//! `tandem eval`: evaluates a policy on fixed goals.

mod baselines;
mod files;
mod robustness;

use std::path::Path;

use tandem_core::text::counted;
use tandem_core::{EvaluationSummary, TaskSpec, Wilson};

use crate::cli::{EvalArgs, check_layout, check_n_arms, check_task, chosen_task};
use crate::environment_server::names_server;
use crate::evaluation::{EvaluatedPolicy, EvaluationResult, Part, measure, measure_served};
use crate::exit::{Failed, OrExit as _};
use crate::film::PlannedFilm;
use crate::{live, output, policy_file};
use baselines::Baselines;
use files::EpisodeFiles;
use robustness::Robustness;

pub(crate) fn eval(args: &EvalArgs) -> Result<(), Failed> {
    if names_server(&args.environment) {
        return eval_served(args);
    }
    let film = PlannedFilm::of(&args.film)?;
    args.live.live.map_or(Ok(()), live::check_address)?;
    args.record.as_deref().map_or(Ok(()), check_record)?;
    check_distinct_files(args)?;
    if let Some(directory) = &args.record_dir {
        std::fs::create_dir_all(directory)
            .or_cannot_write(|| format!("cannot create {}", directory.display()))?;
    }
    let subject = subject(args)?;
    subject.warn_if_trained_on(args.seed);
    if args.robustness {
        return Robustness::measure(args, &subject)?.print(args);
    }
    let mut files = EpisodeFiles::new(args, &subject);
    let goals = (args.episodes, args.seed);
    let result = measure(&subject, goals, &mut |episodes| files.take(&episodes))?;
    let baselines = Baselines::measure(args, &subject)?;
    let saved = files.finish(film);
    // Also if a file could not be written: the evaluation may have taken hours.
    print(args, &result, &baselines)?;
    let logs = saved?;
    print_files(args)?;
    args.live.live.map_or(Ok(()), |address| live::serve(address, logs.paths()))
}

/// Evaluates a policy in the environments of a server.
fn eval_served(args: &EvalArgs) -> Result<(), Failed> {
    if args.baselines {
        return Err(Failed::usage(
            "--baselines needs the simulator of this program: leave out --env and --env-command",
        ));
    }
    if args.record.is_some()
        || args.record_dir.is_some()
        || args.film.film.is_some()
        || args.live.live.is_some()
    {
        return Err(Failed::usage(
            "--record, --record-dir, --film and --live need the simulator of this program: leave out --env and --env-command",
        ));
    }
    let (part, path) = match (&args.policy, &args.composed_teachers) {
        (Some(path), _) => (Part::AllArms, path),
        (None, Some(path)) => (Part::EachArm(args.arms), path),
        (None, None) => return Err(no_policy()),
    };
    let policy = policy_file::load(path)?;
    check_required(args, &policy.task, part)?;
    let goals = (args.episodes, args.seed);
    let result = measure_served(&args.environment, (part, &policy), goals, &mut |_| {}, false)?;
    print(args, &result, &Baselines::none())
}

fn print(args: &EvalArgs, result: &EvaluationResult, baselines: &Baselines) -> Result<(), Failed> {
    if args.json {
        let mut value = baselines.json(result);
        value["seed"] = args.seed.into();
        return output::print(value);
    }
    let (task, n_arms) = (result.task.name(), result.task.n_arms());
    let arms = counted(n_arms, "arm");
    output::print(format_args!("task          {task}, {arms}, seed {}", args.seed))?;
    result.lines().iter().try_for_each(output::print)?;
    baselines.table(result).map_or(Ok(()), output::print)?;
    output::print(format_args!("speed         {:.0} env steps/s", result.steps_per_s))
}

/// Prints the files that were written.
fn print_files(args: &EvalArgs) -> Result<(), Failed> {
    if args.json {
        return Ok(());
    }
    let recorded = args.record.iter().chain(&args.record_dir);
    recorded
        .map(|path| path.display())
        .try_for_each(|path| output::print(format_args!("recorded      {path}")))?;
    let film = args.film.film.iter().map(|path| path.display());
    film.into_iter().try_for_each(|path| output::print(format_args!("film          {path}")))
}

/// Formats a share of the episodes of `summary` with its interval.
fn share_text(summary: &EvaluationSummary, share: f64) -> String {
    let Wilson { low, high } = summary.interval_of(share);
    format!("{share:.3} [{low:.3}, {high:.3}]")
}

/// Checks that a log may replace what is at `path`: a file, and not a directory, a device or a pipe.
fn check_record(path: &Path) -> Result<(), Failed> {
    match std::fs::metadata(path).is_ok_and(|there| !there.is_file()) {
        true => Err(Failed::usage(format!("cannot write {path:?}: it is not a regular file"))),
        false => output::check_directory_of(path),
    }
}

/// Rejects outputs that would replace each other or a policy.
fn check_distinct_files(args: &EvalArgs) -> Result<(), Failed> {
    let outputs = [("--record", args.record.as_deref()), ("--film", args.film.film.as_deref())];
    output::check_distinct(&outputs)?;
    let policies = [
        ("--policy", &args.policy),
        ("--composed-teachers", &args.composed_teachers),
        ("--teacher", &args.teacher),
    ];
    for (name, path) in policies {
        // A policy that is missing is reported when it is read.
        let file = path.as_deref().and_then(|path| policy_file::file_of(path).ok());
        file.map_or(Ok(()), |file| output::check_keeps(&outputs, (name, &file)))?;
    }
    Ok(())
}

fn subject(args: &EvalArgs) -> Result<EvaluatedPolicy, Failed> {
    let subject = match (&args.policy, &args.composed_teachers) {
        (Some(path), _) => EvaluatedPolicy::new(policy_file::load(path)?, path)?,
        (None, Some(path)) => {
            let task = chosen_task(args.task, args.world)?;
            EvaluatedPolicy::composed(
                policy_file::load(path)?,
                (task, args.arms.unwrap_or(2)),
                path,
            )?
        }
        (None, None) => return Err(no_policy()),
    };
    check_layout(subject.layout(), (args.task, args.world), args.arms)?;
    Ok(subject)
}

/// Rejects a task other than the one that the command line requires; for a part of the arms, whatever their number.
fn check_required(args: &EvalArgs, task: &TaskSpec, part: Part) -> Result<(), Failed> {
    let named = (args.task, args.world);
    match task.as_built_in() {
        Some(layout) if part == Part::AllArms => check_layout(layout, named, args.arms),
        Some(layout) => check_task(layout.task, args.task, args.world),
        None if named == (None, None) => match args.arms {
            Some(n_arms) if part == Part::AllArms => check_n_arms(task.n_arms(), n_arms),
            _ => Ok(()),
        },
        None => Err(Failed::usage(format!(
            "the policy is for {}, which is no task of the simulator: leave out --task and --world",
            task.name()
        ))),
    }
}

fn no_policy() -> Failed {
    Failed::usage("give --policy or --composed-teachers")
}
