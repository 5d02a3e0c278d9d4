//! The command that resumes a run.

use std::path::Path;

use crate::cli::TrainArgs;
use crate::shell::shell_word;

/// Returns the command that resumes the run in `out` as `args` started it.
pub(super) fn resume_command(out: &Path, args: &TrainArgs) -> String {
    format!("tandem train --resume --out {}{}", shell_word(out), options(args))
}

/// Returns the options that a run does not remember and that differ from their defaults, each after a space: workers,
/// recording, dashboard and metrics.
pub(super) fn options(args: &TrainArgs) -> String {
    let workers = args.workers.map(|n| format!(" --workers {n}")).unwrap_or_default();
    let metrics = args.metrics.metrics_listen;
    let metrics = metrics.map(|address| format!(" --metrics-listen {address}")).unwrap_or_default();
    let (recording, live) = (args.recording.shell_words(), args.live.shell_words());
    format!("{workers}{recording}{live}{}{metrics}", args.dashboard.shell_words())
}

#[cfg(test)]
mod tests {
    use clap::Parser as _;

    use super::*;
    use crate::cli::{Cli, Command};

    fn check(options: &str, expected: &str) {
        let line = format!("tandem train {options}");
        let parsed = Cli::try_parse_from(line.split_whitespace()).expect("parses");
        let Command::Train(args) = parsed.command else { panic!("{line} trains") };
        let expected = format!("tandem train --resume --out runs/a{expected}");
        assert_eq!(resume_command(Path::new("runs/a"), &args), expected, "{options}");
    }

    #[test]
    fn the_command_has_the_options_that_the_run_does_not_remember() {
        check("", "");
        check("--seed 2 --max-env-steps 1e5 --set rounds.slots=4 --quiet", "");
        check("--record evaluation --log-budget 2GiB", "");
        for options in [
            "--workers 2",
            "--record all",
            "--log-budget 10GiB",
            "--live",
            "--live 0.0.0.0:8765",
            "--no-dashboard",
            "--dashboard 0.0.0.0:8600 --dashboard-token-file token",
            "--workers 3 --record none --no-dashboard --metrics-listen 127.0.0.1:9000",
        ] {
            check(options, &format!(" {options}"));
        }
    }
}
