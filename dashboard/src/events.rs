//! Recent events of a run, from the differences between snapshots.

use std::collections::{BTreeMap, VecDeque};

use serde::Serialize;
use tandem_core::text::counted;
use tandem_telemetry::{EndView, MetricsRow, RunView, TeacherState, WorkerState, WorkerView};

/// Number of routine events that are kept, and number of all others.
pub(crate) const KEPT: usize = 60;
/// Largest number of workers that events name at a time.
const MAX_NAMED: usize = 4;

/// An event.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Event {
    /// Seconds of the run's wall time.
    pub(crate) at_s: f64,
    pub(crate) level: Level,
    pub(crate) text: String,
}

/// The importance of an event.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Level {
    /// Progress.
    Info,
    /// Success, or the end of a problem.
    Good,
    /// A problem that the run overcomes by itself.
    Warning,
    /// A problem that requires an operator.
    Bad,
}

/// The recent events, oldest first.
#[derive(Debug, Default)]
pub(crate) struct EventLog {
    events: VecDeque<Event>,
    former: Option<RunView>,
}

impl EventLog {
    /// Adds the events between the previous snapshot and `view`; returns true if there are any.
    pub(crate) fn update(&mut self, view: &RunView) -> bool {
        let mut new = Vec::new();
        let former = self.former.take().unwrap_or_else(|| {
            new.push((Level::Info, start(view)));
            before_start(view)
        });
        // Workers leave at the end of a run.
        if view.end.is_none() {
            workers(&former.workers, &view.workers, &mut new);
        }
        evaluations(&former, view, &mut new);
        problems(&former, view, &mut new);
        self.former = Some(view.clone());
        let has_new = !new.is_empty();
        for (level, text) in new {
            self.events.push_back(Event { at_s: view.wall_s, level, text });
        }
        forget_old(&mut self.events, |it| it.level == Level::Info);
        has_new
    }

    /// Returns the events, oldest first.
    pub(crate) const fn events(&self) -> &VecDeque<Event> {
        &self.events
    }
}

/// Removes the oldest events. Routine ones are counted separately: a fast run has an evaluation every second, and these
/// would displace problems.
pub(crate) fn forget_old<E>(events: &mut VecDeque<E>, is_routine: impl Fn(&E) -> bool) {
    for routine in [true, false] {
        let of_kind = |it: &E| is_routine(it) == routine;
        let n = events.iter().filter(|it| of_kind(it)).count();
        let mut n_left_out = n.saturating_sub(KEPT);
        events.retain(|it| {
            let is_left_out = n_left_out > 0 && of_kind(it);
            n_left_out -= usize::from(is_left_out);
            !is_left_out
        });
    }
}

type New = Vec<(Level, String)>;

fn start(view: &RunView) -> String {
    match view.resumed_from_round {
        0 => "The learner started".to_owned(),
        round => format!("The learner continues from round {round}"),
    }
}

/// Returns the run as it was before the learner started: a fast one has rounds behind it in its first snapshot.
fn before_start(view: &RunView) -> RunView {
    let round = view.resumed_from_round;
    let is_earlier = |row: &&MetricsRow| round > 0 && row.round <= round;
    let evaluations = view.evaluations.iter().filter(is_earlier).cloned().collect();
    RunView { evaluations, ..RunView::default() }
}

/// Adds the workers that came, went or returned.
fn workers(former: &[WorkerView], now: &[WorkerView], new: &mut New) {
    let before: BTreeMap<u64, &WorkerView> = former.iter().map(|it| (it.id, it)).collect();
    let after: BTreeMap<u64, &WorkerView> = now.iter().map(|it| (it.id, it)).collect();
    let replaced =
        |name: &str| former.iter().any(|it| it.name == name && !after.contains_key(&it.id));
    let changed = |from: fn(WorkerState) -> bool, to: fn(WorkerState) -> bool| {
        let names = now.iter().filter(|it| {
            before.get(&it.id).is_some_and(|before| from(before.state)) && to(it.state)
        });
        names.map(|it| it.name.as_str()).collect::<Vec<_>>()
    };
    let is_new = |it: &&WorkerView| !before.contains_key(&it.id);
    let (again, joined): (Vec<&str>, Vec<&str>) =
        now.iter().filter(is_new).map(|it| it.name.as_str()).partition(|name| replaced(name));
    let active: fn(WorkerState) -> bool = WorkerState::is_active;
    let lost = changed(active, |to| to == WorkerState::Disconnected);
    let silent = changed(|from| from != WorkerState::Silent, |to| to == WorkerState::Silent);
    let returned = changed(|from| !from.is_active(), active);
    add(new, Level::Info, &joined, "joined");
    add(new, Level::Good, &again, "restarted");
    add(new, Level::Warning, &lost, "disconnected; its slot goes to another worker");
    add(new, Level::Warning, &silent, "stopped calling; its slot goes to another worker");
    add(new, Level::Good, &returned, "returned");
}

