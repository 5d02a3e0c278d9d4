//! The display of a sweep: a line for each run that ends and, on a terminal, a live line for each running one.

use std::fs::File;
use std::io::{IsTerminal as _, Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::Duration;

use indicatif::{HumanCount, MultiProgress, ProgressBar};
use serde_json::Value;

use crate::launch::last_line;
use crate::output;
use crate::run_display::style;

/// Bytes at the end of a log that are searched for its last line.
const TAIL_BYTES: u64 = 4096;

pub(super) struct Display {
    live: Option<Live>,
    n_runs: usize,
    n_ended: usize,
}

struct Live {
    all: MultiProgress,
    bar: ProgressBar,
    running: Vec<Running>,
}

struct Running {
    name: String,
    log: PathBuf,
    line: ProgressBar,
}

impl Display {
    pub(super) fn new(n_runs: usize, n_finished: usize) -> Self {
        let live = std::io::stderr().is_terminal().then(|| Live::new(n_runs, n_finished));
        Self { live, n_runs, n_ended: n_finished }
    }

    /// Adds a run that writes its lines to `log`.
    pub(super) fn started(&mut self, name: &str, log: PathBuf) {
        let Some(live) = &mut self.live else {
            return output::message(format_args!("{name}: started, see {}", log.display()));
        };
        let line = live.all.add(ProgressBar::new_spinner());
        line.set_style(style("  {wide_msg}"));
        line.set_message(format!("{name}: starting"));
        live.running.push(Running { name: name.to_owned(), log, line });
    }

    /// Prints how a run ended and removes its live line.
    pub(super) fn ended(&mut self, name: &str, outcome: &str) {
        self.n_ended += 1;
        self.print(&format!("[{} of {}] {name}: {outcome}", self.n_ended, self.n_runs));
        if let Some(live) = &mut self.live {
            live.bar.set_position(self.n_ended as u64);
            for running in live.running.extract_if(.., |running| running.name == name) {
                running.line.finish_and_clear();
            }
        }
    }

    /// Shows the last line of each running run.
    pub(super) fn refresh(&self) {
        for Running { name, log, line } in self.live.iter().flat_map(|live| &live.running) {
            let text = tail(log).unwrap_or_default();
            if let Some(last) = last_line(&text) {
                line.set_message(output::escaped(&format!("{name}: {last}")));
            }
        }
    }

    /// Prints a line that stays on the screen.
    pub(super) fn print(&self, line: &str) {
        match &self.live {
            Some(live) => drop(live.all.println(output::escaped(line))),
            None => output::message(line),
        }
    }

    /// Removes the live lines. From now on, lines are printed plainly.
    pub(super) fn close(&mut self) {
        if let Some(live) = self.live.take() {
            live.bar.finish_and_clear();
            live.running.iter().for_each(|running| running.line.finish_and_clear());
        }
    }
}

impl Live {
    fn new(n_runs: usize, n_finished: usize) -> Self {
        let all = MultiProgress::new();
        let bar = all.add(ProgressBar::new(n_runs as u64));
        bar.set_style(style("{spinner} [{bar:32}] {pos} of {len} runs, {elapsed}"));
        bar.set_position(n_finished as u64);
        bar.enable_steady_tick(Duration::from_millis(200));
        Self { all, bar, running: Vec::new() }
    }
}

/// Returns the results in a summary on one line.
pub(super) fn summary_line(summary: &Value) -> String {
    let number = |key: &str| summary[key].as_f64().unwrap_or(f64::NAN);
    format!(
        "success {:.3} [{:.3}, {:.3}] on test goals, {} env steps in {:.1} minutes",
        number("success"),
        number("success_low"),
        number("success_high"),
        HumanCount(summary["env_steps"].as_u64().unwrap_or_default()),
        number("wall_s") / 60.0
    )
}

/// Returns the end of a text file.
fn tail(path: &Path) -> Option<String> {
    let mut file = File::open(path).ok()?;
    let n_bytes = file.metadata().ok()?.len();
    file.seek(SeekFrom::Start(n_bytes.saturating_sub(TAIL_BYTES))).ok()?;
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes).ok()?;
    Some(String::from_utf8_lossy(&bytes).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_summary_fits_on_one_line() {
        let summary = serde_json::json!({
            "success": 0.9625, "success_low": 0.93, "success_high": 0.98, "env_steps": 940_000, "wall_s": 1803.0
        });
        assert_eq!(
            summary_line(&summary),
            "success 0.963 [0.930, 0.980] on test goals, 940,000 env steps in 30.1 minutes"
        );
    }

    #[test]
    fn only_the_end_of_a_long_log_is_read() {
        let dir = tempfile::tempdir().expect("a directory");
        let log = dir.path().join("log");
        std::fs::write(&log, "x".repeat(10_000) + "\nlast\n").expect("writes");
        let tail = tail(&log).expect("there");
        assert_eq!((tail.len(), last_line(&tail)), (4096, Some("last")));
    }
}
