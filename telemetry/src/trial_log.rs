//! Writing of a trial's MCAP log.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use foxglove::messages::{FrameTransforms, JointStates, Log, SceneUpdate, log::Level};
use tandem_core::Layout;
use tandem_core::scene::Scene;

use crate::error::Error;
use crate::log_file::{Channel, LogFile, check_length, log_line, nanoseconds, timestamp};
use crate::messages::with_checksum;
use crate::scene::{Trails, frame_transforms, joint_states_of, scene_update};
use crate::trials::TrialRow;

/// Number of snapshots after which the log is flushed to disk.
const FLUSH_EVERY_SNAPSHOTS: u32 = 25;
/// Names of the metadata records at the start and at the end of a log.
pub(crate) const METADATA_NAME: &str = "tandem.trial";
const OUTCOME_NAME: &str = "tandem.trial.outcome";
const FORMAT: &str = "1";

/// Metadata of a trial, logged as the MCAP metadata record `tandem.trial`.
#[derive(Debug, Clone, PartialEq)]
pub struct TrialMetadata {
    /// Name of the policy, logged under the key `subject`.
    pub policy: String,
    /// Task and number of arms.
    pub layout: Layout,
    /// `open-loop`, `twin` or `closed-loop`.
    pub mode: String,
    /// Number of the trial.
    pub trial: u64,
    /// Seed; with the number, it determines all random numbers of the trial.
    pub seed: u64,
    /// Digest of the policy file.
    pub policy_digest: String,
    /// Name of the driver, such as `sim`.
    pub driver: String,
    /// Share of full speed, in (0, 1].
    pub speed: f64,
    /// Half the edge length of the blocks, metres; `None` if the arms share an object.
    pub block_half_m: Option<f64>,
}

/// State of the table and the arms at one time. Positions are in the world frame, metres; vectors are in arm order.
#[derive(Debug, Clone, Copy)]
pub struct TrialSnapshot<'a> {
    /// Time since the start of the trial, seconds.
    pub time_s: f64,
    /// True state of the scene.
    pub scene: &'a Scene,
    /// Planned joint angles, radians; `None` while no motion is executed.
    pub planned_joints: Option<&'a [Vec<f64>]>,
    /// Measured joint angles, radians; empty before the first measurement.
    pub measured_joints: &'a [Vec<f64>],
    /// Planned positions of the tools; empty while no motion is executed.
    pub planned_tools: &'a [[f64; 3]],
    /// Measured positions of the tools.
    pub measured_tools: &'a [[f64; 3]],
    /// Openings of the grippers, 0 (closed) to 1 (open); empty if they are unknown.
    pub openings: &'a [f64],
}

/// Outcome of a trial, logged as the MCAP metadata record `tandem.trial.outcome`.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TrialOutcome {
    /// Cause of the failure; `None` for a success.
    pub cause: Option<String>,
    /// Details of the cause.
    pub detail: Option<String>,
    /// Final distance of each object from its goal, metres.
    pub goal_distances_m: Vec<f64>,
    /// Duration of the arms' motion, seconds.
    pub duration_s: f64,
}

impl From<&TrialRow> for TrialOutcome {
    fn from(row: &TrialRow) -> Self {
        Self {
            cause: row.cause.clone(),
            detail: row.detail.clone(),
            goal_distances_m: row.goal_distances_m.clone(),
            duration_s: row.duration_s,
        }
    }
}

/// Severity of a line in a trial's log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LogLevel {
    /// An expected event.
    Info,
    /// A problem that was recovered from, such as a shortened step.
    Warning,
    /// A problem that ended the trial.
    Error,
}

impl From<LogLevel> for Level {
    fn from(level: LogLevel) -> Self {
        match level {
            LogLevel::Info => Self::Info,
            LogLevel::Warning => Self::Warning,
            LogLevel::Error => Self::Error,
        }
    }
}

/// Writes one trial to one MCAP file.
///
/// The file is named `NAME.mcap.part` until [`finish`](Self::finish) renames it, so a file without that suffix is
/// always complete. Message times count from the start of the trial.
pub struct TrialRecorder {
    file: LogFile,
    channels: Channels,
    n_arms: usize,
    title: String,
    trails: Trails,
    n_snapshots: u32,
    time_ns: u64,
    /// Repeated at the end with the outcome as its caption.
    last_scene: Option<LastScene>,
}

