//! `tandem status --watch`: follows a run to its end.

use std::time::Duration;

use anyhow::anyhow;
use tandem_learner::INTERRUPTED;
use tandem_proto::pb;
use tokio_stream::{Stream, StreamExt as _};
use tonic::{Code, Status};

use super::{Learner, call_with_timeout, failed, recorded};
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
    let mut print = |line: String| output::print(line);
    let mut view = View::new(Format::chosen(args.json), &mut print);
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
        learner.update_address(&args.run)?;
    }
    if args.run.is_dir() && run_directory::state(&args.run) == RunState::Complete {
        return match args.json {
            true => recorded::show(&args.run, args.json),
            false => view.end(&RunState::Complete.to_string()),
        };
    }
    view.close();
    problem.map_or(Ok(()), Err)
}

/// Shows the messages of one stream.
async fn follow(learner: &mut Learner, view: &mut View<'_>) -> Result<StreamEnd, Failed> {
    let call = learner.client.watch(pb::WatchRequest {});
    let messages = match call_with_timeout(call, learner.advice).await {
        Err(failed) if failed.exit() == Exit::TryAgain => {
            return Ok(StreamEnd::Unreachable(failed));
        }
        opened => opened?,
    };
    show_messages(messages, (&learner.address, learner.advice), view).await
}

/// Shows the messages of the learner at `address` until they end.
async fn show_messages(
    mut messages: impl Stream<Item = Result<pb::Progress, Status>> + Unpin,
    (address, advice): (&str, &str),
    view: &mut View<'_>,
) -> Result<StreamEnd, Failed> {
    let lost = |what: anyhow::Error| Ok(StreamEnd::Lost(Failed::new(Exit::TryAgain, what)));
    view.begin_stream();
    loop {
        match messages.next().await {
            // Only a learner that fails has no digest at its end.
            Some(Ok(progress)) if progress.ended && progress.digest.is_empty() => {
                view.show_failure(&progress)?;
                let reason = progress.end_reason;
                return lost(anyhow!("the learner at {address} has failed: {reason}"));
            }
            Some(Ok(progress)) => {
                view.show(&progress)?;
                if progress.ended {
                    return Ok(StreamEnd::Run(progress.end_reason));
                }
            }
            Some(Err(status)) if !is_lost(&status) => return Err(failed(&status, advice)),
            None | Some(Err(_)) => {
                return lost(anyhow!("the learner at {address} is gone before the end of the run"));
            }
        }
    }
}

/// Returns true if an open stream ended because its connection did.
fn is_lost(status: &Status) -> bool {
    matches!(status.code(), Code::Unknown | Code::Unavailable | Code::Cancelled | Code::Internal)
}

/// The format of `--watch`: live lines on a terminal; elsewhere plain lines, or each message as JSON.
enum Format {
    Live(Display),
    Plain(ProgressLines),
    Json,
}

impl Format {
    fn chosen(prints_json: bool) -> Self {
        match prints_json {
            true => Self::Json,
            false if output::is_terminal() => Self::Live(Display::new(false)),
            false => Self::Plain(ProgressLines::default()),
        }
    }
}

/// The output of `--watch`.
struct View<'a> {
    format: Format,
    /// Prints a line of the result.
    print: &'a mut dyn FnMut(String) -> Result<(), Failed>,
    /// The progress of the run was shown.
    has_shown: bool,
    /// The next message is the first one since the progress was shown from another stream.
    continues: bool,
}

impl<'a> View<'a> {
    fn new(format: Format, print: &'a mut dyn FnMut(String) -> Result<(), Failed>) -> Self {
        Self { format, print, has_shown: false, continues: false }
    }

    fn begin_stream(&mut self) {
        self.continues = self.has_shown;
        match &mut self.format {
            Format::Live(display) => display.begin_stream(),
            Format::Plain(lines) => lines.begin_stream(),
            Format::Json => {}
        }
    }

    fn show(&mut self, progress: &pb::Progress) -> Result<(), Failed> {
        let is_starting = progress.task.is_empty();
        let continues = !is_starting && std::mem::take(&mut self.continues);
        let round = progress.resumed_from_round;
        let restart = continues.then(|| format!("the learner continues from round {round}"));
        self.has_shown |= !is_starting;
        match &mut self.format {
            Format::Json => return (self.print)(progress_json(progress).to_string()),
            Format::Live(_) | Format::Plain(_) if is_starting => {}
            Format::Live(display) => {
                restart.iter().for_each(|line| display.print(line));
                display.show(progress);
            }
            Format::Plain(lines) => {
                let new = lines.of(progress).into_iter().map(|line| line.text().to_owned());
                return restart.into_iter().chain(new).try_for_each(&mut self.print);
            }
        }
        Ok(())
    }

