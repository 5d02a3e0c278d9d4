//! Texts about the progress of a run.

use tandem_proto::pb;

/// Returns the counts of a run and their rates.
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

/// Returns the result of an evaluation.
pub(crate) fn evaluation_line(progress: &pb::Progress, evaluation: &pb::Evaluation) -> String {
    let without_contact = evaluation.success_without_contact.filter(|_| progress.n_arms > 1);
    let without_contact = without_contact.map(|share| format!(", {share:.3} without arm contact"));
    format!(
        "{} success {:.3} [{:.3}, {:.3}]{} at {} env steps; joint {:.3}, contacts {:.3}, mean Q {:.2}, advice {} of {}",
        clock_text(progress.wall_s),
        evaluation.success,
        evaluation.success_low,
        evaluation.success_high,
        without_contact.unwrap_or_default(),
        grouped(evaluation.env_steps),
        evaluation.success_joint,
        evaluation.collision_rate,
        evaluation.mean_q,
        grouped(progress.advice_spent),
        grouped(progress.advice_spent + progress.budget_left)
    )
}

/// Formats a time as minutes and seconds.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a run's seconds are positive and few"
)]
pub(crate) fn clock_text(seconds: f64) -> String {
    let seconds = seconds.max(0.0) as u64;
    format!("{:02}:{:02}", seconds / 60, seconds % 60)
}

/// Formats a number with a comma between groups of three digits.
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
    fn numbers_are_grouped_and_times_have_minutes() {
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
