//! The site of a sweep: turns snapshots of its runs into the documents that its page shows.

use std::collections::VecDeque;
use std::sync::Arc;

use serde::Serialize;
use tandem_telemetry::MetricsRow;
use tokio::sync::watch;

use crate::document::encode;
use crate::events::{Event, Level, Warnings, percent, warnings};
use crate::page;
use crate::site::{Frame, Site};

/// Number of events that are kept.
const KEPT_EVENTS: usize = 60;

/// A snapshot of a sweep.
#[derive(Debug, Clone, Default)]
pub struct SweepView {
    /// Name of the sweep.
    pub name: String,
    /// Parent of the run directories.
    pub directory: String,
    /// Number of concurrent runs.
    pub n_jobs: usize,
    /// Seconds since this start of the sweep.
    pub wall_s: f64,
    /// The end of the sweep, or an empty text.
    pub end: String,
    /// All runs, in the order in which they are started.
    pub runs: Vec<SweepRunView>,
}

/// The state of a run of a sweep.
#[derive(Debug, Clone, Default, Serialize)]
pub struct SweepRunView {
    /// Name of the run and of its directory.
    pub name: String,
    /// Name of the task.
    pub task: String,
    /// The properties that the run shares with those of other seeds: its strategy and varied settings.
    pub group: String,
    /// Seed of the run.
    pub seed: u64,
    /// The state: waiting, running or ended.
    pub state: SweepRunState,
    /// The reason why the latest attempt failed or the run was left out, or an empty text.
    pub failure: String,
    /// Success of its best policy on test goals, once it is finished.
    pub result: Option<SweepResult>,
    /// Environment steps that end the run; 0 if they do not.
    pub max_env_steps: u64,
    /// Address of the run's own dashboard, or an empty text.
    pub dashboard: String,
    /// Environment steps of training.
    #[serde(skip)]
    pub env_steps: u64,
    /// The values that change many times a second while it runs.
    #[serde(skip)]
    pub pace: RunPace,
    /// The evaluations, oldest first.
    #[serde(skip)]
    pub evaluations: Arc<[MetricsRow]>,
}

/// The pace of a running run. Values are those of its latest message.
#[derive(Debug, Clone, Default, Serialize)]
pub struct RunPace {
    /// Recent environment steps per second.
    pub env_steps_per_s: f64,
    /// Recent updates per second.
    pub updates_per_s: f64,
    /// Seconds left, if the run has an end and progresses.
    pub remaining_s: Option<f64>,
    /// Units of advice that the run has spent.
    pub advice_spent: u64,
    /// Success of the latest round's episodes.
    pub training_success: f64,
    /// A problem of the run, or an empty text.
    pub warning: String,
}

/// The progress of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum SweepRunState {
    /// The run has not been started, or will be resumed.
    #[default]
    Waiting,
    /// The run trains.
    Running,
    /// The run is complete.
    Finished,
    /// The latest attempt failed.
    Failed,
    /// The run was interrupted and is saved.
    Saved,
    /// The sweep did not train the run, which another process uses.
    #[serde(rename = "left out")]
    LeftOut,
}

/// Success on test goals, with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct SweepResult {
    /// Success rate.
    pub success: f64,
    /// Lower bound.
    pub low: f64,
    /// Upper bound.
    pub high: f64,
}

impl Site {
    /// Returns the site of a sweep. It encodes each snapshot of `views` once, in a task of the runtime that calls it,
    /// until the sender is dropped.
    ///
    /// # Panics
    /// If it is called outside a tokio runtime.
    #[must_use]
    pub fn of_sweep(views: watch::Receiver<SweepView>) -> Self {
        let mut feed = Feed::default();
        Self::of_views(page::sweep(), views, move |view| feed.frame(view))
    }
}