    /// Shows the last message of a learner that fails. As text, its reason is the error of the command, unless the
    /// learner is restarted.
    fn show_failure(&mut self, progress: &pb::Progress) -> Result<(), Failed> {
        match self.format {
            Format::Json => self.show(progress),
            Format::Live(_) | Format::Plain(_) => Ok(()),
        }
    }

    /// Prints the end of the run, which is an error if the run was interrupted.
    fn end(&mut self, reason: &str) -> Result<(), Failed> {
        self.close();
        if !matches!(self.format, Format::Json) {
            (self.print)(format!("ended: {reason}"))?;
        }
        if reason == INTERRUPTED {
            return Err(Failed::new(Exit::TryAgain, anyhow!("the run was interrupted")));
        }
        Ok(())
    }

    fn close(&mut self) {
        if let Format::Live(display) = &mut self.format {
            display.close();
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::*;

    /// Shows streams of messages, each of which ends early, and returns the printed lines and the last failure.
    async fn shown(format: Format, streams: &[&[pb::Progress]]) -> (Vec<String>, Option<Failed>) {
        let (mut lines, mut lost) = (Vec::new(), None);
        let mut print = |line: String| {
            lines.push(line);
            Ok(())
        };
        let mut view = View::new(format, &mut print);
        for messages in streams {
            let messages = tokio_stream::iter(messages.iter().cloned().map(Ok));
            let end = show_messages(messages, ("127.0.0.1:7000", "try again"), &mut view).await;
            lost = match end.expect("shown") {
                StreamEnd::Lost(failed) => Some(failed),
                StreamEnd::Run(_) | StreamEnd::Unreachable(_) => None,
            };
        }
        drop(view);
        (lines, lost)
    }

    #[tokio::test]
    async fn the_last_message_of_a_failing_learner_is_printed_as_json() {
        let end_reason = "the disk is full".to_owned();
        let failing = pb::Progress { ended: true, end_reason, ..Default::default() };
        for (format, n_lines) in [(Format::Json, 1), (Format::Plain(ProgressLines::default()), 0)] {
            let (lines, failed) = shown(format, &[std::slice::from_ref(&failing)]).await;
            let failed = failed.expect("the learner has failed");
            assert_eq!(failed.exit(), Exit::TryAgain);
            assert!(failed.line().ends_with("has failed: the disk is full"), "{}", failed.line());
            assert_eq!(lines.len(), n_lines, "{lines:?}");
            for line in lines {
                let message: Value = serde_json::from_str(&line).expect("JSON");
                assert_eq!(message["ended"], true, "{message}");
                assert_eq!(message["end_reason"], "the disk is full", "{message}");
            }
        }
    }

    #[tokio::test]
    async fn a_restarted_learner_continues_from_an_earlier_round_and_time() {
        let starting = pb::Progress::default();
        let message = |wall_s: f64, resumed_from_round: u64| pb::Progress {
            task: "push".to_owned(),
            wall_s,
            resumed_from_round,
            ..Default::default()
        };
        let format = Format::Plain(ProgressLines::default());
        let first = [starting.clone(), message(300.0, 0), message(301.0, 0)];
        let second = [starting, message(200.0, 50), message(201.0, 50)];
        let (lines, lost) = shown(format, &[&first, &second]).await;
        let expected = [
            "05:00 0 env steps, 0 updates",
            "the learner continues from round 50",
            "03:20 0 env steps, 0 updates",
        ];
        assert_eq!(lines, expected);
        assert!(lost.is_some(), "no message has ended the run");
    }

    #[test]
    fn an_interrupted_run_is_no_success() {
        let mut print = |_: String| Ok(());
        let mut view = View::new(Format::Json, &mut print);
        let failed = view.end(INTERRUPTED).expect_err("interrupted");
        assert_eq!(
            (failed.exit(), failed.line()),
            (Exit::TryAgain, "the run was interrupted".to_owned())
        );
        assert!(view.end("5600 environment steps").is_ok());
    }
}
