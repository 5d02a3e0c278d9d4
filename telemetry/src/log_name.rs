//! The names of logs of episodes and motions.

use std::path::Path;

/// A log's kind and numbers, as in its name. The order is that of age within a kind, training episodes and motions
/// before evaluations. The order of the names as texts differs from it once a number outgrows its digits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct LogName {
    /// True if the episode belongs to an evaluation.
    pub is_evaluation: bool,
    /// Version of the episode's parameters, which is the number of finished rounds; the date for motions.
    pub version: u64,
    /// Number of the episode or motion.
    pub number: u64,
}

impl LogName {
    /// Parses the name of the file at `path`: `train-VERSION-EPISODE.mcap`, `eval-VERSION-EPISODE.mcap`,
    /// `motion-DATE-NUMBER.mcap` or `stop-DATE-NUMBER.mcap`. Returns `None` for other names.
    #[must_use]
    pub fn of(path: &Path) -> Option<Self> {
        let stem = path.file_name()?.to_str()?.strip_suffix(".mcap")?;
        let mut parts = stem.split('-');
        let is_evaluation = match parts.next()? {
            "train" | "motion" | "stop" => false,
            "eval" => true,
            _ => return None,
        };
        let (version, number) = (parts.next()?.parse().ok()?, parts.next()?.parse().ok()?);
        parts.next().is_none().then_some(Self { is_evaluation, version, number })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_have_the_order_of_their_numbers() {
        let of = |name: &str| LogName::of(Path::new(name));
        let ordered = [
            "runs/a/mcap/train-999999-000001.mcap",
            "train-1000000-000000.mcap",
            "motion-20260101-000001.mcap",
            "eval-999999-000.mcap",
            "eval-999999-1000.mcap",
            "eval-1000000-000.mcap",
        ];
        let names: Vec<LogName> = ordered.iter().filter_map(|name| of(name)).collect();
        assert_eq!(names.len(), ordered.len());
        assert!(names.is_sorted(), "{names:?}");
        for other in
            ["notes.txt", "eval-1-2.mcap.part", "eval-1-2-3.mcap", "eval-x-2.mcap", "a.mcap"]
        {
            assert_eq!(of(other), None, "{other}");
        }
    }
}