/// The state as pages receive it.
#[derive(Serialize)]
struct State<'a> {
    name: &'a str,
    directory: &'a str,
    n_jobs: usize,
    n_runs: usize,
    wall_s: f64,
    end: &'a str,
    /// Environment steps of all runs.
    env_steps: u64,
    /// Environment steps at the end of all runs: those that end a run or, once it is finished, those that it made; 0 if
    /// some run has no such limit.
    max_env_steps: u64,
    env_steps_per_s: f64,
    live: Vec<Live<'a>>,
    versions: Versions,
}

/// The values of a run that change many times a second.
#[derive(Serialize)]
struct Live<'a> {
    /// Its index in the document `runs`.
    run: usize,
    env_steps: u64,
    #[serde(flatten)]
    pace: &'a RunPace,
}

/// Counts the changes of each document.
#[derive(Debug, Clone, Copy, Default, Serialize)]
struct Versions {
    runs: u64,
    curves: u64,
    log: u64,
}

/// A run in the document `runs`.
#[derive(Serialize)]
struct Listed<'a> {
    #[serde(flatten)]
    run: &'a SweepRunView,
    env_steps: u64,
    advice_spent: u64,
}

/// An evaluation in the document `curves`.
#[derive(Serialize)]
struct Point {
    env_steps: u64,
    success: f64,
    success_without_contact: Option<f64>,
}

/// Documents of the latest snapshot.
#[derive(Default)]
struct Feed {
    versions: Versions,
    latest: Option<SweepView>,
    runs: Arc<str>,
    curves: Arc<str>,
    events: VecDeque<Event>,
    log: Arc<str>,
}

impl Feed {
    /// Encodes a snapshot; documents that have not changed are taken from the previous one.
    fn frame(&mut self, view: &SweepView) -> Frame {
        let former = self.latest.take();
        let n_former = former.as_ref().map_or(0, |it| it.runs.len());
        let pairs = || former.iter().flat_map(|it| &it.runs).zip(&view.runs);
        let has_other_runs = former.is_none() || n_former != view.runs.len();
        let has_curves =
            |(a, b): (&SweepRunView, &SweepRunView)| !Arc::ptr_eq(&a.evaluations, &b.evaluations);
        let is_listed_anew = |(a, b): (&SweepRunView, &SweepRunView)| {
            (a.state, &a.failure, &a.dashboard) != (b.state, &b.failure, &b.dashboard)
        };
        if has_other_runs || pairs().any(is_listed_anew) {
            self.versions.runs += 1;
            self.runs = encode(&view.runs.iter().map(listed).collect::<Vec<_>>());
        }
        if has_other_runs || pairs().any(has_curves) {
            self.versions.curves += 1;
            self.curves = encode(&view.runs.iter().map(curve).collect::<Vec<_>>());
        }
        let news = news(former.as_ref(), view);
        if !news.is_empty() || former.is_none() {
            self.versions.log += 1;
            let news = news.into_iter();
            self.events.extend(news.map(|(level, text)| Event { at_s: view.wall_s, level, text }));
            let n_surplus = self.events.len().saturating_sub(KEPT_EVENTS);
            self.events.drain(..n_surplus);
            self.log = encode(&self.events);
        }
        self.latest = Some(view.clone());
        let documents = [
            ("runs", self.runs.clone().into()),
            ("curves", self.curves.clone().into()),
            ("log", self.log.clone().into()),
        ];
        Frame { state: self.state(view), documents: documents.into_iter().collect() }
    }

    fn state(&self, view: &SweepView) -> Arc<str> {
        let running = view.runs.iter().enumerate();
        let running = running.filter(|(_, run)| run.state == SweepRunState::Running);
        let live: Vec<Live<'_>> = running
            .map(|(idx, run)| Live { run: idx, env_steps: run.env_steps, pace: &run.pace })
            .collect();
        let is_limited = view.runs.iter().all(|run| run.max_env_steps > 0);
        encode(&State {
            name: &view.name,
            directory: &view.directory,
            n_jobs: view.n_jobs,
            n_runs: view.runs.len(),
            wall_s: view.wall_s,
            end: &view.end,
            env_steps: view.runs.iter().map(|run| run.env_steps).sum(),
            max_env_steps: match is_limited {
                true => view.runs.iter().map(env_steps_at_end).sum(),
                false => 0,
            },
            // The sum of no numbers is −0, which readers would see.
            env_steps_per_s: live
                .iter()
                .map(|run| run.pace.env_steps_per_s)
                .fold(0.0, |sum, it| sum + it),
            live,
            versions: self.versions,
        })
    }
}

