//! Writes one trial on arms into one MCAP file.

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

/// Looks after which what was logged is on the disk even if the process dies.
const FLUSH_EVERY_LOOKS: u32 = 25;
/// Names of the metadata records: at the start, and at the end.
const METADATA_NAME: &str = "tandem.trial";
const OUTCOME_NAME: &str = "tandem.trial.outcome";
const FORMAT: &str = "1";

/// What a trial is. Stands in its log as the MCAP metadata record `tandem.trial`.
#[derive(Debug, Clone, PartialEq)]
pub struct TrialMetadata {
    /// Whose trial it is: a policy's name.
    pub subject: String,
    /// Task and arms.
    pub layout: Layout,
    /// `open-loop` or `closed-loop`.
    pub mode: String,
    /// The trial's number.
    pub trial: u64,
    /// With the number, the address of its random draws.
    pub seed: u64,
    /// Digest of the policy that decides.
    pub policy_digest: String,
    /// What moves the arms, such as `simulated`.
    pub driver: String,
    /// Share of the fastest speed, in (0, 1].
    pub speed: f64,
    /// Half the edge of the blocks, metres.
    pub block_half_m: f64,
}

/// The table and the arms at one moment. Places are metres in the world's frame, arm by arm.
#[derive(Debug, Clone, Copy)]
pub struct TrialLook<'a> {
    /// Seconds since the trial's start.
    pub time_s: f64,
    /// Everything as it truly is.
    pub scene: &'a Scene,
    /// Where the motion has the joints, radians, while there is one.
    pub planned_joints: Option<&'a [Vec<f64>]>,
    /// What the encoders say, radians; empty before they said anything.
    pub measured_joints: &'a [Vec<f64>],
    /// Where the motion has the tools; empty while there is none.
    pub planned_tools: &'a [[f64; 3]],
    /// Where the tools are.
    pub measured_tools: &'a [[f64; 3]],
    /// How far the grippers are open, 0 to 1; empty when that is not known.
    pub openings: &'a [f64],
}

/// What became of a trial. Stands in its log as the MCAP metadata record `tandem.trial.outcome`.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TrialOutcome {
    /// The name of what went wrong; `None` is success.
    pub cause: Option<String>,
    /// What there is to say about it.
    pub detail: Option<String>,
    /// How far each object ended from its goal, metres.
    pub goal_distances_m: Vec<f64>,
    /// How long the arms took, seconds.
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

/// How much a line of a trial's log matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LogLevel {
    /// What was to be expected.
    Info,
    /// What was recovered from, such as a step that was shortened.
    Warning,
    /// What ended the trial.
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

/// Writes one trial into one MCAP file.
///
/// The file is called `NAME.mcap.part` until [`finish`](Self::finish) gives it its name, so a file without that
/// ending is always whole. Message times count from the trial's start.
pub struct TrialRecorder {
    file: LogFile,
    channels: Channels,
    n_arms: usize,
    title: String,
    trails: Trails,
    n_looks: u32,
    time_ns: u64,
    /// Shown once more with the outcome above it.
    last: Option<Last>,
}

/// The last look.
struct Last {
    scene: Scene,
    planned_tools: Vec<[f64; 3]>,
}

