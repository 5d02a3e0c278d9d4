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
    /// Run time of the latest evaluation or counts, seconds.
    at_s: Option<f64>,
    warning: String,
}

impl ProgressLines {
    /// Forgets the warning: the following messages may be those of a restarted learner, which does not know whether the
    /// problem of the former one is solved.
    pub(crate) fn begin_stream(&mut self) {
        self.warning.clear();
    }

    /// Returns the lines about `progress` that are new.
    pub(crate) fn of(&mut self, progress: &pb::Progress) -> Vec<ProgressLine> {
        let mut lines = Vec::new();
        if progress.warning != self.warning {
            self.warning.clone_from(&progress.warning);
            lines.push(ProgressLine::Warning(warning_line(progress)));
        }
        let is_due = self.at_s.is_none_or(|at_s| progress.wall_s - at_s >= LINE_EVERY_S);
        if let Some(evaluation) = progress.evaluation.as_ref()
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
        check(lines, (1.0, "", None), &[]);
        check(lines, (2.0, "the disk is full", None), &["the disk is full"]);
        check(lines, (3.0, "", None), &["the problem is solved"]);
    }
}
