//! Reading of an episode's MCAP log in memory.
//!
//! `tandem_telemetry` reads logs from files and writes them, over libraries in C that browsers do not run. This module
//! reads the same records in Rust alone, and only the fields that a simulation is compared with.

use std::collections::BTreeMap;

use mcap::records::op;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use prost::Message as _;
use tandem_core::layout::UnknownTask;
use tandem_core::{EpisodeKind, Layout, Task, WorldSettings};

use crate::error::Error;
use crate::fields::Fields;

/// Largest size of a record or of an uncompressed chunk. Chunks of Tandem's logs have less than 1 MiB.
const MAX_RECORD_BYTES: usize = 16 << 20;
/// Largest number of arms that the simulator has.
const MAX_ARMS: usize = 2;

const EPISODE: &str = "tandem.episode";
const TRIAL: &str = "tandem.trial";
const TRANSITION_TOPIC: &str = "/transition";
const OUTCOME_TOPIC: &str = "/outcome";
const FORMAT: &str = "1";
const DESCRIBED_FORMAT: &str = "2";
const CHECKSUM: &str = "checksum";
const WORLD_PREFIX: &str = "world.";
/// A probability of earlier versions: training episodes that started with the hands anywhere above the table.
const WIDE_START_SHARE: &str = "world.wide_start_share";

/// A recorded episode of a built-in task.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeLog {
    /// The task and the number of arms.
    pub layout: Layout,
    /// Name of the run.
    pub run: String,
    /// Number of the episode.
    pub episode: u64,
    /// Seed; with the number, it determines the start.
    pub seed: u64,
    /// Purpose of the episode.
    pub kind: EpisodeKind,
    /// How the episode starts and how finely its world is simulated.
    pub world: WorldSettings,
    /// Control steps in order.
    pub transitions: Vec<Transition>,
    /// Observation after the last step, shape `[n_observation]`; `None` if the log ends before its episode.
    pub last_observation: Option<Vec<f32>>,
}

/// A recorded control step: the fields of `Transition` in `telemetry/proto/tandem/episode_log.proto` that a simulation
/// gives again.
#[derive(Clone, PartialEq, prost::Message)]
pub struct Transition {
    /// Number of the step, from 0.
    #[prost(uint32, tag = "1")]
    pub step: u32,
    /// Observation before the step, shape `[n_observation]`.
    #[prost(float, repeated, tag = "2")]
    pub observation: Vec<f32>,
    /// Shape `[n_goal]`.
    #[prost(float, repeated, tag = "3")]
    pub goal: Vec<f32>,
    /// Executed action, shape `[n_action]`.
    #[prost(float, repeated, tag = "4")]
    pub action: Vec<f32>,
    /// Joint reward.
    #[prost(float, tag = "5")]
    pub reward: f32,
    /// Reward of each arm, shape `[n_arms]`.
    #[prost(float, repeated, tag = "6")]
    pub rewards_per_arm: Vec<f32>,
    /// Contacts during the step, as bits.
    #[prost(uint32, tag = "8")]
    pub contacts: u32,
}

/// The end of an episode: a field of `Outcome` in the same file.
#[derive(Clone, PartialEq, prost::Message)]
struct Outcome {
    #[prost(float, repeated, tag = "1")]
    observation: Vec<f32>,
}

impl EpisodeLog {
    /// Reads the log in `bytes`, the contents of a file.
    ///
    /// # Errors
    /// If the file is not a complete MCAP file, not the log of an episode, or of a task that is not built-in.
    pub fn read(bytes: &[u8]) -> Result<Self, Error> {
        if !bytes.starts_with(mcap::MAGIC) {
            return Err(Error::NotMcap);
        }
        let mut raw = RawLog::default();
        for_each_record(bytes, Part::File, |opcode, body| raw.add(opcode, body))?;
        if !raw.in_summary {
            return Err(Error::Damaged("no record ends its data".to_owned()));
        }
        let metadata = match (raw.metadata, raw.is_trial) {
            (Some(metadata), _) => metadata,
            (None, true) => return Err(Error::TrialLog),
            (None, false) => {
                return Err(Error::NotAnEpisode(format!("it has no metadata record {EPISODE:?}")));
            }
        };
        let mut log = Self::of_metadata(&metadata)?;
        for (step_idx, message) in raw.transitions.iter().enumerate() {
            let transition = log.transition(step_idx, message);
            let in_step = |problem| Error::NotAnEpisode(format!("step {step_idx}: {problem}"));
            log.transitions.push(transition.map_err(in_step)?);
        }
        log.last_observation = raw
            .outcomes
            .last()
            .map(|message| {
                let outcome = Outcome::decode(message.as_slice()).map_err(|e| e.to_string())?;
                check_length("observation", &outcome.observation, log.layout.n_observation())?;
                Ok(outcome.observation)
            })
            .transpose()
            .map_err(|problem: String| Error::NotAnEpisode(format!("outcome: {problem}")))?;
        match log.transitions.is_empty() {
            true => Err(Error::NotAnEpisode("it has no step".to_owned())),
            false => Ok(log),
        }
    }