/// Returns the environment steps of a run at its end. A finished run may have ended before its limit.
fn env_steps_at_end(run: &SweepRunView) -> u64 {
    match run.state {
        SweepRunState::Finished => run.env_steps,
        _ => run.max_env_steps,
    }
}

fn listed(run: &SweepRunView) -> Listed<'_> {
    let from_rows = run.evaluations.last().map_or(0, |row| row.advice_spent);
    let advice_spent = run.pace.advice_spent.max(from_rows);
    Listed { run, env_steps: run.env_steps, advice_spent }
}

fn curve(run: &SweepRunView) -> Vec<Point> {
    let point = |row: &MetricsRow| Point {
        env_steps: row.env_steps,
        success: row.success,
        success_without_contact: row.contacts.success_without_contact,
    };
    run.evaluations.iter().map(point).collect()
}

/// Returns what happened between two snapshots.
fn news(former: Option<&SweepView>, view: &SweepView) -> Vec<(Level, String)> {
    let Some(former) = former else {
        return vec![(Level::Info, "The sweep started".to_owned())];
    };
    let mut news = Vec::new();
    for (before, now) in former.runs.iter().zip(&view.runs) {
        if before.state != now.state {
            news.extend(change(now));
        }
        let name = &now.name;
        match warnings(&before.pace.warning, &now.pace.warning) {
            Warnings::New(texts) => news
                .extend(texts.into_iter().map(|text| (Level::Warning, format!("{name}: {text}")))),
            // The warnings of a run that has ended are gone, but not solved.
            Warnings::Solved(texts) if now.state == SweepRunState::Running => news.extend(
                texts.into_iter().map(|text| (Level::Good, format!("{name}: solved: {text}"))),
            ),
            Warnings::Solved(_) => {}
        }
    }
    if former.end != view.end && !view.end.is_empty() {
        let has_any = |state| view.runs.iter().any(|run| run.state == state);
        let level = match (has_any(SweepRunState::Failed), has_any(SweepRunState::LeftOut)) {
            (true, _) => Level::Bad,
            (false, true) => Level::Warning,
            (false, false) => Level::Info,
        };
        news.push((level, format!("The sweep has ended: {}", view.end)));
    }
    news
}

