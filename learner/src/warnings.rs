//! Problems that require an operator, joined in the progress.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use tokio::sync::watch;

use crate::progress::Progress;

/// The subject of a warning, in the order in which the progress lists them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Source {
    /// Files that cannot be written.
    Disk,
    /// An account that an earlier run has used.
    Account,
    /// Episodes that claim other charges than the account has.
    Claims,
    /// Environments that do not repeat their episodes.
    Environment,
    /// Environments that fail repeatedly.
    Failures,
    /// A statistic of the normalisers is out of all proportion.
    Statistics,
    /// The teacher advises by another policy than before.
    Policy,
    /// The teacher.
    Teacher,
}

/// Separates the warnings in the progress.
const SEPARATOR: &str = "; ";

/// The latest warning of each source. Clones share it.
#[derive(Debug, Clone)]
pub(crate) struct Warnings {
    by_source: Arc<Mutex<BTreeMap<Source, String>>>,
    progress: watch::Sender<Progress>,
}

impl Warnings {
    /// Creates an empty set of warnings that appear in `progress`.
    pub(crate) fn new(progress: watch::Sender<Progress>) -> Self {
        Self { by_source: Arc::default(), progress }
    }

    /// Replaces the warning of `source`; an empty one withdraws it.
    pub(crate) fn set(&self, source: Source, warning: &str) {
        let warning = inseparable(warning);
        let mut by_source = self.by_source.lock().unwrap_or_else(PoisonError::into_inner);
        let former = by_source.insert(source, warning.clone());
        if former.unwrap_or_default() == warning {
            return;
        }
        let all: Vec<&str> = by_source.values().map(String::as_str).collect();
        let all: Vec<&str> = all.into_iter().filter(|warning| !warning.is_empty()).collect();
        self.progress.send_modify(|progress| progress.warning = all.join(SEPARATOR));
    }

    /// Logs and sets the warning of `source` if it is another than before.
    pub(crate) fn set_latest(&self, source: Source, warning: &str) {
        let is_known = self.of(source).is_some_and(|former| former == inseparable(warning));
        if !is_known {
            tracing::warn!(kind = ?source, text = warning, "needs attention");
            self.set(source, warning);
        }
    }

    /// Returns the latest warning of `source`, which may be empty; `None` if it never warned.
    pub(crate) fn of(&self, source: Source) -> Option<String> {
        let by_source = self.by_source.lock().unwrap_or_else(PoisonError::into_inner);
        by_source.get(&source).cloned()
    }

    /// Logs and sets the first warning of `source`; later ones are logged at level debug only.
    pub(crate) fn set_first(&self, source: Source, warning: &str) {
        if self.of(source).is_some() {
            tracing::debug!(kind = ?source, text = warning, "needs attention again");
            return;
        }
        tracing::warn!(kind = ?source, text = warning, "needs attention");
        self.set(source, warning);
    }
}

/// Returns a warning with a comma in place of the separator, which the text of an error may contain: displays split the
/// progress into its warnings.
fn inseparable(warning: &str) -> String {
    warning.replace(SEPARATOR, ", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn withdrawing_a_warning_leaves_those_of_other_sources() {
        let (progress, shown) = watch::channel(Progress::default());
        let warnings = Warnings::new(progress);
        let check = |source, warning, expected| {
            warnings.set(source, warning);
            assert_eq!(shown.borrow().warning, expected);
        };
        check(Source::Teacher, "no ledger", "no ledger");
        check(Source::Disk, "no disk", "no disk; no ledger");
        check(Source::Disk, "", "no ledger");
        check(Source::Teacher, "", "");
    }

    #[test]
    fn a_warning_with_a_semicolon_stays_one_warning() {
        let (progress, shown) = watch::channel(Progress::default());
        let warnings = Warnings::new(progress);
        warnings.set(Source::Teacher, "no answer: refused; try again; later");
        warnings.set(Source::Disk, "no disk");
        assert_eq!(shown.borrow().warning, "no disk; no answer: refused, try again, later");
    }

    #[test]
    fn a_source_that_warns_once_keeps_its_first_warning() {
        let (progress, shown) = watch::channel(Progress::default());
        let warnings = Warnings::new(progress);
        warnings.set_first(Source::Claims, "round 3");
        warnings.set_first(Source::Claims, "round 4");
        assert_eq!(shown.borrow().warning, "round 3");
    }
}
