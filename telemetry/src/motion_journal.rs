//! The logs of all motions of a bridge, and of stops without a motion, in one directory.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::arms_view::{ArmsView, StopView};
use crate::error::Error;
use crate::log_budget::LogBudget;
use crate::motion_log::{MotionOutcome, MotionRecorder};

/// Time before a motion or a stop that its log contains, seconds.
const LEAD_S: f64 = 1.0;
/// Shortest and longest time after a motion that its log contains, seconds. In between, it ends when the arms rest.
const TAIL_S: [f64; 2] = [0.5, 5.0];
/// Longest log, seconds. A longer motion continues in the next one.
const MAX_LOG_S: f64 = 600.0;
/// Time after a failure before the next attempt to write a log, seconds.
const RETRY_S: f64 = 10.0;
/// Largest number of states that are kept for the start of a log.
const MAX_RECENT: usize = 1024;

/// Writes a log for each motion, and for each fault that stops arms without a motion.
///
/// Logs are named `motion-DATE-NUMBER.mcap` and `stop-DATE-NUMBER.mcap`, with the date and time in UTC and a number
/// that counts the logs of this journal. If a log cannot be written, the journal logs one warning, leaves the
/// incomplete file and tries again after ten seconds, also in the middle of a motion.
pub struct MotionJournal {
    directory: PathBuf,
    budget: LogBudget,
    /// Metadata of all logs: the bridge, its arms and their limits.
    bridge: BTreeMap<String, String>,
    recent: VecDeque<Arc<ArmsView>>,
    open: Option<OpenLog>,
    n_logs: u64,
    /// The stop in the latest state.
    stop: Option<StopView>,
    /// Time of the latest state, on the clock of the bridge, seconds.
    now_s: f64,
    /// The latest log could not be written, at this time.
    failed_s: Option<f64>,
}

/// A log that is being written.
struct OpenLog {
    recorder: MotionRecorder,
    /// The motion that is logged; `None` for a stop without a motion.
    motion: Option<u64>,
    /// The outcome, and the time at which it was reached.
    outcome: Option<(MotionOutcome, f64)>,
}

impl MotionJournal {
    /// Creates `directory` unless it exists, and keeps its logs below `budget_bytes` from now on. `bridge` is metadata
    /// of every log.
    ///
    /// # Errors
    /// If the directory cannot be created, read or written to, or old logs cannot be deleted.
    pub fn create(
        directory: &Path,
        budget_bytes: u64,
        bridge: BTreeMap<String, String>,
    ) -> Result<Self, Error> {
        tandem_system::atomic_file::create_directory(directory)
            .map_err(Error::io("create", directory))?;
        // A directory that takes no files is an error now, not with the first motion.
        let probe = directory.join(format!(".writable-{}", std::process::id()));
        let written = std::fs::File::create(&probe).and_then(|_| std::fs::remove_file(&probe));
        written.map_err(Error::io("write to", directory))?;
        let mut budget = LogBudget::new(directory.to_owned(), budget_bytes);
        budget.enforce_but_newest()?;
        Ok(Self {
            directory: directory.to_owned(),
            budget,
            bridge,
            recent: VecDeque::new(),
            open: None,
            n_logs: 0,
            stop: None,
            now_s: 0.0,
            failed_s: None,
        })
    }

    /// Records a state. Times must not decrease. Failures are only logged.
    pub fn record(&mut self, view: &Arc<ArmsView>) {
        self.now_s = view.time_s;
        let is_fault = self.is_new_fault(view);
        self.stop.clone_from(&view.stop);
        // A fault after the end of a motion, or after another stop, is not its outcome.
        let is_over = |log: &OpenLog| (is_fault && log.outcome.is_some()) || log.is_over(view);
        if self.open.as_ref().is_some_and(is_over) {
            self.close();
        }
        if self.open.is_none() && (view.motion.is_some() || is_fault) {
            self.begin(view);
        } else if let Some(log) = &mut self.open {
            let written = log.record(view);
            self.check(written);
        }
        self.recent.push_back(Arc::clone(view));
        let is_old = |oldest: &Arc<ArmsView>| view.time_s - oldest.time_s > LEAD_S;
        while self.recent.len() > MAX_RECENT || self.recent.front().is_some_and(is_old) {
            self.recent.pop_front();
        }
    }

    /// Completes the log that is being written.
    pub fn finish(mut self) {
        self.close();
    }

    /// Returns true if the arms have just been stopped by a fault.
    fn is_new_fault(&self, view: &ArmsView) -> bool {
        view.stop.as_ref().is_some_and(|stop| !stop.is_expected() && view.stop != self.stop)
    }

