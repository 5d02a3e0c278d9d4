//! `tandem status --watch`: follows a run to its end.

use std::time::Duration;

use anyhow::anyhow;
use tandem_learner::INTERRUPTED;
use tandem_proto::pb;
use tonic::{Code, Status};

use super::{Learner, call_with_timeout, failed};
use crate::cli::StatusArgs;
use crate::exit::{Exit, Failed};
use crate::output;
use crate::progress_json::progress_json;
use crate::progress_lines::ProgressLines;
use crate::run_directory::{self, RunState};
use crate::run_display::Display;

/// Pause before a learner that was lost is called again.
const PAUSE: Duration = Duration::from_millis(200);

/// The end of a stream of messages.
enum StreamEnd {
    /// The run has ended for this reason.
    Run(String),
    /// The learner is gone, or ends with an error.
    Lost(Failed),
    /// The learner cannot be reached.
    Unreachable(Failed),
}

/// Shows the progress until the run has ended. A run that is named by its directory is followed for as long as a process
/// uses the directory: `tandem train` restarts its learner.
///
/// # Errors
/// If the run ends without its result: because it is interrupted, its learner fails, or `tandem train` exits.
pub(super) async fn watch(learner: &mut Learner, args: &StatusArgs) -> Result<(), Failed> {
    let mut view = View::new(args.json);
    let mut problem: Option<Failed> = None;
    loop {
        match follow(learner, &mut view).await? {
            StreamEnd::Run(reason) => return view.end(&reason),
            StreamEnd::Lost(lost) => problem = Some(lost),
            StreamEnd::Unreachable(why) => problem = problem.or(Some(why)),
        }
        let is_used = args.run.is_dir() && run_directory::lock(&args.run)?.is_none();
        if !is_used {
            break;
        }
        tokio::time::sleep(PAUSE).await;
    }
    if args.run.is_dir() && run_directory::state(&args.run) == RunState::Complete {
        return view.end(&RunState::Complete.to_string());
    }
    view.close();
    problem.map_or(Ok(()), Err)
}

/// Shows the messages of one stream.
async fn follow(learner: &mut Learner, view: &mut View) -> Result<StreamEnd, Failed> {
    let call = learner.client.watch(pb::WatchRequest {});
    let mut stream = match call_with_timeout(call, learner.advice).await {
        Err(failed) if failed.exit() == Exit::TryAgain => {
            return Ok(StreamEnd::Unreachable(failed));
        }
        opened => opened?,
    };
    let address = &learner.address;
    let lost = |what: anyhow::Error| Ok(StreamEnd::Lost(Failed::new(Exit::TryAgain, what)));
    view.begin_stream();
    loop {
        match stream.message().await {
            // Only a learner that fails has no digest at its end.
            Ok(Some(progress)) if progress.ended && progress.digest.is_empty() => {
                let reason = progress.end_reason;
                return lost(anyhow!("the learner at {address} has failed: {reason}"));
            }
            Ok(Some(progress)) => {
                view.show(&progress)?;
                if progress.ended {
                    return Ok(StreamEnd::Run(progress.end_reason));
                }
            }
            Err(status) if !is_lost(&status) => return Err(failed(&status, learner.advice)),
            Ok(None) | Err(_) => {
                return lost(anyhow!("the learner at {address} is gone before the end of the run"));
            }
        }
    }
}

/// Returns true if an open stream ended because its connection did.
fn is_lost(status: &Status) -> bool {
    matches!(status.code(), Code::Unknown | Code::Unavailable | Code::Cancelled | Code::Internal)
}

/// The output of `--watch`: live lines on a terminal; elsewhere plain lines, or each message as JSON.
enum View {
    Live(Display),
    Plain(ProgressLines),
    Json,
}

impl View {
    fn new(prints_json: bool) -> Self {
        match prints_json {
            true => Self::Json,
            false if output::is_terminal() => Self::Live(Display::new(false)),
            false => Self::Plain(ProgressLines::default()),
        }
    }

    fn begin_stream(&mut self) {
        match self {
            Self::Live(display) => display.begin_stream(),
            Self::Plain(lines) => lines.begin_stream(),
            Self::Json => {}
        }
    }

    fn show(&mut self, progress: &pb::Progress) -> Result<(), Failed> {
        match self {
            Self::Live(display) => display.show(progress),
            Self::Plain(lines) => {
                return lines.of(progress).iter().try_for_each(|line| output::print(line.text()));
            }
            Self::Json => return output::print(progress_json(progress)),
        }
        Ok(())
    }

    /// Prints the end of the run, which is an error if the run was interrupted.
    fn end(&mut self, reason: &str) -> Result<(), Failed> {
        self.close();
        if !matches!(self, Self::Json) {
            output::print(format_args!("ended: {reason}"))?;
        }
        if reason == INTERRUPTED {
            return Err(Failed::new(Exit::TryAgain, anyhow!("the run was interrupted")));
        }
        Ok(())
    }

    fn close(&mut self) {
        if let Self::Live(display) = self {
            display.close();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_interrupted_run_is_no_success() {
        let mut view = View::Json;
        let failed = view.end(INTERRUPTED).expect_err("interrupted");
        assert_eq!(
            (failed.exit(), failed.line()),
            (Exit::TryAgain, "the run was interrupted".to_owned())
        );
        assert!(view.end("5600 environment steps").is_ok());
    }
}
