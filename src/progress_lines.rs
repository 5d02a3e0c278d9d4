//! The lines about a run's progress that stay: those of `tandem train`, and of `tandem status --watch`.

use tandem_proto::pb;

use crate::progress_text::{counts_line, evaluation_line, warning_line};

/// Seconds of run time after which a line is printed even without news.
const LINE_EVERY_S: f64 = 30.0;

/// A new line about the progress.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum ProgressLine {
    /// A warning or its end.
    Warning(String),
    /// The result of an evaluation.
    Evaluation(String),
    /// The counts of a run without news for half a minute.
    Counts(String),
}

/// Selects what is new in each message: a line for each warning and its end, for each evaluation, and every half minute.
#[derive(Debug, Default)]
pub(crate) struct ProgressLines {
    /// Round of the latest evaluation.
    round: Option<u64>,
    /// Run time of the latest evaluation or counts in this stream, seconds.
    at_s: Option<f64>,
    warning: String,
    /// The next message is the first of a stream.
    begins_stream: bool,
}

impl ProgressLines {
    /// Forgets the warning and the time: the following messages may be those of a restarted learner. It does not know
    /// whether the problem of the former one is solved, and continues from the time of its checkpoint.
    pub(crate) fn begin_stream(&mut self) {
        self.warning.clear();
        self.at_s = None;
        self.begins_stream = true;
    }

    /// Returns the lines about `progress` that are new.
    pub(crate) fn of(&mut self, progress: &pb::Progress) -> Vec<ProgressLine> {
        let mut lines = Vec::new();
        let latest = progress.evaluation.as_ref();
        let is_known = |round: u64| self.round.is_some_and(|known| round <= known);
        if self.begins_stream && latest.is_some_and(|latest| is_known(latest.round)) {
            // A restarted learner still has the evaluation of its checkpoint, and repeats those after it.
            self.round = latest.map(|latest| latest.round);
        }
        self.begins_stream = false;
        if progress.warning != self.warning {
            self.warning.clone_from(&progress.warning);
            lines.push(ProgressLine::Warning(warning_line(progress)));
        }
        let is_due = self.at_s.is_none_or(|at_s| progress.wall_s - at_s >= LINE_EVERY_S);
        if let Some(evaluation) = latest
            && self.round != Some(evaluation.round)
        {
            (self.round, self.at_s) = (Some(evaluation.round), Some(progress.wall_s));
            lines.push(ProgressLine::Evaluation(evaluation_line(progress, evaluation)));
        } else if is_due {
            self.at_s = Some(progress.wall_s);
            lines.push(ProgressLine::Counts(counts_line(progress)));
        }
        lines
    }
}

impl ProgressLine {
    /// Returns the text of the line.
    pub(crate) fn text(&self) -> &str {
        match self {
            Self::Warning(text) | Self::Evaluation(text) | Self::Counts(text) => text,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(
        lines: &mut ProgressLines,
        (wall_s, warning, round): (f64, &str, Option<u64>),
        expected: &[&str],
    ) {
        let evaluation =
            round.map(|round| pb::Evaluation { round, success: 0.5, ..Default::default() });
        let warning = warning.to_owned();
        let progress = pb::Progress { wall_s, warning, evaluation, ..Default::default() };
        let lines = lines.of(&progress);
        assert_eq!(lines.len(), expected.len(), "{lines:?}");
        for (line, word) in lines.iter().zip(expected) {
            assert!(line.text().contains(word), "{line:?} lacks {word:?}");
        }
    }

    #[test]
    fn warnings_and_their_ends_are_lines_too() {
        let lines = &mut ProgressLines::default();
        check(lines, (0.0, "", None), &["0 updates"]);
        check(lines, (1.0, "the disk is full", None), &["00:01 warning: the disk is full"]);
        check(lines, (2.0, "the disk is full", None), &[]);
        check(lines, (3.0, "a worker is silent", Some(4)), &["is silent", "success 0.500"]);
        check(lines, (4.0, "", Some(4)), &["00:04 the problem is solved"]);
        check(lines, (32.0, "", Some(4)), &[]);
        check(lines, (33.0, "", Some(4)), &["0 updates"]);
    }

    #[test]
    fn a_restarted_learner_has_solved_no_problem() {
        let lines = &mut ProgressLines::default();
        check(lines, (0.0, "the disk is full", None), &["the disk is full", "0 updates"]);
        lines.begin_stream();
        check(lines, (1.0, "", None), &["0 updates"]);
        check(lines, (2.0, "the disk is full", None), &["the disk is full"]);
        check(lines, (3.0, "", None), &["the problem is solved"]);
    }

    #[test]
    fn a_restarted_learner_is_followed_from_the_time_of_its_checkpoint() {
        let lines = &mut ProgressLines::default();
        lines.begin_stream();
        check(lines, (300.0, "", Some(75)), &["05:00 0 env steps: success 0.500"]);
        lines.begin_stream();
        check(lines, (200.0, "", Some(50)), &["03:20 0 env steps, 0 updates"]);
        check(lines, (229.0, "", Some(50)), &[]);
        check(lines, (230.0, "", Some(50)), &["0 updates"]);
        check(lines, (240.0, "", Some(75)), &["04:00 0 env steps: success 0.500"]);
        lines.begin_stream();
        check(lines, (290.0, "", Some(100)), &["success 0.500"]);
    }
}