/// Adds one event per worker, or one for all if there are many.
fn add(new: &mut New, level: Level, names: &[&str], what: &str) {
    if names.len() > MAX_NAMED {
        let verb = what.split(';').next().unwrap_or(what);
        new.push((level, format!("{} {verb}", counted(names.len(), "worker"))));
        return;
    }
    new.extend(names.iter().map(|name| (level, format!("{name} {what}"))));
}

fn evaluations(former: &RunView, view: &RunView, new: &mut New) {
    let known = former.evaluations.len().min(view.evaluations.len());
    for row in &view.evaluations[known..] {
        let level = if row.best { Level::Good } else { Level::Info };
        new.push((level, evaluation(row)));
    }
}

fn evaluation(row: &MetricsRow) -> String {
    let best = if row.best { ", the best so far" } else { "" };
    // The success without contact selects the best policy of several arms.
    let without_contact =
        row.contacts.success_without_contact.filter(|_| row.success_per_arm.len() > 1);
    let without_contact =
        without_contact.map(|share| format!(", {} without contact", percent(share)));
    format!(
        "Evaluation in round {}: success {}{}{best}",
        row.round,
        percent(row.success),
        without_contact.unwrap_or_default()
    )
}

/// Formats a share as pages do: halves are rounded up.
pub(crate) fn percent(share: f64) -> String {
    format!("{:.1} %", (1000.0 * share).round() / 10.0)
}

/// Adds changes of the warning, of the teacher and of its ledger, and the end of the run.
fn problems(former: &RunView, view: &RunView, new: &mut New) {
    let (before, now) = (&former.teacher, &view.teacher);
    if before.state != now.state {
        match now.state {
            TeacherState::None => {}
            TeacherState::Answering if before.state == TeacherState::None => {
                new.push((Level::Info, "The teacher answers".to_owned()));
            }
            TeacherState::Answering => {
                new.push((Level::Good, "The teacher answers again".to_owned()));
            }
            TeacherState::Unreachable => {
                new.push((Level::Warning, "The teacher does not answer".to_owned()));
            }
            TeacherState::Lost => {
                new.push((Level::Warning, "The teacher has lost the account".to_owned()));
            }
        }
    }
    match warnings(&former.warning, &view.warning) {
        Warnings::New(texts) => {
            new.extend(texts.into_iter().map(|text| (Level::Bad, sentence(text))));
        }
        Warnings::Solved(texts) => {
            new.extend(texts.into_iter().map(|text| (Level::Good, format!("Solved: {text}"))));
        }
    }
    if let (None, Some(EndView { reason, interrupted, digest })) = (&former.end, &view.end) {
        new.push(match (interrupted, digest) {
            (true, None) => (Level::Bad, format!("The run has failed: {reason}")),
            (true, Some(_)) => (Level::Warning, format!("The run has ended: {reason}")),
            (false, _) => (Level::Good, format!("The run has ended: {reason}")),
        });
    }
}

/// The change of a list of warnings.
pub(crate) enum Warnings<'a> {
    /// Warnings that were not there before; they may replace others.
    New(Vec<&'a str>),
    /// Warnings that are gone, if there is no new one.
    Solved(Vec<&'a str>),
}

/// Compares two lists of warnings, which are joined by semicolons.
pub(crate) fn warnings<'a>(before: &'a str, now: &'a str) -> Warnings<'a> {
    let only_in = |these: &'a str, others: &'a str| -> Vec<&'a str> {
        let is_other = |text: &&str| others.split("; ").any(|other| other == *text);
        these.split("; ").filter(|text| !text.is_empty() && !is_other(text)).collect()
    };
    match only_in(now, before) {
        new if new.is_empty() => Warnings::Solved(only_in(before, now)),
        new => Warnings::New(new),
    }
}