impl TrialRecorder {
    /// Starts the log `path` of the trial that `metadata` describes; an unfinished one of that name is overwritten.
    ///
    /// # Errors
    /// When the file cannot be written.
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
            n_looks: 0,
            time_ns: 0,
            last: None,
        };
        recorder.log(LogLevel::Info, &metadata.start_line())?;
        recorder.file.flush().map_err(recorder.file.write_error())?;
        Ok(recorder)
    }

    /// Logs the table and the arms at one moment. Times must not go back.
    ///
    /// # Errors
    /// When something is said of more or fewer arms than the trial has, the time makes no sense, or the file cannot be
    /// written.
    pub fn look(&mut self, look: &TrialLook<'_>) -> Result<(), Error> {
        self.check_lengths(look)?;
        self.time_ns = nanoseconds(look.time_s)?;
        self.trails.go_on(look.planned_tools, look.measured_tools);
        self.n_looks += 1;
        self.write_look(look).map_err(self.file.write_error())?;
        self.last =
            Some(Last { scene: look.scene.clone(), planned_tools: look.planned_tools.to_vec() });
        Ok(())
    }

    /// Adds a line to the trial's log channel, at the time of the latest look.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn log(&mut self, level: LogLevel, message: &str) -> Result<(), Error> {
        let line = log_line(self.time_ns, level.into(), message);
        let (file, now) = (&mut self.file, self.time_ns);
        self.channels.log.write(file, now, &line).map_err(self.file.write_error())
    }

    /// Logs what became of the trial, completes the file, gives it its name and returns that.
    ///
    /// # Errors
    /// When the file cannot be written or renamed.
    pub fn finish(mut self, outcome: &TrialOutcome) -> Result<PathBuf, Error> {
        let verdict = outcome.verdict();
        let level = if outcome.cause.is_none() { LogLevel::Info } else { LogLevel::Error };
        self.log(level, &verdict)?;
        self.write_outcome(outcome, &verdict).map_err(self.file.write_error())?;
        self.file.finish()
    }

    fn check_lengths(&self, look: &TrialLook<'_>) -> Result<(), Error> {
        check_length("scene.arms", look.scene.arms.len(), self.n_arms)?;
        let some_or_none = [
            ("planned_joints", look.planned_joints.map_or(0, <[_]>::len)),
            ("measured_joints", look.measured_joints.len()),
            ("planned_tools", look.planned_tools.len()),
            ("measured_tools", look.measured_tools.len()),
            ("openings", look.openings.len()),
        ];
        for (field, got) in some_or_none.into_iter().filter(|(_, got)| *got > 0) {
            check_length(field, got, self.n_arms)?;
        }
        Ok(())
    }

    fn write_look(&mut self, look: &TrialLook<'_>) -> mcap::McapResult<()> {
        let caption = format!("{}\n{:.2} s", self.title, look.time_s);
        self.write_scene(look.scene, look.planned_tools, &caption)?;
        let (file, now) = (&mut self.file, self.time_ns);
        let stamp = timestamp(now);
        self.channels.tf.write(file, now, &frame_transforms(look.scene, stamp))?;
        if !look.measured_joints.is_empty() {
            let states = joint_states_of(look.measured_joints, look.openings, stamp);
            self.channels.measured.write(file, now, &states)?;
        }
        if let Some(planned) = look.planned_joints {
            self.channels.planned.write(file, now, &joint_states_of(planned, &[], stamp))?;
        }
        if self.n_looks.is_multiple_of(FLUSH_EVERY_LOOKS) {
            self.file.flush()?;
        }
        Ok(())
    }

    fn write_outcome(&mut self, outcome: &TrialOutcome, verdict: &str) -> mcap::McapResult<()> {
        if let Some(Last { scene, planned_tools }) = self.last.take() {
            let caption = format!("{}\n{verdict}", self.title);
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
    /// Puts metadata and channels at the head of `file`.
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
        let Self { subject, mode, trial, .. } = self;
        format!("{subject}, {}, {mode}, trial {trial}", self.layout.task)
    }

    fn start_line(&self) -> String {
        format!(
            "{} of seed {} begins: driver {}, speed {}, blocks of {:.0} mm",
            self.title(),
            self.seed,
            self.driver,
            self.speed,
            2000.0 * self.block_half_m,
        )
    }

    fn to_map(&self) -> BTreeMap<String, String> {
        entries([
            ("format", FORMAT.to_owned()),
            ("subject", self.subject.clone()),
            ("task", self.layout.task.to_string()),
            ("arms", self.layout.n_arms.to_string()),
            ("mode", self.mode.clone()),
            ("trial", self.trial.to_string()),
            ("seed", self.seed.to_string()),
            ("policy_digest", self.policy_digest.clone()),
            ("driver", self.driver.clone()),
            ("speed", self.speed.to_string()),
            ("block_half_m", self.block_half_m.to_string()),
        ])
    }
}

impl TrialOutcome {
    fn verdict(&self) -> String {
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

fn entries<const N: usize>(entries: [(&str, String); N]) -> BTreeMap<String, String> {
    with_checksum(entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect())
}
