//! `tandem status`: shows the progress of a run, from any machine that can reach its learner, or from its directory.

mod recorded;
mod watch;

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
use crate::{access, call_failure, output, run_directory, runtime};

/// Timeout of a call.
const TIMEOUT: Duration = Duration::from_secs(10);
/// The advice if a run has no learner at the moment.
const STARTING_OR_ENDING: &str = "its run is starting or ending: try again";

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
        if args.watch {
            watch::watch(&mut learner, args).await
        } else {
            show(&mut learner, args).await
        }
    })
}

/// The learner of a run.
struct Learner {
    client: LearnerClient<AuthChannel>,
    address: String,
    /// The advice if nothing listens at the address.
    advice: &'static str,
}

/// The source of a progress report.
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
}