/// Returns a text with a capital first letter.
fn sentence(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or_else(String::new, |first| first.to_uppercase().chain(letters).collect())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use tandem_telemetry::ContactMetrics;

    use super::*;

    fn worker(id: u64, name: &str, state: WorkerState) -> WorkerView {
        let name = name.to_owned();
        WorkerView { id, name, state, slot: None, n_episodes: 0, last_seen_s: 0.0 }
    }

    /// Returns the texts of the events that `change` causes.
    fn events_of(
        log: &mut EventLog,
        view: &mut RunView,
        change: impl FnOnce(&mut RunView),
    ) -> String {
        let n_before = log.events().len();
        change(view);
        log.update(view);
        let texts = log.events().iter().skip(n_before).map(|event| event.text.as_str());
        texts.collect::<Vec<_>>().join(" | ")
    }

    #[test]
    fn a_killed_worker_is_reported_and_so_is_its_return() {
        let (mut log, mut view) = (EventLog::default(), RunView::default());
        let mut check = |workers: Vec<WorkerView>, expected: &str| {
            let texts = events_of(&mut log, &mut view, |view| view.workers = workers);
            assert_eq!(texts, expected);
        };
        check(vec![], "The learner started");
        let other = worker(2, "b", WorkerState::Waiting);
        check(vec![worker(1, "a", WorkerState::Playing), other.clone()], "a joined | b joined");
        check(vec![worker(1, "a", WorkerState::Waiting), other.clone()], "");
        check(
            vec![worker(1, "a", WorkerState::Disconnected), other.clone()],
            "a disconnected; its slot goes to another worker",
        );
        check(vec![other.clone(), worker(3, "a", WorkerState::Playing)], "a restarted");
        check(
            vec![other.clone(), worker(3, "a", WorkerState::Silent)],
            "a stopped calling; its slot goes to another worker",
        );
        check(vec![other.clone(), worker(3, "a", WorkerState::Waiting)], "a returned");
        let many = (10..20).map(|id| worker(id, &format!("w{id}"), WorkerState::Waiting));
        check(many.chain([other]).collect(), "10 workers joined");
    }

    #[test]
    fn the_first_snapshot_tells_what_happened_since_the_start() {
        let row = |round| MetricsRow { round, success: 0.5, ..MetricsRow::default() };
        let workers = vec![worker(1, "a", WorkerState::Playing)];
        let evaluations = Arc::new([row(0), row(4), row(6)]);
        let mut view = RunView { round: 6, workers, evaluations, ..RunView::default() };
        let check = |view: &RunView, expected: &str| {
            let (mut log, mut view) = (EventLog::default(), view.clone());
            assert_eq!(events_of(&mut log, &mut view, |_| ()), expected);
            assert_eq!(events_of(&mut log, &mut view, |_| ()), "");
        };
        let evaluation = |round: u64| format!("Evaluation in round {round}: success 50.0 %");
        let all = [0, 4, 6].map(evaluation).join(" | ");
        check(&view, &format!("The learner started | a joined | {all}"));
        view.resumed_from_round = 4;
        let last = evaluation(6);
        check(&view, &format!("The learner continues from round 4 | a joined | {last}"));
    }

    #[test]
    fn evaluations_warnings_and_the_end_are_reported_once() {
        let (mut log, mut view) = (EventLog::default(), RunView::default());
        log.update(&view);
        let row = MetricsRow { round: 4, success: 0.5, best: true, ..MetricsRow::default() };
        let texts = events_of(&mut log, &mut view, |view| view.evaluations = Arc::new([row]));
        assert_eq!(texts, "Evaluation in round 4: success 50.0 %, the best so far");
        let contacts =
            ContactMetrics { success_without_contact: Some(0.25), ..ContactMetrics::default() };
        let mut row = MetricsRow { success: 0.5, contacts, ..MetricsRow::default() };
        assert_eq!(evaluation(&row), "Evaluation in round 0: success 50.0 %", "of one arm");
        row.success_per_arm = vec![0.8125, 0.5];
        row.success = 0.8125;
        let of_two = "Evaluation in round 0: success 81.3 %, 25.0 % without contact";
        assert_eq!(evaluation(&row), of_two);
        let texts = events_of(&mut log, &mut view, |view| "no disk".clone_into(&mut view.warning));
        assert_eq!(texts, "No disk");
        assert_eq!(events_of(&mut log, &mut view, |_| ()), "");
        let mut warn = |warning: &str| {
            events_of(&mut log, &mut view, |view| warning.clone_into(&mut view.warning))
        };
        assert_eq!(warn("no disk; no teacher"), "No teacher");
        assert_eq!(warn("no teacher"), "Solved: no disk");
        assert_eq!(warn("no answer"), "No answer");
        assert_eq!(warn(""), "Solved: no answer");
        let texts = events_of(&mut log, &mut view, |view| {
            let reason = "done".to_owned();
            view.end = Some(EndView { reason, interrupted: false, digest: None });
        });
        assert_eq!(texts, "The run has ended: done");
    }

    #[test]
    fn an_error_is_not_reported_like_a_stop() {
        let check = |digest: Option<&str>, expected: Level| {
            let (mut log, mut view) = (EventLog::default(), RunView::default());
            log.update(&view);
            let digest = digest.map(str::to_owned);
            view.end = Some(EndView { reason: "it".to_owned(), interrupted: true, digest });
            log.update(&view);
            assert_eq!(log.events().back().expect("events").level, expected);
        };
        check(Some("00"), Level::Warning);
        check(None, Level::Bad);
    }

    #[test]
    fn the_log_keeps_the_latest_events() {
        let (mut log, mut view) = (EventLog::default(), RunView::default());
        for idx in 0..2 * KEPT {
            view.warning = format!("w{idx}");
            log.update(&view);
        }
        assert_eq!(log.events().len(), KEPT + 1, "and the start");
        assert_eq!(log.events().back().expect("events").text, format!("W{}", 2 * KEPT - 1));
        let row = |round| MetricsRow { round, ..MetricsRow::default() };
        view.evaluations = (0..2 * KEPT as u64).map(row).collect();
        log.update(&view);
        let n_problems = log.events().iter().filter(|it| it.level != Level::Info).count();
        assert_eq!((n_problems, log.events().len()), (KEPT, 2 * KEPT));
    }
}
