//! The display of a running `tandem train`: live lines on a terminal, plain lines elsewhere.

use std::io::IsTerminal as _;
use std::time::Duration;

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use tandem_core::text::counted;
use tandem_proto::pb;

use super::plan::Plan;
use crate::progress_text::{clock_text, counts_line, evaluation_line, grouped};
use crate::{environment_server, output};

/// Seconds of run time after which a plain line is printed even without news.
const PLAIN_EVERY_S: f64 = 30.0;

pub(crate) struct Display {
    live: Option<Live>,
    limit: Limit,
    /// Run time of the latest plain line.
    printed_at_s: f64,
    /// Round of the latest evaluation that was printed.
    printed_evaluation: Option<u64>,
    printed_warning: String,
}

struct Live {
    all: MultiProgress,
    bar: ProgressBar,
    lines: [ProgressBar; 3],
}

/// The limit of the run that a full bar represents.
enum Limit {
    Minutes(f64),
    EnvSteps(u64),
    Open,
}

impl Display {
    pub(crate) fn new(plan: &Plan) -> Self {
        let stop = &plan.config.stop;
        let limit = match (stop.max_env_steps, stop.max_minutes) {
            (0, minutes) if minutes > 0.0 => Limit::Minutes(minutes),
            (0, _) => Limit::Open,
            (env_steps, _) => Limit::EnvSteps(env_steps),
        };
        let display = Self {
            live: std::io::stderr().is_terminal().then(Live::new),
            limit,
            printed_at_s: -PLAIN_EVERY_S,
            printed_evaluation: None,
            printed_warning: String::new(),
        };
        let config = &plan.config;
        display.print(&format!(
            "training {} with {}, strategy {}, seed {}, {}; run directory {}",
            config.task,
            counted(config.arms, "arm"),
            config.advice.strategy,
            config.seed,
            counted(plan.n_workers, "worker"),
            plan.out.display()
        ));
        if let Some(server) = environment_server::shown(&plan.environment) {
            display.print(&format!("environments of {server}"));
        }
        display
    }

    pub(crate) fn show(&mut self, progress: &pb::Progress) {
        if progress.task.is_empty() {
            return;
        }
        if progress.warning != self.printed_warning {
            self.printed_warning.clone_from(&progress.warning);
            self.print(&warning_line(progress));
        }
        if let Some(evaluation) = &progress.evaluation
            && self.printed_evaluation != Some(evaluation.round)
        {
            self.printed_evaluation = Some(evaluation.round);
            self.printed_at_s = progress.wall_s;
            self.print(&evaluation_line(progress, evaluation));
        } else if self.live.is_none() && progress.wall_s - self.printed_at_s >= PLAIN_EVERY_S {
            self.printed_at_s = progress.wall_s;
            self.print(&counts_line(progress));
        }
        if let Some(live) = &self.live {
            live.show(progress, self.fraction_done(progress));
        }
    }

    /// Prints a line that stays on the screen.
    pub(crate) fn print(&self, line: &str) {
        match &self.live {
            Some(live) => drop(live.all.println(output::escaped(line))),
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

    fn fraction_done(&self, progress: &pb::Progress) -> f64 {
        match self.limit {
            Limit::Minutes(minutes) => progress.wall_s / (minutes * 60.0),
            Limit::EnvSteps(env_steps) => progress.env_steps as f64 / env_steps as f64,
            Limit::Open => 0.0,
        }
    }
}

impl Live {
    fn new() -> Self {
        let all = MultiProgress::new();
        let bar = all.add(ProgressBar::new(1000));
        bar.set_style(style("{spinner} [{bar:32}] {msg}"));
        bar.enable_steady_tick(Duration::from_millis(200));
        let lines = std::array::from_fn(|_| {
            let line = all.add(ProgressBar::new_spinner());
            line.set_style(style("  {msg}"));
            line
        });
        Self { all, bar, lines }
    }

    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "clamped to the bar's length"
    )]
    fn show(&self, progress: &pb::Progress, fraction_done: f64) {
        self.bar.set_position((fraction_done.clamp(0.0, 1.0) * 1000.0) as u64);
        self.bar.set_message(counts_line(progress));
        let best = progress.best.as_ref().map_or_else(
            || "none yet".to_owned(),
            |best| format!("{:.3} at {} env steps", best.success, grouped(best.env_steps)),
        );
        self.lines[0].set_message(format!(
            "best success {best}; latest training episodes {:.2}",
            progress.training_success
        ));
        self.lines[1].set_message(format!(
            "advice spent {}, left {}",
            grouped(progress.advice_spent),
            grouped(progress.budget_left)
        ));
        let workers: Vec<String> = progress
            .workers
            .iter()
            .map(|worker| format!("{} {}", worker.name, worker.doing))
            .collect();
        let teacher = if progress.strategy == "none" { "" } else { "teacher answering; " };
        self.lines[2].set_message(format!(
            "learner {}; {teacher}{}",
            progress.phase,
            workers.join("; ")
        ));
    }
}

fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template)
        .unwrap_or_else(|_| ProgressStyle::default_bar())
        .progress_chars("=> ")
}

fn warning_line(progress: &pb::Progress) -> String {
    let clock = clock_text(progress.wall_s);
    match progress.warning.as_str() {
        "" => format!("{clock} the problem is solved"),
        warning => format!("{clock} warning: {warning}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_warning_and_its_end_are_printed() {
        let of = |warning: &str| {
            warning_line(&pb::Progress { warning: warning.to_owned(), ..Default::default() })
        };
        assert_eq!(of("the disk is full"), "00:00 warning: the disk is full");
        assert_eq!(of(""), "00:00 the problem is solved");
    }
}
