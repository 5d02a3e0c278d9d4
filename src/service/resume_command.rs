//! The command that resumes the run of an interrupted learner.

use std::path::Path;

use tandem_learner::INTERRUPTED;

use crate::cli::{DEFAULT_LISTEN, LearnerArgs, ListenArgs};
use crate::exit::{Exit, Failed};
use crate::shell::{shell_text, shell_word};
use crate::{output, run_directory};

/// Returns the error of a learner that a signal has ended, after printing the command that resumes its run. For a
/// learner that `tandem train` has started, that program prints its own.
pub(super) fn interrupted(args: &LearnerArgs) -> Failed {
    if !args.out_is_locked {
        let round = run_directory::saved_round(&args.out);
        output::message(heading(args, round));
        output::message(format_args!("  {}", resume_command(args, round.is_some())));
    }
    Failed::new(Exit::Interrupted, anyhow::anyhow!(INTERRUPTED))
}

/// Returns the line before the command. The newest checkpoint is that of `round`.
fn heading(args: &LearnerArgs, round: Option<u64>) -> String {
    let Some(round) = round else {
        return "interrupted before the first checkpoint. Start over with:".to_owned();
    };
    let command = match args.start_or_resume {
        true => "The same command resumes the run:",
        false => "Resume with:",
    };
    format!("interrupted; the state after round {round} is saved. {command}")
}

/// Returns the command that continues the run as `args` started it, from its newest checkpoint if one `is_saved`.
fn resume_command(args: &LearnerArgs, is_saved: bool) -> String {
    let start = match args.start_or_resume {
        true => " --start-or-resume",
        false if is_saved || args.resume => " --resume",
        false => "",
    };
    let (run, out) = (shell_word(&args.run), shell_word(&args.out));
    format!("tandem learner --run {run} --out {out}{start}{}", options(args))
}

/// Returns the options that a run does not remember and that differ from their defaults, each after a space.
fn options(args: &LearnerArgs) -> String {
    let text = |name: &str, value: Option<String>| {
        value.map(|value| format!(" --{name} {}", shell_text(value)))
    };
    let file = |name: &str, path: Option<&Path>| {
        path.map(|path| format!(" --{name} {}", shell_word(path)))
    };
    let flag = |name: &str, is_set: bool| is_set.then(|| format!(" --{name}"));
    let ListenArgs { listen, tls_cert, tls_key, insecure, .. } = &args.listen;
    let listen = Some(listen.to_string()).filter(|address| address != DEFAULT_LISTEN);
    let options = [
        text("teacher", args.teacher.clone()),
        file("start-from", args.start_from.as_deref()),
        text("threads", args.threads.map(|n| n.to_string())),
        text("dashboard-listen", args.dashboard_listen.map(|address| address.to_string())),
        file("dashboard-token-file", args.dashboard_token_file.as_deref()),
        flag("stay", args.stay),
        text("listen", listen),
        file("tls-cert", tls_cert.as_deref()),
        file("tls-key", tls_key.as_deref()),
        flag("insecure", *insecure),
        file("tls-ca", args.client_config.tls_ca.as_deref()),
        file("token-file", args.secret.token_file.as_deref()),
        text("metrics-listen", args.metrics.metrics_listen.map(|address| address.to_string())),
    ];
    options.into_iter().flatten().collect()
}

#[cfg(test)]
mod tests {
    use clap::Parser as _;

    use super::*;
    use crate::cli::{Cli, Command};

    /// Parses the command line of a learner with these options.
    fn parsed(options: &str) -> LearnerArgs {
        let line = format!("tandem learner --run run.toml --out runs/a{options}");
        let parsed = Cli::try_parse_from(line.split_whitespace()).expect("parses");
        let Command::Learner(args) = parsed.command else { panic!("{line} learns") };
        args
    }

    #[track_caller]
    fn check(options: &str, is_saved: bool, expected: &str) {
        let expected = format!("tandem learner --run run.toml --out runs/a{expected}");
        assert_eq!(resume_command(&parsed(options), is_saved), expected);
    }

    #[test]
    fn a_saved_run_is_resumed_and_another_one_is_started_again() {
        check("", true, " --resume");
        check("", false, "");
        check(" --resume", false, " --resume");
        for is_saved in [false, true] {
            check(" --start-or-resume", is_saved, " --start-or-resume");
        }
    }

    #[test]
    fn the_command_has_the_options_that_the_run_does_not_remember() {
        for options in [
            " --teacher teacher:7001 --listen 0.0.0.0:7000 --token-file token",
            " --start-from teacher.safetensors --threads 2 --stay",
            " --tls-cert chain.pem --tls-key key.pem --insecure --tls-ca ca.pem",
            " --dashboard-listen 0.0.0.0:8600 --dashboard-token-file token \
             --metrics-listen 127.0.0.1:9000",
        ] {
            check(options, true, &format!(" --resume{options}"));
        }
        check(" --listen 127.0.0.1:0", true, " --resume");
        check(" --listen [::1]:7000", true, " --resume --listen '[::1]:7000'");
    }

    #[test]
    fn a_command_that_starts_or_resumes_a_run_is_said_to_be_the_same() {
        let again = heading(&parsed(" --start-or-resume"), Some(3));
        let expected = "the state after round 3 is saved. The same command resumes the run:";
        assert!(again.ends_with(expected), "{again}");
        assert!(heading(&parsed(""), Some(3)).ends_with("is saved. Resume with:"));
        assert!(heading(&parsed(""), None).ends_with("Start over with:"));
    }
}
