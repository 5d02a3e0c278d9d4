//! Evaluations in the environments of a server.

use tandem_core::{Episode, TaskSpec};
use tandem_net::ClientConfig;
use tandem_policy::Policy;
use tandem_worker::{ComposedTeachers, EnvironmentConfig, ServedTask, evaluate_served};

use super::{EvaluationResult, Outcomes, Take};
use crate::cli::EnvironmentArgs;
use crate::environment_server::EnvironmentSource;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::service::worker_failed;
use crate::{clock, runtime, signals};

/// The part that the evaluated policy takes in an environment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Part {
    /// The policy drives all arms.
    AllArms,
    /// Copies of a one-arm policy drive one arm each, of so many if a number is given.
    EachArm(Option<usize>),
}

/// Evaluates a policy in the environments of a server.
///
/// `goals` is the number of episodes, and the seed from which the server derives their starts and goals. Signals
/// interrupt the evaluation and, if `exit_with_stdin`, the end of standard input.
pub(crate) fn measure_served(
    environment: &EnvironmentArgs,
    (part, policy): (Part, &Policy),
    goals: (u64, u64),
    take: Take<'_>,
    exit_with_stdin: bool,
) -> Result<EvaluationResult, Failed> {
    let runtime = runtime::new().or_exit(Exit::TryAgain, String::new)?;
    runtime.block_on(async {
        let interrupted = signals::shutdown_token(exit_with_stdin)?;
        let source = EnvironmentSource::of(environment, &ClientConfig::default())?;
        let measured = tokio::select! {
            measured = measure(&source, (part, policy), goals, take) => measured,
            () = interrupted.cancelled() => {
                Err(Failed::new(Exit::Interrupted, anyhow::anyhow!("interrupted")))
            }
        };
        source.end().await;
        measured
    })
}

async fn measure(
    source: &EnvironmentSource,
    (part, policy): (Part, &Policy),
    goals: (u64, u64),
    take: Take<'_>,
) -> Result<EvaluationResult, Failed> {
    let (Some(config), Some(served)) =
        (source.config(), source.served_task().await.map_err(worker_failed)?)
    else {
        return Err(Failed::usage(
            "name the server of the environments with --env or --env-command",
        ));
    };
    check_task(part, policy, &served)?;
    let (start, mut outcomes) = (clock::now(), Outcomes::default());
    let mut add = |episodes: Vec<Episode>| {
        outcomes.add(&episodes);
        take(episodes);
    };
    play(config, (part, policy), &served.task, goals, &mut add).await?;
    outcomes.elapsed = start.elapsed();
    Ok(outcomes.result(served.task, policy.digest()))
}

async fn play(
    config: EnvironmentConfig,
    (part, policy): (Part, &Policy),
    task: &TaskSpec,
    goals: (u64, u64),
    take: Take<'_>,
) -> Result<(), Failed> {
    let actor = policy.actor().or_exit(Exit::Data, String::new)?;
    let played = match part {
        Part::AllArms => evaluate_served(config, actor, task, goals, take).await,
        Part::EachArm(_) => {
            let composed = ComposedTeachers::new(actor, task);
            evaluate_served(config, composed, task, goals, take).await
        }
    };
    played.map_err(worker_failed)
}

/// Rejects a server of another task than the policy's.
fn check_task(part: Part, policy: &Policy, served: &ServedTask) -> Result<(), Failed> {
    let (server, name) = (&served.server, served.task.name());
    let (task, of_server) = match part {
        Part::AllArms => (served.task.clone(), ""),
        Part::EachArm(Some(n_arms)) if n_arms != served.task.n_arms() => {
            return Err(Failed::usage(format!(
                "--arms {n_arms}: task {name:?} of the environment server {server} has {}",
                served.task.n_arms()
            )));
        }
        Part::EachArm(_) => match served.task.single_arm() {
            Some(one_arm) => (one_arm, "one arm of "),
            None => {
                return Err(Failed::usage(format!(
                    "the arms of task {name:?} of the environment server {server} are not instances of one task of \
                     one arm: a one-arm policy cannot control them"
                )));
            }
        },
    };
    match policy.task.difference(&task) {
        Some(difference) => Err(Failed::usage(format!(
            "the environment server {server} serves another task than the policy's: {} is {} in the policy and {} for \
             {of_server}the server's task",
            difference.field, difference.first, difference.second
        ))),
        None => Ok(()),
    }
}
