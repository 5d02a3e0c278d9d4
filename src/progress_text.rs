//! Texts about the progress of a run, the same on its own terminal and in `tandem status`. Lines have at most 80 columns
//! unless a name in them is long.

use std::collections::BTreeMap;

use tandem_core::text::counted;
use tandem_proto::pb;
use tandem_report::table::thousands;

/// Workers that are named one by one; more are counted.
const MAX_NAMED_WORKERS: usize = 4;

/// Returns the environment steps and updates of a run and the remaining time, after the time so far.
pub(crate) fn counts_line(progress: &pb::Progress) -> String {
    let steps = thousands(progress.env_steps);
    let steps = match progress.max_env_steps {
        0 => format!("{steps} env steps"),
        max => format!("{steps} of {} env steps", thousands(max)),
    };
    let left = remaining_s(progress).map(|left_s| format!(", {} left", clock_text(left_s)));
    format!(
        "{} {steps}{}, {} updates{}",
        clock_text(progress.wall_s),
        rate(progress.env_steps_per_s),
        thousands(progress.updates),
        left.unwrap_or_default()
    )
}

/// Returns a rate in parentheses; nothing before the first was measured.
fn rate(per_s: f64) -> String {
    if per_s > 0.0 { format!(" ({per_s:.0}/s)") } else { String::new() }
}

/// Returns the time until the first limit of the run, in seconds: that of minutes, or that of environment steps at the
/// present rate. `None` without a limit, before the rate is known, and once the run has ended.
pub(crate) fn remaining_s(progress: &pb::Progress) -> Option<f64> {
    if progress.ended {
        return None;
    }
    let steps = progress.max_env_steps.saturating_sub(progress.env_steps) as f64;
    let is_limited = progress.max_env_steps > 0 && progress.env_steps_per_s > 0.0;
    let by_steps = is_limited.then(|| steps / progress.env_steps_per_s);
    let by_time =
        (progress.max_minutes > 0.0).then_some(60.0 * progress.max_minutes - progress.wall_s);
    let first = by_steps.into_iter().chain(by_time).reduce(f64::min);
    first.map(|left_s| left_s.max(0.0))
}

/// Returns the share of the run that is done, in [0, 1]; 0 without a limit.
pub(crate) fn fraction_done(progress: &pb::Progress) -> f64 {
    let share = |done: f64, limit: f64| if limit > 0.0 { done / limit } else { 0.0 };
    let by_steps = share(progress.env_steps as f64, progress.max_env_steps as f64);
    by_steps.max(share(progress.wall_s, 60.0 * progress.max_minutes)).clamp(0.0, 1.0)
}

/// Returns the result of an evaluation.
pub(crate) fn evaluation_line(progress: &pb::Progress, evaluation: &pb::Evaluation) -> String {
    let without_contact = success_without_contact(progress, evaluation);
    let without_contact = without_contact.map(|share| format!(", {share:.3} without contact"));
    format!(
        "{} {} env steps: success {:.3} [{:.3}, {:.3}]{}",
        clock_text(progress.wall_s),
        thousands(evaluation.env_steps),
        evaluation.success,
        evaluation.success_low,
        evaluation.success_high,
        without_contact.unwrap_or_default(),
    )
}

/// Returns the share of episodes that succeed without contact, by which the best policy of several arms is selected.
fn success_without_contact(progress: &pb::Progress, evaluation: &pb::Evaluation) -> Option<f64> {
    evaluation.success_without_contact.filter(|_| progress.n_arms > 1)
}

/// Returns the state of a run: its best evaluation, advice and processes.
pub(crate) fn state_lines(progress: &pb::Progress) -> Vec<String> {
    let best = match &progress.best {
        Some(best) => {
            let without_contact = success_without_contact(progress, best);
            let without_contact =
                without_contact.map(|share| format!(" ({share:.3} without contact)"));
            let (without_contact, env_steps) =
                (without_contact.unwrap_or_default(), thousands(best.env_steps));
            format!("{:.3}{without_contact} at {env_steps} env steps", best.success)
        }
        None => "none yet".to_owned(),
    };
    let mut lines = vec![format!("best success {best}; training {:.2}", progress.training_success)];
    lines.extend(advice_text(progress).map(|advice| format!("advice {advice}")));
    if !progress.phase.is_empty() {
        lines.push(format!("learner {}; {}", progress.phase, workers_text(progress)));
    }
    lines
}

/// Returns the advice that the run has spent and the steps on which it asked; `None` if it asks for none.
pub(crate) fn advice_text(progress: &pb::Progress) -> Option<String> {
    let (spent, left) = (progress.advice_spent, progress.budget_left);
    let queries =
        progress.advice_queries.map(|queries| format!(", {} queries", thousands(queries)));
    let queries = queries.unwrap_or_default();
    (spent > 0 || left > 0)
        .then(|| format!("{} spent, {} left{queries}", thousands(spent), thousands(left)))
}

/// Returns what each worker does, or how many do it if there are many.
fn workers_text(progress: &pb::Progress) -> String {
    let workers = &progress.workers;
    if workers.len() <= MAX_NAMED_WORKERS {
        let named = workers.iter().map(|worker| format!("{} {}", worker.name, worker.doing));
        let named = named.collect::<Vec<_>>().join(", ");
        return if named.is_empty() { "no workers".to_owned() } else { named };
    }
    let mut counts = BTreeMap::<&str, usize>::new();
    for worker in workers {
        let doing = if worker.doing.starts_with("slot") { "playing" } else { &worker.doing };
        *counts.entry(doing).or_default() += 1;
    }
    let counts = counts.into_iter().map(|(doing, n)| format!("{n} {doing}"));
    format!("{}: {}", counted(workers.len(), "worker"), counts.collect::<Vec<_>>().join(", "))
}

