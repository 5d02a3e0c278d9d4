//! Writing of the MCAP log of a bridge's motion, or of a stop without a motion.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use foxglove::messages::{FrameTransforms, JointStates, Log, SceneUpdate};

use crate::arms_messages::{
    ARMS, ArmsEncoder, ArmsMessage, Detail, LOG, MEASURED, PLANNED, SCENE, TF,
};
use crate::arms_view::{ArmsView, StopView};
use crate::error::Error;
use crate::log_file::{Channel, LogFile, nanoseconds};
use crate::messages::{pb, with_checksum};

/// Names of the metadata records at the start and at the end of a log.
pub(crate) const METADATA_NAME: &str = "tandem.motion";
const OUTCOME_NAME: &str = "tandem.motion.outcome";
const FORMAT: &str = "1";
/// Time between two pictures of the arms, seconds.
const SHAPES_EVERY_S: f64 = 0.045;
/// Time between two flushes of the log to disk, seconds. A killed process loses at most what came later.
const FLUSH_EVERY_S: f64 = 0.5;

/// The outcome of a motion, logged as the MCAP metadata record `tandem.motion.outcome`.
#[derive(Debug, Clone, PartialEq)]
pub enum MotionOutcome {
    /// The motion was completed.
    Done,
    /// The arms were stopped.
    Stopped(StopView),
    /// The log ends before the motion: it continues in the next log, or the bridge has ended.
    Unfinished,
}

/// Writes one motion to one MCAP file.
///
/// The file is named `NAME.mcap.part` until [`finish`](Self::finish) renames it, so a file without that suffix is
/// always complete. Message times count from the first state in the log.
pub struct MotionRecorder {
    file: LogFile,
    channels: Channels,
    encoder: ArmsEncoder,
    start_s: f64,
    last_s: f64,
    shapes_s: f64,
    flushed_s: f64,
}

impl MotionRecorder {
    /// Creates the log `path`, which begins with the state `first`. `metadata` becomes the record `tandem.motion`, with
    /// the format and a checksum. An incomplete log of that name is overwritten.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn create(
        path: &Path,
        metadata: &BTreeMap<String, String>,
        first: &ArmsView,
    ) -> Result<Self, Error> {
        let mut file = LogFile::create(path)?;
        let channels = Channels::start(&mut file, metadata).map_err(file.write_error())?;
        let mut recorder = Self {
            file,
            channels,
            encoder: ArmsEncoder::new(first.arms.len()),
            start_s: first.time_s,
            last_s: first.time_s,
            shapes_s: f64::NEG_INFINITY,
            flushed_s: f64::NEG_INFINITY,
        };
        recorder.record(first)?;
        Ok(recorder)
    }

    /// Logs a state. Times must not decrease.
    ///
    /// # Errors
    /// If the time is before that of the first state, or the file cannot be written.
    pub fn record(&mut self, view: &ArmsView) -> Result<(), Error> {
        let time_ns = nanoseconds(view.time_s - self.start_s)?;
        let detail = if view.time_s - self.shapes_s >= SHAPES_EVERY_S {
            self.shapes_s = view.time_s;
            Detail::NumbersAndShapes
        } else {
            Detail::Numbers
        };
        self.last_s = view.time_s;
        let messages = self.encoder.encode(view, time_ns, detail);
        self.write(&messages, time_ns).map_err(self.file.write_error())
    }

    /// Returns the time that the log covers, seconds.
    #[must_use]
    pub fn duration_s(&self) -> f64 {
        self.last_s - self.start_s
    }

    /// Logs the outcome, completes the file, gives it its final name and returns its path.
    ///
    /// # Errors
    /// If the file cannot be written or renamed.
    pub fn finish(mut self, outcome: &MotionOutcome) -> Result<PathBuf, Error> {
        let outcome = outcome.to_map(self.duration_s());
        let written = self.file.write_metadata(OUTCOME_NAME, outcome);
        written.map_err(self.file.write_error())?;
        self.file.finish()
    }

    fn write(&mut self, messages: &[ArmsMessage], time_ns: u64) -> mcap::McapResult<()> {
        for message in messages {
            self.channels.write(&mut self.file, time_ns, message)?;
        }
        if self.last_s - self.flushed_s >= FLUSH_EVERY_S {
            self.flushed_s = self.last_s;
            self.file.flush()?;
        }
        Ok(())
    }
}

struct Channels {
    scene: Channel<SceneUpdate>,
    tf: Channel<FrameTransforms>,
    measured: Channel<JointStates>,
    planned: Channel<JointStates>,
    arms: Channel<pb::ArmsState>,
    log: Channel<Log>,
}

impl Channels {
    /// Writes metadata and channels to the start of `file`.
    fn start(file: &mut LogFile, metadata: &BTreeMap<String, String>) -> mcap::McapResult<Self> {
        let mut metadata = metadata.clone();
        metadata.insert("format".to_owned(), FORMAT.to_owned());
        file.write_metadata(METADATA_NAME, with_checksum(metadata))?;
        Ok(Self {
            scene: Channel::open(file, SCENE)?,
            tf: Channel::open(file, TF)?,
            measured: Channel::open(file, MEASURED)?,
            planned: Channel::open(file, PLANNED)?,
            arms: Channel::open(file, ARMS)?,
            log: Channel::open(file, LOG)?,
        })
    }

    fn write(
        &mut self,
        file: &mut LogFile,
        time_ns: u64,
        message: &ArmsMessage,
    ) -> mcap::McapResult<()> {
        match message {
            ArmsMessage::Scene(update) => self.scene.write(file, time_ns, update),
            ArmsMessage::Tf(transforms) => self.tf.write(file, time_ns, transforms),
            ArmsMessage::Measured(states) => self.measured.write(file, time_ns, states),
            ArmsMessage::Planned(states) => self.planned.write(file, time_ns, states),
            ArmsMessage::Arms(state) => self.arms.write(file, time_ns, state),
            ArmsMessage::Log(line) => self.log.write(file, time_ns, line),
        }
    }
}

impl MotionOutcome {
    fn to_map(&self, duration_s: f64) -> BTreeMap<String, String> {
        let outcome = match self {
            Self::Done => "done",
            Self::Stopped(_) => "stopped",
            Self::Unfinished => "unfinished",
        };
        let mut map = BTreeMap::from([
            ("outcome".to_owned(), outcome.to_owned()),
            ("logged_s".to_owned(), duration_s.to_string()),
        ]);
        if let Self::Stopped(stop) = self {
            map.insert("cause".to_owned(), stop.name.clone());
            map.insert("detail".to_owned(), stop.sentence.clone());
            map.insert("stopped_s".to_owned(), stop.time_s.to_string());
        }
        with_checksum(map)
    }
}
