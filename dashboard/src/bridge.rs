//! The site of a bridge: turns states of the arms into the documents that its page shows, and stops them.

use std::collections::VecDeque;
use std::sync::Arc;

use serde::Serialize;
use tandem_core::scene::{ArmScene, Point, Scene};
use tandem_telemetry::{ArmsEvents, ArmsView, LogLevel, StopView};
use tokio::sync::watch;

use crate::document::encode;
use crate::events::{Level, forget_old};
use crate::page;
use crate::site::{Frame, Site, StopAction};

/// The values that do not change while a bridge runs.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct BridgeTerms {
    /// Name of the driver.
    pub driver: String,
    /// Version of the program.
    pub version: String,
    /// Height of the table in the world frame, metres.
    pub table_z_m: f64,
    /// Largest share of a motion's own speed, in (0, 1].
    pub speed: f64,
    /// Gap to the table below which the arms are stopped, metres.
    pub table_gap_m: f64,
    /// Gap between the arms below which they are stopped, metres.
    pub arms_gap_m: f64,
    /// Gap between parts of one arm below which it is stopped, metres.
    pub self_gap_m: f64,
}

impl Site {
    /// Returns the site of a bridge, whose button calls `stop`. It encodes each state of `views` once, in a task of the
    /// runtime that calls it, until the sender is dropped.
    ///
    /// # Panics
    /// If it is called outside a tokio runtime.
    #[must_use]
    pub fn of_bridge(
        terms: BridgeTerms,
        views: watch::Receiver<Arc<ArmsView>>,
        stop: StopAction,
    ) -> Self {
        let mut feed = Feed { terms, ..Feed::default() };
        let site = Self::of_views(page::bridge(), views, move |view| feed.frame(view));
        Self { stop: Some(stop), ..site }
    }
}

/// The state as pages receive it.
#[derive(Serialize)]
struct State<'a> {
    #[serde(flatten)]
    view: &'a ArmsView,
    terms: &'a BridgeTerms,
    /// The latest stop, also after a reset.
    last_stop: Option<&'a LastStop>,
    shapes: Vec<Shape>,
    versions: Versions,
}

/// Counts the changes of each document.
#[derive(Debug, Clone, Copy, Default, Serialize)]
struct Versions {
    log: u64,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
struct LastStop {
    #[serde(flatten)]
    stop: StopView,
    /// When the page's server saw it, milliseconds since 1970.
    at_unix_ms: u64,
}

/// The shape of an arm: metres, in the world frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Shape {
    base: Point,
    tool: Point,
    /// Ends and radius of each link.
    links: Vec<(Point, Point, f32)>,
    /// Centres of the fingers.
    fingers: Vec<Point>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
struct Event {
    unix_ms: u64,
    level: Level,
    text: String,
}

/// Documents of the latest state.
#[derive(Default)]
struct Feed {
    terms: BridgeTerms,
    events: ArmsEvents,
    kept: VecDeque<Event>,
    last_stop: Option<LastStop>,
    n_updates: u64,
    log: Option<Arc<str>>,
}

impl Feed {
    fn frame(&mut self, view: &ArmsView) -> Frame {
        let is_new = |stop: &&StopView| self.last_stop.as_ref().is_none_or(|it| it.stop != **stop);
        if let Some(stop) = view.stop.as_ref().filter(is_new) {
            self.last_stop = Some(LastStop { stop: stop.clone(), at_unix_ms: view.unix_ms });
        }
        let new = self.events.update(view);
        if !new.is_empty() || self.log.is_none() {
            self.kept.extend(new.into_iter().map(|(level, text)| Event {
                unix_ms: view.unix_ms,
                level: level_of(level, &text),
                text,
            }));
            forget_old(&mut self.kept, |it| matches!(it.level, Level::Info | Level::Good));
            self.n_updates += 1;
            self.log = Some(encode(&self.kept));
        }
        let state = State {
            view,
            terms: &self.terms,
            last_stop: self.last_stop.as_ref(),
            shapes: view.scene.as_ref().map(shapes).unwrap_or_default(),
            versions: Versions { log: self.n_updates },
        };
        let documents = self.log.clone().map(|log| ("log", log.into()));
        Frame { state: encode(&state), documents: documents.into_iter().collect() }
    }
}

/// Returns the level of an event's line: completed motions are good news.
fn level_of(level: LogLevel, text: &str) -> Level {
    match level {
        LogLevel::Info if text.ends_with("done") => Level::Good,
        LogLevel::Info => Level::Info,
        LogLevel::Warning => Level::Warning,
        LogLevel::Error => Level::Bad,
    }
}

fn shapes(scene: &Scene) -> Vec<Shape> {
    let shape = |arm: &ArmScene| Shape {
        base: rounded(arm.base),
        tool: rounded(arm.end_effector),
        links: arm
            .links
            .iter()
            .map(|link| (rounded(link.from), rounded(link.to), link.radius_m))
            .collect(),
        fingers: arm.hand.iter().skip(1).map(|finger| rounded(finger.centre)).collect(),
    };
    scene.arms.iter().map(shape).collect()
}

fn rounded(point: Point) -> Point {
    point.map(|length_m| (length_m * 1e4).round() / 1e4)
}

#[cfg(test)]
mod tests {
    use serde_json::Value;
    use tandem_telemetry::ArmsPhase;

