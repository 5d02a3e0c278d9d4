//! Reading of an episode's MCAP log.

use std::collections::BTreeMap;
use std::path::Path;

use mcap::McapError;
use mcap::read::ChannelAccumulator;
use mcap::records::Record;
use tandem_core::{ArmAdvice, ArmIndex, Contacts, TaskSpec};

use crate::error::Error;
use crate::messages::{EpisodeMetadata, METADATA_NAME, decode, pb};
use crate::recorder::{OUTCOME_TOPIC, TRANSITION_TOPIC};
use crate::records::{Records, read_mcap};
use crate::{motion_log, trial_log};

/// A recorded episode.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeLog {
    /// The inputs of the episode, from which it can be simulated again.
    pub metadata: EpisodeMetadata,
    /// Control steps, in order from 0. A recovered log may contain fewer than the episode had.
    pub transitions: Vec<LoggedTransition>,
    /// Observation after the last step, shape `[n_observation]`; `None` if the log is incomplete.
    pub last_observation: Option<Vec<f32>>,
}

/// One recorded control step.
#[derive(Debug, Clone, PartialEq)]
pub struct LoggedTransition {
    /// Observation before the step, shape `[n_observation]`.
    pub observation: Vec<f32>,
    /// Goal, shape `[n_goal]`.
    pub goal: Vec<f32>,
    /// Executed action, in [−1, 1], shape `[n_action]`.
    pub action: Vec<f32>,
    /// Joint reward of all arms.
    pub reward: f32,
    /// Reward of each arm, shape `[n_arms]`.
    pub rewards_per_arm: Vec<f32>,
    /// Bit `a` is set if arm `a` executed the teacher's action.
    pub advised_arms: u8,
    /// Contacts during the step.
    pub contacts: Contacts,
    /// Advice of the teacher in arm order; empty if it was not asked.
    pub advice: Vec<ArmAdvice>,
    /// Units of the advice budget left when the teacher answered; `None` if it was not asked or the log is of an
    /// earlier version.
    pub budget_left: Option<u64>,
}

impl EpisodeLog {
    /// Returns true if every arm succeeds after each of the last [steps](TaskSpec::success_steps) that count; `None` if
    /// the log is incomplete.
    #[must_use]
    pub fn succeeded(&self) -> Option<bool> {
        let task = &self.metadata.task;
        self.ends_with(|observation, goal| task.is_success(observation, goal))
    }

    /// Returns true if `arm` succeeds after each of the last [steps](TaskSpec::success_steps) that count; `None` if the
    /// log is incomplete.
    #[must_use]
    pub fn arm_succeeded(&self, arm: ArmIndex) -> Option<bool> {
        let task = &self.metadata.task;
        self.ends_with(|observation, goal| task.arm_succeeds(arm, observation, goal))
    }

    fn ends_with(&self, succeeds: impl Fn(&[f32], &[f32]) -> bool) -> Option<bool> {
        let (last, goal) = (self.last_observation.as_ref()?, &self.transitions.last()?.goal);
        let n_counted = self.metadata.task.success_steps();
        let observations = self.transitions.iter().map(|step| &step.observation).chain([last]);
        let counted: Vec<_> = observations.rev().take(n_counted).collect();
        let is_long_enough = counted.len() == n_counted;
        Some(is_long_enough && counted.into_iter().all(|observation| succeeds(observation, goal)))
    }
}

/// Reads the episode in the MCAP log `path`.
///
/// # Errors
/// If the file cannot be read, is incomplete, or is not the log of an episode. Logs of trials and of motions are errors
/// of their own, [`Error::TrialLog`] and [`Error::MotionLog`].
pub fn read_episode(path: &Path) -> Result<EpisodeLog, Error> {
    let bytes = read_mcap(path)?;
    let not_an_episode = |problem| Error::NotAnEpisode { path: path.to_owned(), problem };
    let raw = read_raw(&bytes).map_err(Error::read_log(path))?;
    match (&raw.metadata, raw.other) {
        (None, Some(OtherLog::Trial)) => return Err(Error::TrialLog { path: path.to_owned() }),
        (None, Some(OtherLog::Motion)) => return Err(Error::MotionLog { path: path.to_owned() }),
        _ => {}
    }
    decode_episode(raw).map_err(not_an_episode)
}

/// A kind of log that is not an episode's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum OtherLog {
    Trial,
    Motion,
}

/// The parts of a log that make up an episode, not decoded.
#[derive(Default)]
struct RawLog {
    metadata: Option<BTreeMap<String, String>>,
    /// The file has the metadata of another kind of log.
    other: Option<OtherLog>,
    transitions: Vec<Vec<u8>>,
    outcomes: Vec<Vec<u8>>,
}

