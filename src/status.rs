//! `tandem status`: shows the progress of a run, from any machine that can reach its learner, or from its directory.

mod recorded;
mod watch;

use std::path::Path;
use std::time::Duration;

use anyhow::anyhow;
use tandem_core::text::counted;
use tandem_net::{AuthChannel, ClientConfig};
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
        let mut learner = Learner::at(address, client_config, &args.run)?;
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
    client_config: ClientConfig,
    address: String,
    /// The advice if nothing listens at the address.
    advice: &'static str,
}

impl Learner {
    /// Returns the learner at `address`, whose run the command line names as `run`.
    fn at(address: String, client_config: ClientConfig, run: &Path) -> Result<Self, Failed> {
        let no_directory = || format!("there is no directory {}", run.display());
        let link = client_config.channel(&address).or_exit(Exit::Usage, no_directory)?;
        let advice = match run.is_dir() {
            true => STARTING_OR_ENDING,
            false => "`tandem status DIR` shows a `tandem train` by its run directory",
        };
        Ok(Self { client: LearnerClient::new(link), client_config, address, advice })
    }

    /// Takes over the address in the run directory `run`: that of another learner if a new `tandem train` uses the
    /// directory, and missing while that is starting.
    fn update_address(&mut self, run: &Path) -> Result<(), Failed> {
        match address_in(run) {
            Some(address) if address != self.address => {
                *self = Self::at(address, self.client_config.clone(), run)?;
            }
            _ => {}
        }
        Ok(())
    }
}

/// Returns the address of the learner that `tandem train` has started for the run in `dir`.
fn address_in(dir: &Path) -> Option<String> {
    let address = std::fs::read_to_string(run_directory::learner_address(dir)).ok()?;
    Some(address.trim().to_owned())
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
    address_in(run).map(Source::Learner).ok_or_else(|| {
        let what = anyhow!("a process uses {}: {STARTING_OR_ENDING}", run.display());
        Failed::new(Exit::TryAgain, what)
    })
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

    #[tokio::test]
    async fn a_run_directory_leads_to_the_learner_of_its_latest_start() {
        let run = tempfile::tempdir().expect("a directory");
        let address = || "127.0.0.1:1".to_owned();
        let mut learner =
            Learner::at(address(), ClientConfig::default(), run.path()).expect("an address");
        learner.update_address(run.path()).expect("none is written");
        assert_eq!(learner.address, address());
        std::fs::create_dir(run_directory::in_use(run.path())).expect("creates");
        std::fs::write(run_directory::learner_address(run.path()), "127.0.0.1:2\n")
            .expect("writes");
        learner.update_address(run.path()).expect("an address");
        assert_eq!(learner.address, "127.0.0.1:2");
    }

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
