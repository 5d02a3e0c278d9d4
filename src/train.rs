//! `tandem train`: one command that starts learner, teacher and workers as processes, watches them and reports.

mod children;
mod display;
mod plan;
mod summary;

use std::time::Duration;

use anyhow::{Context as _, anyhow};
use tandem_proto::pb;
use tandem_proto::pb::learner_client::LearnerClient;
use tokio_util::sync::CancellationToken;

use crate::cli::TrainArgs;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{services, signals};
use children::{Children, Memory};
use display::Display;
use plan::Plan;

/// How long a process may take to say where it listens; loading a checkpoint is the longest part.
const START_DEADLINE: Duration = Duration::from_secs(60);
/// How long processes may take to save and end.
const END_DEADLINE: Duration = Duration::from_secs(60);

pub(crate) fn train(args: &TrainArgs) -> Result<(), Failed> {
    let plan = Plan::of(args)?;
    plan.prepare()?;
    let runtime = services::runtime().or_exit(Exit::TryAgain, String::new)?;
    let (last, memory) = runtime.block_on(async {
        let interrupted = signals::shutdown_token(false).or_exit(Exit::TryAgain, String::new)?;
        run(&plan, &interrupted).await
    })?;
    if last.end_reason == "interrupted" {
        summary::interrupted(&plan, &last);
        return Err(Failed::new(Exit::Interrupted, anyhow!("interrupted")));
    }
    summary::print(&plan, &last, memory, args.json)
}

/// Starts every process, watches until the run has ended, and ends every process.
async fn run(
    plan: &Plan,
    interrupted: &CancellationToken,
) -> Result<(pb::Progress, Memory), Failed> {
    let mut display = Display::new(plan);
    let mut children = Children::new(plan).or_exit(Exit::TryAgain, String::new)?;
    let started = tokio::time::timeout(START_DEADLINE, children.start(plan));
    started
        .await
        .context("a process did not say in time where it listens")
        .and_then(|started| started)
        .or_exit(Exit::TryAgain, || format!("cannot start; see {}", plan.log_path().display()))?;
    let last = watch(plan, &mut children, &mut display, interrupted).await;
    display.close();
    if interrupted.is_cancelled() {
        display.say("interrupted: saving, a second Ctrl-C ends at once");
    }
    let again = signals::shutdown_token(false).or_exit(Exit::TryAgain, String::new)?;
    tokio::select! {
        () = children.end(END_DEADLINE) => (),
        () = again.cancelled() => (),
    }
    let last = last.or_exit(Exit::TryAgain, || broke_off(plan))?;
    if last.ended && !interrupted.is_cancelled() {
        return Ok((last, children.memory()));
    }
    Ok((pb::Progress { end_reason: "interrupted".to_owned(), ..last }, children.memory()))
}

/// Says where to look and how to go on.
fn broke_off(plan: &Plan) -> String {
    let (log, out) = (plan.log_path(), plan.out.display());
    let how_to_go_on = if tandem_learner::checkpoint::list(&plan.out.join("checkpoint")).is_empty()
    {
        "nothing was saved yet".to_owned()
    } else {
        format!("go on with `tandem train --resume --out {out}`")
    };
    format!("the run broke off, {how_to_go_on}; see {}", log.display())
}

/// Follows the learner's progress to its end, and keeps the workers alive.
async fn watch(
    plan: &Plan,
    children: &mut Children,
    display: &mut Display,
    interrupted: &CancellationToken,
) -> anyhow::Result<pb::Progress> {
    let mut learner = LearnerClient::connect(services::uri(children.learner_address()))
        .await
        .context("cannot reach the learner that was just started")?;
    let mut stream = learner.watch(pb::WatchRequest {}).await?.into_inner();
    let mut last = pb::Progress::default();
    let mut look = tokio::time::interval(Duration::from_millis(500));
    loop {
        tokio::select! {
            message = stream.message() => match message {
                Ok(Some(progress)) => {
                    display.show(&progress);
                    last = progress;
                    if last.ended {
                        return failed_or(last);
                    }
                }
                Ok(None) => return failed_or(last),
                Err(status) => {
                    tokio::time::sleep(Duration::from_millis(300)).await;
                    children.check(plan)?;
                    return Err(anyhow!("the learner is gone: {}", status.message()));
                }
            },
            _ = look.tick() => {
                for line in children.check(plan)? {
                    display.say(&line);
                }
            }
            () = interrupted.cancelled() => return Ok(last),
        }
    }
}

/// The last progress, unless the learner ended because of an error.
fn failed_or(last: pb::Progress) -> anyhow::Result<pb::Progress> {
    if last.ended && last.digest.is_empty() && last.end_reason != "interrupted" {
        return Err(anyhow!("{}", last.end_reason));
    }
    Ok(last)
}
