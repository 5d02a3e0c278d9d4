//! What a person sees while a run goes on: live lines on a terminal, plain ones elsewhere.

use std::io::IsTerminal as _;
use std::time::Duration;

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use tandem_proto::pb;

use super::plan::Plan;
use crate::output;

/// Seconds of run time between two plain lines without news.
const PLAIN_EVERY_S: f64 = 30.0;

pub(crate) struct Display {
    live: Option<Live>,
    until: Until,
    told_at_s: f64,
    told_evaluation: Option<u64>,
    told_warning: String,
}

struct Live {
    all: MultiProgress,
    bar: ProgressBar,
    lines: [ProgressBar; 3],
}

/// What the bar fills up to.
enum Until {
    Minutes(f64),
    EnvSteps(u64),
    Open,
}

impl Display {
    pub(crate) fn new(plan: &Plan) -> Self {
        let stop = &plan.config.stop;
        let until = match (stop.max_env_steps, stop.max_minutes) {
            (0, minutes) if minutes > 0.0 => Until::Minutes(minutes),
            (0, _) => Until::Open,
            (env_steps, _) => Until::EnvSteps(env_steps),
        };
        let display = Self {
            live: std::io::stderr().is_terminal().then(Live::new),
            until,
            told_at_s: -PLAIN_EVERY_S,
            told_evaluation: None,
            told_warning: String::new(),
        };
        let config = &plan.config;
        display.say(&format!(
            "training {} with {} arm(s), strategy {}, seed {}, {} worker process(es); run directory {}",
            config.task,
            config.arms,
            config.advice.strategy,
            config.seed,
            plan.n_workers,
            plan.out.display()
        ));
        display
    }

    pub(crate) fn show(&mut self, progress: &pb::Progress) {
        if progress.task.is_empty() {
            return;
        }
        if progress.warning != self.told_warning {
            self.told_warning.clone_from(&progress.warning);
            self.say(&warning_line(progress));
        }
        if let Some(evaluation) = &progress.evaluation
            && self.told_evaluation != Some(evaluation.round)
        {
            self.told_evaluation = Some(evaluation.round);
            self.told_at_s = progress.wall_s;
            self.say(&evaluation_line(progress, evaluation));
        } else if self.live.is_none() && progress.wall_s - self.told_at_s >= PLAIN_EVERY_S {
            self.told_at_s = progress.wall_s;
            self.say(&counts_line(progress));
        }
        if let Some(live) = &self.live {
            live.show(progress, self.share_done(progress));
        }
    }

    /// Prints one line that stays.
    pub(crate) fn say(&self, line: &str) {
        match &self.live {
            Some(live) => drop(live.all.println(output::escaped(line))),
            None => output::message(line),
        }
    }

    /// Takes the live lines away; what is said from now on is plain.
    pub(crate) fn close(&mut self) {
        if let Some(live) = self.live.take() {
            live.bar.finish_and_clear();
            live.lines.iter().for_each(ProgressBar::finish_and_clear);
        }
    }

    fn share_done(&self, progress: &pb::Progress) -> f64 {
        match self.until {
            Until::Minutes(minutes) => progress.wall_s / (minutes * 60.0),
            Until::EnvSteps(env_steps) => progress.env_steps as f64 / env_steps as f64,
            Until::Open => 0.0,
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
    fn show(&self, progress: &pb::Progress, share_done: f64) {
        self.bar.set_position((share_done.clamp(0.0, 1.0) * 1000.0) as u64);
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

/// How far a run is.
pub(crate) fn counts_line(progress: &pb::Progress) -> String {
    format!(
        "{} round {}, {} env steps ({:.0}/s), {} updates ({:.0}/s)",
        clock_text(progress.wall_s),
        progress.round,
        grouped(progress.env_steps),
        progress.env_steps_per_s,
        grouped(progress.updates),
        progress.updates_per_s
    )
}

fn warning_line(progress: &pb::Progress) -> String {
    let clock = clock_text(progress.wall_s);
    match progress.warning.as_str() {
        "" => format!("{clock} what was wrong is mended"),
        warning => format!("{clock} warning: {warning}"),
    }
}

/// What an evaluation has brought.
pub(crate) fn evaluation_line(progress: &pb::Progress, evaluation: &pb::Evaluation) -> String {
    format!(
        "{} success {:.3} [{:.3}, {:.3}] at {} env steps; joint {:.3}, contacts {:.3}, mean Q {:.2}, advice {} of {}",
        clock_text(progress.wall_s),
        evaluation.success,
        evaluation.success_low,
        evaluation.success_high,
        grouped(evaluation.env_steps),
        evaluation.success_joint,
        evaluation.collision_rate,
        evaluation.mean_q,
        grouped(progress.advice_spent),
        grouped(progress.advice_spent + progress.budget_left)
    )
}

/// Minutes and seconds.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a run's seconds are positive and few"
)]
pub(crate) fn clock_text(seconds: f64) -> String {
    let seconds = seconds.max(0.0) as u64;
    format!("{:02}:{:02}", seconds / 60, seconds % 60)
}

/// A number with its thousands set apart.
pub(crate) fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let groups: Vec<&str> = digits
        .as_bytes()
        .rchunks(3)
        .rev()
        .filter_map(|group| std::str::from_utf8(group).ok())
        .collect();
    groups.join(",")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_warning_is_told_and_its_end_too() {
        let of = |warning: &str| {
            warning_line(&pb::Progress { warning: warning.to_owned(), ..Default::default() })
        };
        assert_eq!(of("the disk is full"), "00:00 warning: the disk is full");
        assert_eq!(of(""), "00:00 what was wrong is mended");
    }

    #[test]
    fn numbers_and_times_are_written_for_people() {
        assert_eq!(
            [grouped(0), grouped(999), grouped(1_000), grouped(12_345_678)],
            ["0", "999", "1,000", "12,345,678"]
        );
        assert_eq!(
            [clock_text(0.0), clock_text(61.9), clock_text(3600.0)],
            ["00:00", "01:01", "60:00"]
        );
    }
}
