//! What needs a person's attention, gathered from those who notice it and shown in the progress.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use tandem_proto::pb;
use tokio::sync::watch;

/// Who notices what is wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Source {
    /// The thread that learns.
    Learner,
    /// The teacher.
    Teacher,
}

/// The latest warning of each source, joined in `Progress.warning`.
#[derive(Debug, Clone)]
pub(crate) struct Warnings {
    by_source: Arc<Mutex<BTreeMap<Source, String>>>,
    progress: watch::Sender<pb::Progress>,
}

impl Warnings {
    pub(crate) fn new(progress: watch::Sender<pb::Progress>) -> Self {
        Self { by_source: Arc::default(), progress }
    }

    /// Replaces the warning of `source`; an empty one withdraws it.
    pub(crate) fn set(&self, source: Source, warning: &str) {
        let mut by_source = self.by_source.lock().unwrap_or_else(PoisonError::into_inner);
        let former = by_source.insert(source, warning.to_owned());
        if former.unwrap_or_default() == warning {
            return;
        }
        let all: Vec<&str> = by_source.values().map(String::as_str).collect();
        let all: Vec<&str> = all.into_iter().filter(|warning| !warning.is_empty()).collect();
        self.progress.send_modify(|progress| progress.warning = all.join("; "));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_source_that_has_nothing_to_say_does_not_withdraw_the_warning_of_another() {
        let (progress, shown) = watch::channel(pb::Progress::default());
        let warnings = Warnings::new(progress);
        let check = |source, warning, expected| {
            warnings.set(source, warning);
            assert_eq!(shown.borrow().warning, expected);
        };
        check(Source::Teacher, "no ledger", "no ledger");
        check(Source::Learner, "no disk", "no disk; no ledger");
        check(Source::Learner, "", "no ledger");
        check(Source::Teacher, "", "");
    }
}
