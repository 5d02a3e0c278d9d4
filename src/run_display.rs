//! The display of a run: live lines on a terminal, plain lines elsewhere.

use std::io::IsTerminal as _;
use std::time::Duration;

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use tandem_proto::pb;

use crate::columns::{fitting, terminal_columns, wrapped};
use crate::output;
use crate::progress_lines::{ProgressLine, ProgressLines};
use crate::progress_text::{counts_line, fraction_done, state_lines};

/// Live lines below the bar.
const N_LINES: usize = 4;
const INDENT: &str = "  ";

pub(crate) struct Display {
    live: Option<Live>,
    is_quiet: bool,
    lines: ProgressLines,
}

struct Live {
    all: MultiProgress,
    bar: ProgressBar,
    lines: [ProgressBar; N_LINES],
}

impl Display {
    pub(crate) fn new(is_quiet: bool) -> Self {
        Self {
            live: (!is_quiet && std::io::stderr().is_terminal()).then(Live::new),
            is_quiet,
            lines: ProgressLines::default(),
        }
    }

    /// Notes that the following messages may be those of a restarted learner.
    pub(crate) fn begin_stream(&mut self) {
        self.lines.begin_stream();
    }

    pub(crate) fn show(&mut self, progress: &pb::Progress) {
        if progress.task.is_empty() {
            return;
        }
        for line in self.lines.of(progress) {
            match line {
                ProgressLine::Warning(line) if self.is_quiet => output::message(line),
                ProgressLine::Warning(line) if self.live.is_some() => {
                    self.print(&wrapped(&line, "      "));
                }
                // The live lines have the counts.
                ProgressLine::Counts(_) if self.live.is_some() => {}
                // A line of a file stays whole, so that programs find it.
                line => self.print(line.text()),
            }
        }
        if let Some(live) = &self.live {
            live.show(progress);
        }
    }

    /// Prints a line that stays on the screen, unless the run is quiet.
    pub(crate) fn print(&self, line: &str) {
        match &self.live {
            Some(live) => drop(live.all.println(output::escaped(line))),
            None if self.is_quiet => {}
            None => output::message(line),
        }
    }

    /// Removes the live lines. From now on, lines are printed plainly.
    pub(crate) fn close(&mut self) {
        if let Some(live) = self.live.take() {
            live.bar.finish_and_clear();
            live.lines.iter().for_each(ProgressBar::finish_and_clear);
        }
    }
}

impl Live {
    fn new() -> Self {
        let all = MultiProgress::new();
        let bar = all.add(ProgressBar::new(1000));
        bar.set_style(style("{spinner} [{wide_bar}] {percent:>3} %"));
        bar.enable_steady_tick(Duration::from_millis(200));
        let lines = std::array::from_fn(|_| {
            let line = all.add(ProgressBar::new_spinner());
            line.set_style(style(&format!("{INDENT}{{wide_msg}}")));
            line
        });
        Self { all, bar, lines }
    }

    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "clamped to the bar's length"
    )]
    fn show(&self, progress: &pb::Progress) {
        self.bar.set_position((fraction_done(progress) * 1000.0) as u64);
        let texts = std::iter::once(counts_line(progress)).chain(state_lines(progress));
        let texts = texts.chain(std::iter::repeat(String::new()));
        let n_columns = terminal_columns().saturating_sub(INDENT.len());
        for (line, text) in self.lines.iter().zip(texts) {
            line.set_message(output::escaped(fitting(&text, n_columns)));
        }
    }
}

/// Returns a bar for work with steps, on a terminal only.
pub(crate) fn bar(what: &str) -> ProgressBar {
    if !std::io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let bar = ProgressBar::new(0).with_message(what.to_owned());
    bar.set_style(style("{spinner} {msg} [{wide_bar}] {percent:>3} %"));
    bar
}

/// Returns the style of a bar or a live line.
pub(crate) fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template)
        .unwrap_or_else(|_| ProgressStyle::default_bar())
        .progress_chars("=> ")
}