/// Formats a time as minutes and seconds, after hours if there are any.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a run's seconds are positive and few"
)]
pub(crate) fn clock_text(seconds: f64) -> String {
    let seconds = seconds.max(0.0) as u64;
    let (hours, minutes, seconds) = (seconds / 3600, seconds / 60 % 60, seconds % 60);
    match hours {
        0 => format!("{minutes:02}:{seconds:02}"),
        _ => format!("{hours}:{minutes:02}:{seconds:02}"),
    }
}

/// Describes the failures of environments on servers, if there were any.
pub(crate) fn failures_text(progress: &pb::Progress) -> Option<String> {
    match progress.environment_failures {
        0 => None,
        1 => Some("failed once, the log of the worker has the cause".to_owned()),
        n => Some(format!("failed {} times, the log of the workers has the causes", thousands(n))),
    }
}

/// Returns the line of a warning, or of its end if `warning` is empty.
pub(crate) fn warning_line(progress: &pb::Progress) -> String {
    let clock = clock_text(progress.wall_s);
    match progress.warning.as_str() {
        "" => format!("{clock} the problem is solved"),
        warning => format!("{clock} warning: {warning}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::columns::N_COLUMNS;

    /// Returns the progress of a long run with large numbers.
    fn progress() -> pb::Progress {
        let evaluation = pb::Evaluation {
            env_steps: 299_200,
            success: 0.9583,
            success_low: 0.925,
            success_high: 0.977,
            success_without_contact: Some(0.9),
            ..Default::default()
        };
        pb::Progress {
            task: "push".to_owned(),
            n_arms: 2,
            wall_s: 4_000.0,
            env_steps: 299_200,
            max_env_steps: 300_000,
            env_steps_per_s: 236.4,
            updates: 149_600,
            advice_spent: 4_301,
            budget_left: 495_699,
            phase: "collecting".to_owned(),
            best: Some(evaluation.clone()),
            evaluation: Some(evaluation),
            ..Default::default()
        }
    }

    #[test]
    fn lines_fit_a_terminal_of_80_columns() {
        let progress = progress();
        let evaluation = progress.evaluation.as_ref().expect("set");
        let mut lines = vec![counts_line(&progress), evaluation_line(&progress, evaluation)];
        lines.extend(state_lines(&progress));
        let expected = [
            "1:06:40 299,200 of 300,000 env steps (236/s), 149,600 updates, 00:03 left",
            "1:06:40 299,200 env steps: success 0.958 [0.925, 0.977], 0.900 without contact",
            "best success 0.958 (0.900 without contact) at 299,200 env steps; training 0.00",
            "advice 4,301 spent, 495,699 left",
            "learner collecting; no workers",
        ];
        assert_eq!(lines, expected);
        let long = lines.iter().filter(|line| line.len() > N_COLUMNS);
        assert_eq!(long.count(), 0, "{lines:?}");
    }

    #[test]
    fn the_remaining_time_needs_a_limit_and_a_rate() {
        let mut progress = progress();
        progress.env_steps_per_s = 0.0;
        assert_eq!(remaining_s(&progress), None, "no rate yet");
        progress.max_minutes = 70.0;
        assert_eq!(remaining_s(&progress), Some(200.0), "the limit of time needs none");
        progress.env_steps_per_s = 10.0;
        assert_eq!(remaining_s(&progress), Some(80.0), "the first limit counts");
        progress.ended = true;
        assert_eq!(remaining_s(&progress), None);
    }

    #[test]
    fn many_workers_are_counted() {
        let worker = |doing: &str| pb::WorkerProgress {
            name: "w".to_owned(),
            doing: doing.to_owned(),
            ..Default::default()
        };
        let doing = ["slot 1", "slot 2", "waiting", "silent", "slot 4"];
        let mut progress = progress();
        progress.workers = doing.map(worker).to_vec();
        assert_eq!(workers_text(&progress), "5 workers: 3 playing, 1 silent, 1 waiting");
        progress.workers.truncate(2);
        assert_eq!(workers_text(&progress), "w slot 1, w slot 2");
    }

    #[test]
    fn failures_of_environments_are_counted() {
        let of = |environment_failures| {
            failures_text(&pb::Progress { environment_failures, ..Default::default() })
        };
        assert_eq!(of(0), None);
        assert_eq!(of(1).as_deref(), Some("failed once, the log of the worker has the cause"));
        assert_eq!(
            of(1_300).as_deref(),
            Some("failed 1,300 times, the log of the workers has the causes")
        );
    }

    #[test]
    fn a_warning_and_its_end_are_printed() {
        let of = |warning: &str| {
            warning_line(&pb::Progress { warning: warning.to_owned(), ..Default::default() })
        };
        assert_eq!(of("the disk is full"), "00:00 warning: the disk is full");
        assert_eq!(of(""), "00:00 the problem is solved");
    }

    #[test]
    fn times_have_minutes() {
        assert_eq!(
            [clock_text(0.0), clock_text(61.9), clock_text(3600.0), clock_text(7325.0)],
            ["00:00", "01:01", "1:00:00", "2:02:05"]
        );
    }
}