/// The scene of the latest snapshot.
struct LastScene {
    scene: Scene,
    planned_tools: Vec<[f64; 3]>,
}

impl TrialRecorder {
    /// Creates the log `path` of the trial with this `metadata`. An incomplete log of that name is overwritten.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn create(path: &Path, metadata: &TrialMetadata) -> Result<Self, Error> {
        let mut file = LogFile::create(path)?;
        let channels = Channels::start(&mut file, metadata).map_err(file.write_error())?;
        let n_arms = metadata.layout.n_arms;
        let mut recorder = Self {
            file,
            channels,
            n_arms,
            title: metadata.title(),
            trails: Trails::new(n_arms),
            n_snapshots: 0,
            time_ns: 0,
            last_scene: None,
        };
        recorder.log(LogLevel::Info, &metadata.start_line())?;
        recorder.file.flush().map_err(recorder.file.write_error())?;
        Ok(recorder)
    }

    /// Logs the table and the arms at one time. Times must not decrease.
    ///
    /// # Errors
    /// If a vector has another number of arms than the trial, the time is negative or not finite, or the file cannot be
    /// written.
    pub fn record(&mut self, snapshot: &TrialSnapshot<'_>) -> Result<(), Error> {
        self.check_lengths(snapshot)?;
        self.time_ns = nanoseconds(snapshot.time_s)?;
        self.trails.extend(snapshot.planned_tools, snapshot.measured_tools);
        self.n_snapshots += 1;
        self.write_snapshot(snapshot).map_err(self.file.write_error())?;
        self.last_scene = Some(LastScene {
            scene: snapshot.scene.clone(),
            planned_tools: snapshot.planned_tools.to_vec(),
        });
        Ok(())
    }

    /// Adds a line to the log channel, at the time of the latest snapshot.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn log(&mut self, level: LogLevel, message: &str) -> Result<(), Error> {
        let line = log_line(self.time_ns, level.into(), message);
        let (file, now) = (&mut self.file, self.time_ns);
        self.channels.log.write(file, now, &line).map_err(self.file.write_error())
    }

    /// Logs the outcome, completes the file, gives it its final name and returns its path.
    ///
    /// # Errors
    /// If the file cannot be written or renamed.
    pub fn finish(mut self, outcome: &TrialOutcome) -> Result<PathBuf, Error> {
        let text = outcome.text();
        let level = if outcome.cause.is_none() { LogLevel::Info } else { LogLevel::Error };
        self.log(level, &text)?;
        self.write_outcome(outcome, &text).map_err(self.file.write_error())?;
        self.file.finish()
    }

    fn check_lengths(&self, snapshot: &TrialSnapshot<'_>) -> Result<(), Error> {
        check_length("scene.arms", snapshot.scene.arms.len(), self.n_arms)?;
        let optional = [
            ("planned_joints", snapshot.planned_joints.map_or(0, <[_]>::len)),
            ("measured_joints", snapshot.measured_joints.len()),
            ("planned_tools", snapshot.planned_tools.len()),
            ("measured_tools", snapshot.measured_tools.len()),
            ("openings", snapshot.openings.len()),
        ];
        for (field, got) in optional.into_iter().filter(|(_, got)| *got > 0) {
            check_length(field, got, self.n_arms)?;
        }
        Ok(())
    }

    fn write_snapshot(&mut self, snapshot: &TrialSnapshot<'_>) -> mcap::McapResult<()> {
        let caption = format!("{}\n{:.2} s", self.title, snapshot.time_s);
        self.write_scene(snapshot.scene, snapshot.planned_tools, &caption)?;
        let (file, now) = (&mut self.file, self.time_ns);
        let stamp = timestamp(now);
        self.channels.tf.write(file, now, &frame_transforms(snapshot.scene, stamp))?;
        if !snapshot.measured_joints.is_empty() {
            let states = joint_states_of(snapshot.measured_joints, snapshot.openings, stamp);
            self.channels.measured.write(file, now, &states)?;
        }
        if let Some(planned) = snapshot.planned_joints {
            self.channels.planned.write(file, now, &joint_states_of(planned, &[], stamp))?;
        }
        if self.n_snapshots.is_multiple_of(FLUSH_EVERY_SNAPSHOTS) {
            self.file.flush()?;
        }
        Ok(())
    }

    fn write_outcome(&mut self, outcome: &TrialOutcome, text: &str) -> mcap::McapResult<()> {
        if let Some(LastScene { scene, planned_tools }) = self.last_scene.take() {
            let caption = format!("{}\n{text}", self.title);
            self.write_scene(&scene, &planned_tools, &caption)?;
        }
        self.file.write_metadata(OUTCOME_NAME, outcome.to_map())
    }

    fn write_scene(
        &mut self,
        scene: &Scene,
        planned_tools: &[[f64; 3]],
        caption: &str,
    ) -> mcap::McapResult<()> {
        let (file, now) = (&mut self.file, self.time_ns);
        let mut update = scene_update(scene, timestamp(now), caption);
        update.entities.extend(self.trails.entities(planned_tools, timestamp(now)));
        self.channels.scene.write(file, now, &update)
    }
}