    use super::*;
    use crate::events::KEPT;

    #[test]
    fn motions_displace_no_stop() {
        let mut feed = Feed::default();
        let stop = StopView {
            name: "tracking".to_owned(),
            sentence: "at 3.000 s arm 0 joint 1: 2.86 degrees from the motion's reference"
                .to_owned(),
            time_s: 3.0,
        };
        let mut view = ArmsView { stop: Some(stop), is_connected: true, ..ArmsView::default() };
        feed.frame(&view);
        (view.stop, view.phase) = (None, ArmsPhase::Idle);
        for n_motions in 1..=KEPT as u64 {
            (view.n_motions, view.phase) = (n_motions, ArmsPhase::Moving);
            feed.frame(&view);
            view.phase = ArmsPhase::Idle;
            feed.frame(&view);
        }
        let n_stops = feed.kept.iter().filter(|it| it.text.starts_with("stopped: ")).count();
        assert_eq!((n_stops, feed.kept.len()), (1, KEPT + 1));
    }

    #[test]
    fn the_last_stop_stays_after_a_reset_and_events_are_kept() {
        let mut feed = Feed::default();
        let state = |frame: &Frame| -> Value { serde_json::from_str(&frame.state).expect("JSON") };
        let stop = StopView {
            name: "requested".to_owned(),
            sentence: "at 3.000 s: a client stopped the arms".to_owned(),
            time_s: 3.0,
        };
        let stopped = ArmsView {
            stop: Some(stop),
            unix_ms: 1_000,
            is_connected: true,
            ..ArmsView::default()
        };
        let first = state(&feed.frame(&stopped));
        assert_eq!(
            (&first["phase"], &first["last_stop"]["at_unix_ms"]),
            (&"stopped".into(), &1_000.into())
        );
        let later = ArmsView { unix_ms: 2_000, ..stopped.clone() };
        assert_eq!(state(&feed.frame(&later))["versions"], first["versions"]);
        let reset = ArmsView { stop: None, phase: ArmsPhase::Idle, unix_ms: 3_000, ..stopped };
        let frame = feed.frame(&reset);
        let idle = state(&frame);
        assert_eq!(
            (&idle["stop"], &idle["last_stop"]["at_unix_ms"]),
            (&Value::Null, &1_000.into())
        );
        assert_ne!(idle["versions"], first["versions"]);
        let log: Value = serde_json::from_str(frame.documents["log"].text()).expect("JSON");
        assert_eq!(
            (&log[0]["level"], &log[1]["text"]),
            (&"warning".into(), &"the arms were reset".into())
        );
    }
}
