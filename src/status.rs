//! `tandem status`: shows the progress of a run, from any machine that can reach its learner, or from its directory.

mod recorded;

use std::path::Path;
use std::time::Duration;

use anyhow::anyhow;
use tandem_core::text::counted;
use tandem_net::AuthChannel;
use tandem_proto::pb;
use tandem_proto::pb::learner_client::LearnerClient;
use tonic::{Code, Response, Status};

use crate::cli::StatusArgs;
use crate::columns::wrapped;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::progress_json::progress_json;
use crate::progress_text::{
    counts_line, evaluation_line, failures_text, state_lines, warning_line,
};
use crate::run_display::Display;
use crate::{access, call_failure, output, run_directory, runtime};

/// Timeout of a call.
const TIMEOUT: Duration = Duration::from_secs(10);
/// What to do if a run has no learner at the moment.
const STARTING_OR_ENDING: &str = "its run is starting or ending: try again";
/// Seconds of run time after which a line is printed even without news.
const LINE_EVERY_S: f64 = 30.0;

pub(crate) fn status(args: &StatusArgs) -> Result<(), Failed> {
    let client_config = access::client_config(&args.client_config, &args.secret)?;
    let address = match source_of(&args.run)? {
        Source::Learner(address) => address,
        Source::Recorded => return recorded::show(&args.run, args.json),
        Source::List if args.watch => {
            let shown = args.run.display();
            return Err(Failed::usage(format!("--watch: {shown} holds several runs: name one")));
        }
        Source::List => return recorded::list(&args.run, args.json),
    };
    let runtime = runtime::new().or_exit(Exit::TryAgain, String::new)?;
    runtime.block_on(async {
        let no_directory = || format!("there is no directory {}", args.run.display());
        let link = client_config.channel(&address).or_exit(Exit::Usage, no_directory)?;
        let mut learner = Learner {
            client: LearnerClient::new(link),
            advice: match args.run.is_dir() {
                true => STARTING_OR_ENDING,
                false => "`tandem status DIR` shows a `tandem train` by its run directory",
            },
            address,
        };
        if args.watch { watch(&mut learner, args).await } else { show(&mut learner, args).await }
    })
}

/// The learner of a run.
struct Learner {
    client: LearnerClient<AuthChannel>,
    address: String,
    /// What to do if nothing listens at the address.
    advice: &'static str,
}

/// Where the progress comes from.
enum Source {
    /// The learner at this address.
    Learner(String),
    /// The files of a run of which no learner is running.
    Recorded,
    /// The runs in a directory.
    List,
}

/// Returns the source for the address of a learner, the directory of a run, or one that holds runs.
fn source_of(run: &Path) -> Result<Source, Failed> {
    if !run.is_dir() {
        return Ok(Source::Learner(run.to_string_lossy().into_owned()));
    }
    if !run.join("run.toml").exists() {
        let has_runs =
            !run_directory::runs_in(run).is_empty() || !run_directory::parents_in(run).is_empty();
        let none = || run_directory::no_run(&format!("{} holds no run", run.display()));
        return if has_runs { Ok(Source::List) } else { Err(none()) };
    }
    // A `tandem train` that was killed has left the address, at which another program may listen now.
    if run_directory::lock(run)?.is_some() {
        return Ok(Source::Recorded);
    }
    match std::fs::read_to_string(run_directory::learner_address(run)) {
        Ok(address) => Ok(Source::Learner(address.trim().to_owned())),
        Err(_missing) => Err(Failed::new(
            Exit::TryAgain,
            anyhow!("a process uses {}: {STARTING_OR_ENDING}", run.display()),
        )),
    }
}

/// Prints the current progress.
async fn show(learner: &mut Learner, args: &StatusArgs) -> Result<(), Failed> {
    let call = learner.client.status(pb::StatusRequest {});
    let progress = call_with_timeout(call, learner.advice).await?;
    if args.json {
        output::print(progress_json(&progress))?;
    } else {
        lines(&progress).iter().try_for_each(output::print)?;
    }
    Ok(())
}

/// Shows the progress until the run has ended: live on a terminal, elsewhere as [`PlainLines`] or each message as JSON.
async fn watch(learner: &mut Learner, args: &StatusArgs) -> Result<(), Failed> {
    let call = learner.client.watch(pb::WatchRequest {});
    let mut stream = call_with_timeout(call, learner.advice).await?;
    let mut plain = PlainLines::default();
    let is_live = !args.json && output::is_terminal();
    let mut display = is_live.then(|| Display::new(false));
    loop {
        let progress = match stream.message().await {
            Ok(Some(progress)) => progress,
            Err(status) if !is_lost(&status) => return Err(failed(&status, learner.advice)),
            Ok(None) | Err(_) => {
                let address = &learner.address;
                let lost = anyhow!("the learner at {address} is gone before the end of the run");
                return Err(Failed::new(Exit::TryAgain, lost));
            }
        };
        if args.json {
            output::print(progress_json(&progress))?;
        } else if let Some(display) = &mut display {
            display.show(&progress);
        } else {
            plain.of(&progress).iter().try_for_each(output::print)?;
        }
        if progress.ended {
            display.iter_mut().for_each(Display::close);
            if !args.json {
                output::print(format_args!("ended: {}", progress.end_reason))?;
            }
            return Ok(());
        }
    }
}

