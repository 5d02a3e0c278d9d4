//! A series of trials: one policy in one mode, in parallel, with a row for each trial and a log where one is wanted.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use tandem_kinematics::Joints;
use tandem_policy::{Actor, Policy};
use tandem_sim::SimError;
use tandem_telemetry::trial_log::{TrialMetadata, TrialOutcome, TrialRecorder, TrialSnapshot};
use tandem_telemetry::{ToolPathPoint, TrialRow};

use crate::trial::{
    Frame, NoObserver, PathPoint, TrialConfig, TrialError, TrialObserver, TrialReport, TrialRunner,
};

/// The largest number of path points in a row.
const PATH_POINTS: usize = 150;

/// A policy and the name under which its trials are reported.
#[derive(Debug, Clone)]
pub struct NamedPolicy {
    /// The name in tables and files.
    pub name: String,
    /// The policy.
    pub policy: Policy,
}

/// The trials of one policy in one mode. A trial depends on its number only, not on the trials before it.
#[derive(Debug)]
pub struct Series<'a> {
    /// The policy under test.
    pub policy: &'a NamedPolicy,
    /// The configuration of every trial.
    pub config: TrialConfig,
}

/// The reasons for which a series ends early.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SeriesError {
    /// The training world cannot be built.
    #[error("there is no training world for these blocks")]
    World(#[from] SimError),
    /// The policy's parameters are unusable.
    #[error(transparent)]
    Policy(#[from] tandem_policy::Error),
    /// A trial cannot be carried out.
    #[error("trial {number}")]
    Trial {
        /// The trial's number.
        number: u64,
        /// The reason.
        source: TrialError,
    },
    /// A trial's log cannot be written.
    #[error(transparent)]
    Log(#[from] tandem_telemetry::Error),
}

impl Series<'_> {
    /// Runs trials `0..n_trials` on all threads of the pool, which begin them in order. Calls `done` after each trial,
    /// on the trial's thread, with the trial's report and its row without a log. Returns the rows by number.
    ///
    /// # Errors
    /// Returns the error of a trial or of `done`; if there are several, that of the first trial. No other trial begins
    /// then. Those that have begun are completed, so `done` has been called for every trial before the first that
    /// failed.
    pub fn run<E: From<SeriesError> + Send>(
        &self,
        n_trials: u64,
        done: impl Fn(&TrialReport, &mut TrialRow) -> Result<(), E> + Sync,
    ) -> Result<Vec<TrialRow>, E> {
        let actor = self.policy.policy.actor().map_err(SeriesError::from)?;
        let trial = |runner: &mut Result<TrialRunner, SimError>, actor: &mut Actor, number| {
            let runner = runner.as_mut().map_err(|error| SeriesError::World(error.clone()))?;
            let report = attempt(runner, actor, number, &mut NoObserver)?;
            let mut row = self.row(&report);
            done(&report, &mut row)?;
            Ok(row)
        };
        let (next, has_failed) = (AtomicU64::new(0), AtomicBool::new(false));
        let outcomes = Mutex::new(BTreeMap::<u64, Result<TrialRow, E>>::new());
        rayon::broadcast(|_thread| {
            let (mut runner, mut actor) = (None, actor.clone());
            while !has_failed.load(Ordering::Relaxed) {
                let number = next.fetch_add(1, Ordering::Relaxed);
                if number >= n_trials {
                    break;
                }
                let runner = runner.get_or_insert_with(|| TrialRunner::new(self.config.clone()));
                let outcome = trial(runner, &mut actor, number);
                if outcome.is_err() {
                    has_failed.store(true, Ordering::Relaxed);
                }
                outcomes.lock().unwrap_or_else(PoisonError::into_inner).insert(number, outcome);
            }
        });
        let outcomes = outcomes.into_inner().unwrap_or_else(PoisonError::into_inner);
        outcomes.into_values().collect()
    }

    /// Repeats the trial of `row`, which takes the same course, and writes it to the MCAP file `path`.
    ///
    /// # Errors
    /// Returns an error if the log cannot be written or the trial cannot be repeated.
    pub fn record(&self, row: &TrialRow, path: &Path) -> Result<(), SeriesError> {
        let recorder = TrialRecorder::create(path, &self.metadata(row.trial))?;
        let mut recording = Recording { recorder, failure: None };
        let mut runner = TrialRunner::new(self.config.clone())?;
        let mut actor = self.policy.policy.actor()?;
        attempt(&mut runner, &mut actor, row.trial, &mut recording)?;
        recording.finish(row)
    }

    fn metadata(&self, number: u64) -> TrialMetadata {
        TrialMetadata {
            policy: self.policy.name.clone(),
            layout: self.config.layout,
            mode: self.config.mode.name().to_owned(),
            trial: number,
            seed: self.config.seed,
            policy_digest: self.policy.policy.digest(),
            driver: "sim".to_owned(),
            speed: self.config.speed,
            block_half_m: (!self.config.layout.task.shares_object())
                .then(|| f64::from(self.config.block.half_m)),
        }
    }

    fn row(&self, report: &TrialReport) -> TrialRow {
        let distances = report.objects.iter().map(|object| object.goal_distance_m());
        let every = report.path.len().div_ceil(PATH_POINTS).max(1);
        TrialRow {
            policy: self.policy.name.clone(),
            mode: self.config.mode.name().to_owned(),
            task: self.config.layout.task.name().to_owned(),
            trial: report.number,
            seed: self.config.seed,
            success: report.cause.is_none(),
            cause: report.cause.as_ref().map(|cause| cause.name().to_owned()),
            detail: report.cause.as_ref().and_then(|cause| cause.detail()),
            goal_distances_m: distances.collect(),
            rehearsed_m: report.rehearsed_m.clone(),
            duration_s: report.duration_s,
            n_steps: report.n_steps as u64,
            n_shortened: report.n_shortened as u64,
            arms_gap_m: report.arms_gap_m.is_finite().then_some(report.arms_gap_m),
            table_gap_m: report.table_gap_m,
            tolerance_m: Some(report.tolerance_m),
            starts: report.positions.iter().map(|object| object.start.to_array()).collect(),
            goals: report.positions.iter().map(|object| object.goal.to_array()).collect(),
            ends: report.positions.iter().map(|object| object.end.to_array()).collect(),
            path: report.path.iter().step_by(every).map(tools_at).collect(),
            log: None,
        }
    }
}

fn attempt(
    runner: &mut TrialRunner,
    actor: &mut Actor,
    number: u64,
    observer: &mut dyn TrialObserver,
) -> Result<TrialReport, SeriesError> {
    let mut act = |observation: &[f32], goal: &[f32], action: &mut [f32]| {
        actor.act(observation, goal, action);
    };
    let report = runner.run(number, &mut act, observer);
    report.map_err(|source| SeriesError::Trial { number, source })
}

/// Writes a trial to a log while it runs.
struct Recording {
    recorder: TrialRecorder,
    /// The first write that failed; nothing is written after it.
    failure: Option<tandem_telemetry::Error>,
}

impl TrialObserver for Recording {
    fn on_frame(&mut self, frame: &Frame<'_>) {
        if self.failure.is_some() {
            return;
        }
        let joints = |angles: &Joints| angles.iter().copied().collect::<Vec<f64>>();
        let planned: Option<Vec<Vec<f64>>> =
            frame.planned.map(|planned| planned.iter().map(joints).collect());
        let arms = frame.measured.map(|state| state.arms.as_slice()).unwrap_or_default();
        let measured: Vec<Vec<f64>> = arms.iter().map(|arm| joints(&arm.angles)).collect();
        let openings: Vec<f64> = arms.iter().map(|arm| arm.opening).collect();
        let [planned_tools, measured_tools] =
            [&frame.tools.planned, &frame.tools.measured].map(|tools| points(tools));
        let written = self.recorder.record(&TrialSnapshot {
            time_s: frame.time_s,
            scene: &frame.scene,
            planned_joints: planned.as_deref(),
            measured_joints: &measured,
            planned_tools: &planned_tools,
            measured_tools: &measured_tools,
            openings: &openings,
        });
        self.failure = written.err();
    }
}

impl Recording {
    fn finish(self, row: &TrialRow) -> Result<(), SeriesError> {
        match self.failure {
            Some(error) => Err(error.into()),
            None => Ok(self.recorder.finish(&TrialOutcome::from(row)).map(|_| ())?),
        }
    }
}

fn points(tools: &[glam::DVec3]) -> Vec<[f64; 3]> {
    tools.iter().map(|tool| tool.to_array()).collect()
}

fn tools_at(point: &PathPoint) -> ToolPathPoint {
    ToolPathPoint {
        time_s: point.time_s,
        planned: points(&point.planned),
        measured: points(&point.measured),
    }
}