fn read_raw(bytes: &[u8]) -> mcap::McapResult<RawLog> {
    let mut raw = RawLog::default();
    let mut channels = ChannelAccumulator::default();
    let mut in_summary = false;
    for record in Records::of_complete(bytes) {
        match record? {
            // The summary repeats channels and schemas; reading it verifies that the file is complete.
            Record::DataEnd(_) => in_summary = true,
            _ if in_summary => {}
            Record::Metadata(metadata) if metadata.name == METADATA_NAME => {
                raw.metadata = Some(metadata.metadata);
            }
            Record::Metadata(metadata) => match metadata.name.as_str() {
                trial_log::METADATA_NAME => raw.other = Some(OtherLog::Trial),
                motion_log::METADATA_NAME => raw.other = Some(OtherLog::Motion),
                _ => {}
            },
            Record::Schema { header, data } => {
                channels.add_schema(header, data.into_owned().into())?;
            }
            Record::Channel(channel) => {
                channels.add_channel(channel)?;
            }
            Record::Message { header, data } => {
                let unknown = McapError::UnknownChannel(header.sequence, header.channel_id);
                match channels.get(header.channel_id).ok_or(unknown)?.topic.as_str() {
                    TRANSITION_TOPIC => raw.transitions.push(data.into_owned()),
                    OUTCOME_TOPIC => raw.outcomes.push(data.into_owned()),
                    _ => {}
                }
            }
            _ => {}
        }
    }
    Ok(raw)
}

fn decode_episode(raw: RawLog) -> Result<EpisodeLog, String> {
    let metadata =
        raw.metadata.ok_or_else(|| format!("it has no metadata record {METADATA_NAME:?}"))?;
    let metadata = EpisodeMetadata::from_map(&metadata)?;
    let task = &metadata.task;
    let transitions = raw.transitions.iter().enumerate();
    let transitions = transitions
        .map(|(step_idx, bytes)| {
            decode_transition(task, step_idx, bytes)
                .map_err(|problem| format!("step {step_idx}: {problem}"))
        })
        .collect::<Result<_, _>>()?;
    let last_observation =
        raw.outcomes.last().map(|bytes| decode_last_observation(task, bytes)).transpose()?;
    Ok(EpisodeLog { metadata, transitions, last_observation })
}

fn decode_transition(
    task: &TaskSpec,
    step_idx: usize,
    bytes: &[u8],
) -> Result<LoggedTransition, String> {
    let message: pb::Transition = decode(bytes).map_err(|error| error.to_string())?;
    if usize::try_from(message.step) != Ok(step_idx) {
        return Err(format!("has the number {}", message.step));
    }
    let advised_arms =
        u8::try_from(message.advised_arms).map_err(|error| format!("advised_arms: {error}"))?;
    let contacts = u8::try_from(message.contacts).ok().and_then(Contacts::from_bits);
    Ok(LoggedTransition {
        observation: with_length("observation", message.observation, task.n_observation())?,
        goal: with_length("goal", message.goal, task.n_goal())?,
        action: with_length("action", message.action, task.n_action())?,
        reward: message.reward,
        rewards_per_arm: with_length("rewards_per_arm", message.rewards_per_arm, task.n_arms())?,
        advised_arms,
        contacts: contacts.ok_or_else(|| format!("unknown contacts {:#b}", message.contacts))?,
        advice: message.advice.into_iter().map(ArmAdvice::from).collect(),
        budget_left: message.budget_left,
    })
}

fn decode_last_observation(task: &TaskSpec, bytes: &[u8]) -> Result<Vec<f32>, String> {
    let outcome: pb::Outcome = decode(bytes).map_err(|error| format!("outcome: {error}"))?;
    with_length("last observation", outcome.observation, task.n_observation())
}

fn with_length(field: &str, numbers: Vec<f32>, expected: usize) -> Result<Vec<f32>, String> {
    match numbers.len() {
        got if got == expected => Ok(numbers),
        got => Err(format!("{field} has {got} numbers, the task has {expected}")),
    }
}

#[cfg(test)]
mod tests {
    use mcap::records::op;

    use super::*;

    #[test]
    fn a_message_on_an_unknown_channel_is_refused() {
        let record = |opcode: u8, body: &[u8]| {
            [&[opcode], (body.len() as u64).to_le_bytes().as_slice(), body].concat()
        };
        let file = |message: &[u8]| {
            let (header, end) = (record(op::HEADER, &[0; 8]), record(op::DATA_END, &[0; 4]));
            let footer = record(op::FOOTER, &[0; 20]);
            [mcap::MAGIC, &header, message, &end, &footer, mcap::MAGIC].concat()
        };
        assert!(read_raw(&file(&[])).is_ok(), "an empty log is complete");
        let message = record(op::MESSAGE, &[[2].as_slice(), &[0; 21]].concat());
        let refused = read_raw(&file(&message)).err();
        assert!(matches!(refused, Some(McapError::UnknownChannel(0, 2))), "{refused:?}");
    }
}