    /// Parses the metadata of an episode, which has no steps yet.
    fn of_metadata(map: &BTreeMap<String, String>) -> Result<Self, Error> {
        check_checksum(map)?;
        let text = |key: &str| {
            let value = map.get(key).map(String::as_str);
            value.ok_or_else(|| Error::NotAnEpisode(format!("metadata lack {key:?}")))
        };
        let number = |key: &str| {
            let bad = |_| Error::NotAnEpisode(format!("metadata {key} is no number"));
            text(key)?.parse::<u64>().map_err(bad)
        };
        let task = match text("format")? {
            FORMAT => text("task")?,
            DESCRIBED_FORMAT => return Err(Error::NoSimulator(text("task")?.to_owned())),
            other => {
                return Err(Error::NotAnEpisode(format!("metadata format {other:?} is unknown")));
            }
        };
        let unknown = |error: UnknownTask| Error::NotAnEpisode(error.to_string());
        let task: Task = task.parse().map_err(unknown)?;
        let n_arms = usize::try_from(number("arms")?).unwrap_or(usize::MAX);
        if !(1..=MAX_ARMS).contains(&n_arms) {
            return Err(Error::NotAnEpisode(format!("{n_arms} arms, expected 1 or {MAX_ARMS}")));
        }
        let kind = match text("kind")? {
            "training" => EpisodeKind::Training,
            "evaluation" => EpisodeKind::Evaluation,
            other => return Err(Error::NotAnEpisode(format!("unknown kind {other:?}"))),
        };
        if kind == EpisodeKind::Training
            && map.get(WIDE_START_SHARE).is_some_and(|share| share != "0")
        {
            let problem = "it may have started in a way that only earlier versions simulate";
            return Err(Error::NotAnEpisode(problem.to_owned()));
        }
        let entry = |key: &str| map.get(&format!("{WORLD_PREFIX}{key}")).map(String::as_str);
        let settings = WorldSettings::from_log_entries(entry);
        let settings = settings
            .map_err(|key| Error::NotAnEpisode(format!("metadata world.{key} is no number")))?;
        settings.check().map_err(|error| Error::NotAnEpisode(format!("metadata: {error}")))?;
        Ok(Self {
            layout: Layout::new(task, n_arms),
            run: text("run")?.to_owned(),
            episode: number("episode")?,
            seed: number("seed")?,
            kind,
            world: settings.for_kind(kind),
            transitions: Vec::new(),
            last_observation: None,
        })
    }

    fn transition(&self, step_idx: usize, message: &[u8]) -> Result<Transition, String> {
        let transition = Transition::decode(message).map_err(|error| error.to_string())?;
        if usize::try_from(transition.step) != Ok(step_idx) {
            return Err(format!("it has the number {}", transition.step));
        }
        let layout = self.layout;
        check_length("observation", &transition.observation, layout.n_observation())?;
        check_length("goal", &transition.goal, layout.n_goal())?;
        check_length("action", &transition.action, layout.n_action())?;
        check_length("rewards_per_arm", &transition.rewards_per_arm, layout.n_arms)?;
        Ok(transition)
    }
}

fn check_length(name: &str, numbers: &[f32], expected: usize) -> Result<(), String> {
    match numbers.len() {
        got if got == expected => Ok(()),
        got => Err(format!("{name} has {got} numbers, expected {expected}")),
    }
}

/// Verifies the checksum of the metadata's entries. Older versions wrote none.
fn check_checksum(map: &BTreeMap<String, String>) -> Result<(), Error> {
    let mut crc = crc32fast::Hasher::new();
    for (key, value) in map.iter().filter(|(key, _)| *key != CHECKSUM) {
        for text in [key, value] {
            crc.update(text.as_bytes());
            crc.update(&[0xff]);
        }
    }
    let expected = format!("{:08x}", crc.finalize());
    match map.get(CHECKSUM) {
        Some(got) if *got != expected => Err(Error::Damaged("checksum of the metadata".to_owned())),
        _ => Ok(()),
    }
}

/// The parts of a log that make up an episode, not decoded.
#[derive(Default)]
struct RawLog {
    metadata: Option<BTreeMap<String, String>>,
    /// The file has the metadata of a trial.
    is_trial: bool,
    /// Topics of the channels by their numbers.
    topics: BTreeMap<u16, String>,
    transitions: Vec<Vec<u8>>,
    outcomes: Vec<Vec<u8>>,
    /// The records are those of a chunk, which contains no other chunk.
    in_chunk: bool,
    /// The data have ended. The summary after them repeats the channels.
    in_summary: bool,
}