struct Channels {
    scene: Channel<SceneUpdate>,
    tf: Channel<FrameTransforms>,
    measured: Channel<JointStates>,
    planned: Channel<JointStates>,
    log: Channel<Log>,
}

impl Channels {
    /// Writes metadata and channels to the start of `file`.
    fn start(file: &mut LogFile, metadata: &TrialMetadata) -> mcap::McapResult<Self> {
        file.write_metadata(METADATA_NAME, metadata.to_map())?;
        Ok(Self {
            scene: Channel::open(file, "/scene")?,
            tf: Channel::open(file, "/tf")?,
            measured: Channel::open(file, "/joint_states")?,
            planned: Channel::open(file, "/planned/joint_states")?,
            log: Channel::open(file, "/log")?,
        })
    }
}

impl TrialMetadata {
    fn title(&self) -> String {
        let Self { policy, mode, trial, .. } = self;
        format!("{policy}, {}, {mode}, trial {trial}", self.layout.task)
    }

    fn start_line(&self) -> String {
        let edge_mm = self.block_half_m.map(|half_m| 2000.0 * half_m);
        let blocks = edge_mm.map(|edge_mm| format!(", blocks of {edge_mm:.0} mm"));
        let blocks = blocks.unwrap_or_default();
        format!(
            "{}, seed {}: driver {}, speed {}{blocks}",
            self.title(),
            self.seed,
            self.driver,
            self.speed,
        )
    }

    fn to_map(&self) -> BTreeMap<String, String> {
        let block = self.block_half_m.map(|half_m| ("block_half_m", half_m.to_string()));
        let always = [
            ("format", FORMAT.to_owned()),
            ("subject", self.policy.clone()),
            ("task", self.layout.task.to_string()),
            ("arms", self.layout.n_arms.to_string()),
            ("mode", self.mode.clone()),
            ("trial", self.trial.to_string()),
            ("seed", self.seed.to_string()),
            ("policy_digest", self.policy_digest.clone()),
            ("driver", self.driver.clone()),
            ("speed", self.speed.to_string()),
        ];
        entries(always.into_iter().chain(block))
    }
}

impl TrialOutcome {
    /// Returns `success`, or `failure` with its cause and details.
    fn text(&self) -> String {
        match (&self.cause, &self.detail) {
            (None, _) => "success".to_owned(),
            (Some(cause), None) => format!("failure: {cause}"),
            (Some(cause), Some(detail)) => format!("failure: {cause}: {detail}"),
        }
    }

    fn to_map(&self) -> BTreeMap<String, String> {
        let outcome = if self.cause.is_none() { "success" } else { "failure" };
        let distances: Vec<String> = self.goal_distances_m.iter().map(f64::to_string).collect();
        entries([
            ("outcome", outcome.to_owned()),
            ("cause", self.cause.clone().unwrap_or_default()),
            ("detail", self.detail.clone().unwrap_or_default()),
            ("goal_distances_m", distances.join(" ")),
            ("duration_s", self.duration_s.to_string()),
        ])
    }
}

fn entries<'a>(entries: impl IntoIterator<Item = (&'a str, String)>) -> BTreeMap<String, String> {
    with_checksum(entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect())
}