    /// Starts a log with the states of the last second.
    fn begin(&mut self, view: &Arc<ArmsView>) {
        if self.failed_s.is_some_and(|failed_s| view.time_s - failed_s < RETRY_S) {
            return;
        }
        self.n_logs += 1;
        let kind = if view.motion.is_some() { "motion" } else { "stop" };
        let name = format!("{kind}-{}-{:06}.mcap", utc_digits(view.unix_ms), self.n_logs);
        let log =
            OpenLog::begin(&self.directory.join(name), &self.metadata(view), view, &self.recent);
        match log {
            Ok(log) => self.open = Some(log),
            Err(error) => self.check(Err(error)),
        }
    }

    fn metadata(&self, view: &ArmsView) -> BTreeMap<String, String> {
        let mut metadata = self.bridge.clone();
        let mut add = |key: &str, value: String| drop(metadata.insert(key.to_owned(), value));
        add("unix_ms", view.unix_ms.to_string());
        add("bridge_time_s", view.time_s.to_string());
        if let Some(motion) = &view.motion {
            add("motion", view.n_motions.to_string());
            add("name", motion.name.clone());
            add("client", motion.client.clone());
            add("speed", motion.speed.to_string());
            add("duration_s", motion.duration_s.to_string());
        }
        metadata
    }

    fn close(&mut self) {
        let Some(log) = self.open.take() else { return };
        let outcome = log.outcome.map_or(MotionOutcome::Unfinished, |(outcome, _)| outcome);
        let finished = log.recorder.finish(&outcome).and_then(|path| {
            let n_bytes = std::fs::metadata(&path).map_or(0, |metadata| metadata.len());
            tracing::info!(?path, n_bytes, "motion recorded");
            self.budget.add(&path, n_bytes)
        });
        let is_good = finished.is_ok();
        self.check(finished.map(drop));
        if is_good && self.failed_s.take().is_some() {
            tracing::info!("recording resumed");
        }
    }

    /// Pauses recording after a failure. Repeated failures are not logged again.
    fn check(&mut self, written: Result<(), Error>) {
        if let Err(error) = written {
            self.open = None;
            let error: &dyn std::error::Error = &error;
            if self.failed_s.replace(self.now_s).is_none() {
                let directory = &self.directory;
                tracing::warn!(?directory, error, "recording paused: the arms are not affected");
            }
        }
    }
}

impl OpenLog {
    fn begin(
        path: &Path,
        metadata: &BTreeMap<String, String>,
        view: &ArmsView,
        recent: &VecDeque<Arc<ArmsView>>,
    ) -> Result<Self, Error> {
        let first = recent.front().map_or(view, |oldest| &**oldest);
        let mut recorder = MotionRecorder::create(path, metadata, first)?;
        for view in recent.iter().skip(1) {
            recorder.record(view)?;
        }
        let motion = view.motion.is_some().then_some(view.n_motions);
        let mut log = Self { recorder, motion, outcome: None };
        log.record(view)?;
        Ok(log)
    }

    fn record(&mut self, view: &ArmsView) -> Result<(), Error> {
        if self.outcome.is_none() && (self.motion.is_none() || view.motion.is_none()) {
            let outcome = view.stop.clone().map_or(MotionOutcome::Done, MotionOutcome::Stopped);
            self.outcome = Some((outcome, view.time_s));
        }
        self.recorder.record(view)
    }

    /// Returns true if `view` does not belong to the log.
    fn is_over(&self, view: &ArmsView) -> bool {
        let is_other = view.motion.is_some()
            && (self.motion != Some(view.n_motions) || self.outcome.is_some());
        let is_past = self.outcome.as_ref().is_some_and(|(_, ended_s)| {
            let since_s = view.time_s - ended_s;
            since_s > TAIL_S[1] || (since_s > TAIL_S[0] && view.at_rest)
        });
        is_other || is_past || self.recorder.duration_s() > MAX_LOG_S
    }
}

/// Returns date and time in UTC as digits: year, month, day, hours, minutes and seconds.
fn utc_digits(unix_ms: u64) -> String {
    let seconds = unix_ms / 1000;
    let (days, of_day) = (seconds / 86_400, seconds % 86_400);
    // Howard Hinnant, chrono-compatible low-level date algorithms: years begin in March.
    let shifted = days + 719_468;
    let (era, of_era) = (shifted / 146_097, shifted % 146_097);
    let year = (of_era - of_era / 1460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year + year / 4 - year / 100);
    let month = (5 * of_year + 2) / 153;
    let day = of_year - (153 * month + 2) / 5 + 1;
    let month = if month < 10 { month + 3 } else { month - 9 };
    let year = year + era * 400 + u64::from(month <= 2);
    let (hours, minutes, seconds) = (of_day / 3600, of_day / 60 % 60, of_day % 60);
    format!("{year:04}{month:02}{day:02}{hours:02}{minutes:02}{seconds:02}")
}