/// The progress without a terminal: a line for each evaluation, for each warning and its end, and every half minute.
#[derive(Default)]
struct PlainLines {
    /// Round of the latest evaluation.
    round: Option<u64>,
    /// Run time of the latest evaluation or counts, seconds.
    at_s: Option<f64>,
    warning: String,
}

impl PlainLines {
    /// Returns the lines about `progress` that are new.
    fn of(&mut self, progress: &pb::Progress) -> Vec<String> {
        let mut lines = Vec::new();
        if progress.warning != self.warning {
            self.warning.clone_from(&progress.warning);
            lines.push(warning_line(progress));
        }
        let is_due = self.at_s.is_none_or(|at_s| progress.wall_s - at_s >= LINE_EVERY_S);
        if let Some(evaluation) = progress.evaluation.as_ref()
            && self.round != Some(evaluation.round)
        {
            (self.round, self.at_s) = (Some(evaluation.round), Some(progress.wall_s));
            lines.push(evaluation_line(progress, evaluation));
        } else if is_due {
            self.at_s = Some(progress.wall_s);
            lines.push(counts_line(progress));
        }
        lines
    }
}

/// Returns whether an open stream ended because its connection did.
fn is_lost(status: &Status) -> bool {
    matches!(status.code(), Code::Unknown | Code::Unavailable | Code::Cancelled | Code::Internal)
}

/// Runs a call with a timeout.
async fn call_with_timeout<T>(
    call: impl Future<Output = Result<Response<T>, Status>>,
    advice: &str,
) -> Result<T, Failed> {
    match tokio::time::timeout(TIMEOUT, call).await {
        Ok(response) => {
            response.map(Response::into_inner).map_err(|status| failed(&status, advice))
        }
        Err(_elapsed) => {
            let what = anyhow!("the learner did not respond within {TIMEOUT:?}");
            Err(Failed::new(Exit::TryAgain, what))
        }
    }
}

fn failed(status: &Status, advice: &str) -> Failed {
    let exit = match status.code() {
        Code::Unauthenticated | Code::Unimplemented => Exit::Usage,
        _ => Exit::TryAgain,
    };
    call_failure::failed(exit, status, advice)
}

fn lines(progress: &pb::Progress) -> Vec<String> {
    if progress.task.is_empty() {
        return vec!["starting".to_owned()];
    }
    let arms = counted(usize::try_from(progress.n_arms).unwrap_or_default(), "arm");
    let title = format!("{} with {arms}, strategy {}", progress.task, progress.strategy);
    let mut lines = vec![wrapped(&title, "  "), counts_line(progress)];
    lines.extend(progress.evaluation.as_ref().map(|latest| evaluation_line(progress, latest)));
    lines.extend(state_lines(progress));
    if !progress.environment.is_empty() {
        lines.push(format!("environment: {}", progress.environment));
    }
    lines.extend(failures_text(progress).map(|failures| format!("environment: {failures}")));
    if !progress.warning.is_empty() {
        lines.push(warning_line(progress));
    }
    if progress.ended {
        lines.push(format!("ended: {}", progress.end_reason));
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn silent_workers_and_a_warning_are_shown() {
        let worker =
            |doing: &str| pb::WorkerProgress { doing: doing.to_owned(), ..Default::default() };
        let progress = pb::Progress {
            task: "push".to_owned(),
            phase: "collecting".to_owned(),
            workers: vec![worker("slot 3"), worker("silent"), worker("waiting")],
            warning: "the disk is full".to_owned(),
            ..Default::default()
        };
        let text = lines(&progress).join("\n");
        assert!(text.contains("slot 3") && text.contains("silent"), "{text}");
        assert!(
            text.contains("learner collecting") && text.ends_with("the disk is full"),
            "{text}"
        );
        let ended = pb::Progress { ended: true, end_reason: "done".to_owned(), ..progress };
        assert_eq!(lines(&ended).last().map(String::as_str), Some("ended: done"));
    }

    #[test]
    fn without_a_terminal_warnings_and_their_ends_are_lines_too() {
        let mut plain = PlainLines::default();
        let mut check = |wall_s: f64, warning: &str, round: Option<u64>, expected: &[&str]| {
            let evaluation =
                round.map(|round| pb::Evaluation { round, success: 0.5, ..Default::default() });
            let warning = warning.to_owned();
            let progress = pb::Progress { wall_s, warning, evaluation, ..Default::default() };
            let lines = plain.of(&progress);
            assert_eq!(lines.len(), expected.len(), "{lines:?}");
            for (line, word) in lines.iter().zip(expected) {
                assert!(line.contains(word), "{line:?} lacks {word:?}");
            }
        };
        check(0.0, "", None, &["0 updates"]);
        check(1.0, "the disk is full", None, &["00:01 warning: the disk is full"]);
        check(2.0, "the disk is full", None, &[]);
        check(3.0, "a worker is silent", Some(4), &["a worker is silent", "success 0.500"]);
        check(4.0, "", Some(4), &["00:04 the problem is solved"]);
        check(32.0, "", Some(4), &[]);
        check(33.0, "", Some(4), &["0 updates"]);
    }
}