/// Describes the state that a run has just entered.
fn change(run: &SweepRunView) -> Option<(Level, String)> {
    let name = &run.name;
    Some(match run.state {
        SweepRunState::Waiting => return None,
        SweepRunState::Running if run.env_steps > 0 => (Level::Info, format!("{name} is resumed")),
        SweepRunState::Running => (Level::Info, format!("{name} started")),
        SweepRunState::Finished => {
            let result = run.result.unwrap_or_default();
            let success = percent(result.success);
            (Level::Good, format!("{name} is finished: success {success} on test goals"))
        }
        SweepRunState::Failed => (Level::Bad, format!("{name} failed: {}", run.failure)),
        SweepRunState::Saved => (Level::Warning, format!("{name} is saved")),
        SweepRunState::LeftOut => (Level::Warning, format!("{name} is left out: {}", run.failure)),
    })
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::*;

    fn json(text: &str) -> Value {
        serde_json::from_str(text).expect("JSON")
    }

    fn run(name: &str, state: SweepRunState) -> SweepRunView {
        SweepRunView { name: name.to_owned(), state, max_env_steps: 1000, ..Default::default() }
    }

    #[test]
    fn the_state_sums_all_runs_and_lists_running_ones() {
        let mut running = run("b", SweepRunState::Running);
        running.env_steps = 400;
        running.pace.env_steps_per_s = 50.0;
        let finished = SweepRunView { env_steps: 1000, ..run("a", SweepRunState::Finished) };
        let view = SweepView { runs: vec![finished, running], ..SweepView::default() };
        let frame = Feed::default().frame(&view);
        let state = json(&frame.state);
        assert_eq!((&state["env_steps"], &state["max_env_steps"]), (&1400.into(), &2000.into()));
        assert_eq!(state["env_steps_per_s"], 50.0);
        assert_eq!(state["live"].as_array().map(Vec::len), Some(1));
        assert_eq!(
            (&state["live"][0]["run"], &state["live"][0]["env_steps"]),
            (&1.into(), &400.into())
        );
        assert_eq!(json(frame.documents["runs"].text())[0]["state"], "finished");
    }

    #[test]
    fn a_sweep_without_a_running_run_makes_no_steps_per_second() {
        let view =
            SweepView { runs: vec![run("a", SweepRunState::Failed)], ..SweepView::default() };
        let state = Feed::default().state(&view);
        assert!(state.contains("\"env_steps_per_s\":0.0"), "{state}");
    }

    #[test]
    fn a_finished_run_counts_the_steps_that_it_made() {
        let early = SweepRunView { env_steps: 320, ..run("a", SweepRunState::Finished) };
        let check = |other: SweepRunView, expected: (u64, u64)| {
            let view = SweepView { runs: vec![early.clone(), other], ..SweepView::default() };
            let state = json(&Feed::default().state(&view));
            let (done, all) = (&state["env_steps"], &state["max_env_steps"]);
            assert_eq!((done, all), (&expected.0.into(), &expected.1.into()));
        };
        check(early.clone(), (640, 640));
        for state in [
            SweepRunState::Waiting,
            SweepRunState::Running,
            SweepRunState::Failed,
            SweepRunState::Saved,
            SweepRunState::LeftOut,
        ] {
            check(SweepRunView { env_steps: 500, ..run("b", state) }, (820, 1320));
        }
        let unlimited = SweepRunView { max_env_steps: 0, ..run("b", SweepRunState::Running) };
        check(unlimited, (320, 0));
    }

    #[test]
    fn documents_change_only_with_what_they_contain() {
        let mut feed = Feed::default();
        let mut view =
            SweepView { runs: vec![run("a", SweepRunState::Running)], ..SweepView::default() };
        let versions = |frame: &Frame| json(&frame.state)["versions"].clone();
        let first = versions(&feed.frame(&view));
        view.runs[0].env_steps = 100;
        assert_eq!(versions(&feed.frame(&view)), first, "only the state has changed");
        view.runs[0].evaluations = Arc::new([MetricsRow { success: 0.5, ..MetricsRow::default() }]);
        let frame = feed.frame(&view);
        let second = versions(&frame);
        assert_eq!((&second["runs"], &second["log"]), (&first["runs"], &first["log"]));
        assert_ne!(second["curves"], first["curves"]);
        assert_eq!(json(frame.documents["curves"].text())[0][0]["success"], 0.5);
        view.runs[0].state = SweepRunState::Failed;
        "no disk".clone_into(&mut view.runs[0].failure);
        let frame = feed.frame(&view);
        assert_ne!(versions(&frame)["runs"], first["runs"]);
        let log = json(frame.documents["log"].text());
        assert_eq!(
            log.as_array().and_then(|log| log.last()).map(|it| &it["text"]),
            Some(&"a failed: no disk".into())
        );
        view.runs[0].state = SweepRunState::LeftOut;
        "in use".clone_into(&mut view.runs[0].failure);
        let frame = feed.frame(&view);
        assert_eq!(json(frame.documents["runs"].text())[0]["state"], "left out");
        let log = json(frame.documents["log"].text());
        let last = log.as_array().and_then(|log| log.last()).expect("an event");
        assert_eq!(
            (&last["level"], &last["text"]),
            (&"warning".into(), &"a is left out: in use".into())
        );
    }
}