impl RawLog {
    fn add(&mut self, opcode: u8, body: &[u8]) -> Result<(), Error> {
        let too_short = || Error::Damaged("a record is too short".to_owned());
        let mut fields = Fields(body);
        match opcode {
            op::DATA_END => self.in_summary = true,
            _ if self.in_summary => {}
            op::METADATA => match fields.text().ok_or_else(too_short)? {
                EPISODE => self.metadata = Some(fields.map().ok_or_else(too_short)?),
                name => self.is_trial |= name == TRIAL,
            },
            op::CHANNEL => {
                let id = fields.u16().ok_or_else(too_short)?;
                fields.u16().ok_or_else(too_short)?;
                self.topics.insert(id, fields.text().ok_or_else(too_short)?.to_owned());
            }
            op::MESSAGE => {
                let id = fields.u16().ok_or_else(too_short)?;
                // A sequence number and two times.
                let message = body.get(2 + 4 + 8 + 8..).ok_or_else(too_short)?.to_vec();
                let unknown = || Error::Damaged(format!("a message of the unknown channel {id}"));
                match self.topics.get(&id).ok_or_else(unknown)?.as_str() {
                    TRANSITION_TOPIC => self.transitions.push(message),
                    OUTCOME_TOPIC => self.outcomes.push(message),
                    _ => {}
                }
            }
            op::CHUNK if !self.in_chunk => {
                let records = uncompressed(body)?;
                self.in_chunk = true;
                for_each_record(&records, Part::Chunk, |opcode, body| self.add(opcode, body))?;
                self.in_chunk = false;
            }
            _ => {}
        }
        Ok(())
    }
}

/// What a sequence of records is.
#[derive(PartialEq, Clone, Copy)]
enum Part {
    /// A whole file: magic bytes at both ends, and checksums of data and summary.
    File,
    /// The uncompressed contents of a chunk.
    Chunk,
}

/// Calls `visit` with the opcode and the body of every record.
fn for_each_record(
    bytes: &[u8],
    part: Part,
    mut visit: impl FnMut(u8, &[u8]) -> Result<(), Error>,
) -> Result<(), Error> {
    let is_file = part == Part::File;
    let options = LinearReaderOptions::default()
        .with_emit_chunks(true)
        .with_skip_start_magic(!is_file)
        .with_skip_end_magic(!is_file)
        .with_check_finishes_after_end_magic(is_file)
        .with_validate_data_section_crc(is_file)
        .with_validate_summary_section_crc(is_file)
        .with_record_length_limit(MAX_RECORD_BYTES);
    let mut reader = LinearReader::new_with_options(options);
    let mut unread = bytes;
    while let Some(event) = reader.next_event() {
        match event.map_err(|error| Error::Damaged(error.to_string()))? {
            LinearReadEvent::ReadRequest(n_wanted) => {
                let (next, rest) = unread.split_at(n_wanted.min(unread.len()));
                reader.insert(next.len()).copy_from_slice(next);
                reader.notify_read(next.len());
                unread = rest;
            }
            LinearReadEvent::Record { data, opcode } => visit(opcode, data)?,
        }
    }
    Ok(())
}

/// Returns the records of a chunk and verifies their checksum.
fn uncompressed(chunk: &[u8]) -> Result<Vec<u8>, Error> {
    let damaged = |problem: &str| Error::Damaged(format!("a chunk {problem}"));
    let header = || {
        // Two times.
        let mut fields = Fields(chunk.get(8 + 8..)?);
        let (size, checksum) = (fields.u64()?, fields.u32()?);
        let compression = fields.text()?;
        let length = usize::try_from(fields.u64()?).ok()?;
        Some((usize::try_from(size).ok()?, checksum, compression, fields.0.get(..length)?))
    };
    let (size, checksum, compression, data) = header().ok_or_else(|| damaged("is too short"))?;
    if size > MAX_RECORD_BYTES {
        return Err(damaged("is too large"));
    }
    let mut records = vec![0; size];
    match compression {
        "" if data.len() == size => records.copy_from_slice(data),
        "zstd" => {
            let mut decoder = ruzstd::decoding::FrameDecoder::new();
            let n_decoded = decoder.decode_all(data, &mut records);
            if n_decoded.ok() != Some(size) {
                return Err(damaged("cannot be decompressed"));
            }
        }
        _ => return Err(damaged("has an unknown compression")),
    }
    match checksum == 0 || crc32fast::hash(&records) == checksum {
        true => Ok(records),
        false => Err(damaged("has another checksum")),
    }
}
