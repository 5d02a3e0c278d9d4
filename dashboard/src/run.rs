//! The site of a run: turns snapshots into the documents that its page shows.

use std::sync::Arc;

use serde::Serialize;
use tandem_telemetry::{RunView, WorkerView};
use tokio::sync::watch;

use crate::document::{Document, encode};
use crate::events::EventLog;
use crate::page;
use crate::playback::Playback;
use crate::site::{Frame, Site};

/// Number of workers that a page lists by name; a run can have thousands.
const MAX_WORKERS: usize = 128;
/// Number of inactive workers that are listed even if there are more active ones than fit.
const MAX_INACTIVE_WORKERS: usize = 32;

impl Site {
    /// Returns the site of a run. It encodes each snapshot of `views` once, in a task of the runtime that calls it,
    /// until the sender is dropped.
    ///
    /// # Panics
    /// If it is called outside a tokio runtime.
    #[must_use]
    pub fn of_run(views: watch::Receiver<RunView>) -> Self {
        let mut feed = Feed::default();
        Self::of_views(page::run(), views, move |view| feed.frame(view))
    }
}

/// The state as pages receive it.
#[derive(Serialize)]
struct State<'a> {
    #[serde(flatten)]
    view: &'a RunView,
    /// Number of workers, of which the first are listed.
    n_workers: usize,
    /// Number of workers that take part.
    n_active_workers: usize,
    /// True if the learner has episodes of the latest evaluation, also those that cannot be played.
    has_episodes: bool,
    versions: Versions,
}

/// Counts the changes of each document.
#[derive(Debug, Clone, Copy, Default, Serialize)]
struct Versions {
    evaluations: u64,
    playback: u64,
    log: u64,
}

/// Documents of the latest snapshot.
struct Feed {
    versions: Versions,
    /// The latest snapshot with evaluations that are encoded in `frame`.
    encoded: Option<RunView>,
    evaluations: Document,
    playback: Arc<str>,
    events: EventLog,
    log: Arc<str>,
}

impl Default for Feed {
    fn default() -> Self {
        let nothing = || encode(&());
        Self {
            versions: Versions::default(),
            encoded: None,
            evaluations: Document::from(nothing()),
            playback: nothing(),
            events: EventLog::default(),
            log: nothing(),
        }
    }
}

impl Feed {
    /// Encodes a snapshot; documents that have not changed are taken from the previous one.
    fn frame(&mut self, view: &RunView) -> Frame {
        let former = self.encoded.take();
        if former.as_ref().is_none_or(|it| !Arc::ptr_eq(&it.evaluations, &view.evaluations)) {
            self.versions.evaluations += 1;
            self.evaluations = Document::of_rows(&view.evaluations);
        }
        if former.as_ref().is_none_or(|it| !Arc::ptr_eq(&it.evaluated, &view.evaluated)) {
            self.versions.playback += 1;
            self.playback = encode(&Playback::of(&view.evaluated));
        }
        // Before the run is loaded its counters are zero, also those of a resumed run.
        if !view.phase.is_empty() && self.events.update(view) {
            self.versions.log += 1;
            self.log = encode(self.events.events());
        }
        self.encoded = Some(view.clone());
        let documents = [
            ("evaluations", self.evaluations.clone()),
            ("playback", self.playback.clone().into()),
            ("log", self.log.clone().into()),
        ];
        Frame { state: self.state(view), documents: documents.into_iter().collect() }
    }

    fn state(&self, view: &RunView) -> Arc<str> {
        let n_active_workers = view.workers.iter().filter(|it| it.state.is_active()).count();
        let (n_workers, versions) = (view.workers.len(), self.versions);
        let has_episodes = !view.evaluated.is_empty();
        let state = State { view, n_workers, n_active_workers, has_episodes, versions };
        if n_workers <= MAX_WORKERS {
            return encode(&state);
        }
        let view = &RunView { workers: listed(&view.workers), ..view.clone() };
        encode(&State { view, ..state })
    }
}

/// Selects at most [`MAX_WORKERS`] workers, by number: active ones first, then the latest of the others. Workers that a
/// rollout has replaced remain known for minutes.
fn listed(workers: &[WorkerView]) -> Vec<WorkerView> {
    let (active, inactive): (Vec<&WorkerView>, Vec<&WorkerView>) =
        workers.iter().partition(|it| it.state.is_active());
    let room = MAX_WORKERS - active.len().min(MAX_WORKERS - MAX_INACTIVE_WORKERS);
    let latest = &inactive[inactive.len().saturating_sub(room)..];
    let mut listed: Vec<WorkerView> =
        latest.iter().chain(&active).take(MAX_WORKERS).map(|it| (*it).clone()).collect();
    listed.sort_by_key(|it| it.id);
    listed
}

#[cfg(test)]
mod tests {
    use serde_json::Value;
    use tandem_telemetry::{MetricsRow, WorkerState, WorkerView};

    use super::*;

    fn json(text: &str) -> Value {
        serde_json::from_str(text).expect("JSON")
    }

    #[test]
    fn only_documents_that_change_get_a_new_version() {
        let mut feed = Feed::default();
        let mut view = RunView { mean_q: f64::NAN, ..RunView::default() };
        let first = feed.frame(&view);
        assert_eq!(json(&first.state)["mean_q"], Value::Null);
        view.env_steps = 100;
        let second = feed.frame(&view);
        assert_eq!(json(&second.state)["env_steps"], 100);
        assert_eq!(json(&first.state)["versions"], json(&second.state)["versions"]);
        view.evaluations = Arc::new([MetricsRow { success: 0.25, ..MetricsRow::default() }]);
        let third = feed.frame(&view);
        let versions = |frame: &Frame| json(&frame.state)["versions"].clone();
        assert_ne!(versions(&second)["evaluations"], versions(&third)["evaluations"]);
        assert_eq!(versions(&second)["playback"], versions(&third)["playback"]);
        assert_eq!(json(third.documents["evaluations"].text())[0]["success"], 0.25);
        assert_eq!(json(third.documents["playback"].text()), Value::Null);
    }

    #[test]
    fn a_state_lists_a_bounded_number_of_workers() {
        let worker = |id| WorkerView {
            id,
            name: format!("w{id}"),
            state: if id % 2 == 0 { WorkerState::Playing } else { WorkerState::Silent },
            slot: None,
            n_episodes: 0,
            last_seen_s: 0.0,
        };
        let view = RunView { workers: (0..10_000).map(worker).collect(), ..RunView::default() };
        let state = json(&Feed::default().frame(&view).state);
        assert_eq!(state["workers"].as_array().map(Vec::len), Some(MAX_WORKERS));
        // A rollout has replaced the first 200 workers by others.
        let worker = |id: u64| {
            let state = if id < 200 { WorkerState::Disconnected } else { WorkerState::Playing };
            let name = id.to_string();
            WorkerView { id, name, state, slot: None, n_episodes: 0, last_seen_s: 0.0 }
        };
        let ids = |n| listed(&(0..n).map(worker).collect::<Vec<_>>());
        let ids = |n| ids(n).iter().map(|it| it.id).collect::<Vec<_>>();
        assert_eq!(ids(400), (168..296).collect::<Vec<_>>());
        assert_eq!(ids(210), (82..210).collect::<Vec<_>>());
        assert_eq!(state["n_workers"], 10_000);
        assert_eq!(state["n_active_workers"], 5_000);
    }
}
