//! A recorded episode as messages on a timeline.

use std::collections::BTreeMap;
use std::path::Path;

use foxglove::messages::{FrameTransforms, JointStates, Log, SceneUpdate, Timestamp};
use foxglove::{Decode, Encode};
use mcap::McapError;
use mcap::records::Record;

use crate::error::Error;
use crate::log_file::timestamp;
use crate::records::{Records, read_mcap};

/// A channel of a log.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ChannelDescription {
    pub(super) topic: String,
    pub(super) message_encoding: String,
    /// Name, encoding and data.
    pub(super) schema: Option<(String, String, Vec<u8>)>,
}

/// A message on the timeline.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct TimedMessage {
    pub(super) time_ns: u64,
    /// Index of its channel in [`Episode::channels`].
    pub(super) channel: usize,
    pub(super) data: Vec<u8>,
}

/// A recorded episode.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Episode {
    pub(super) channels: Vec<ChannelDescription>,
    /// In order of time.
    pub(super) messages: Vec<TimedMessage>,
}

impl Episode {
    /// Reads the log `path`.
    pub(super) fn read(path: &Path) -> Result<Self, Error> {
        let bytes = read_mcap(path)?;
        Self::decode(&bytes).map_err(Error::read_log(path))
    }

    fn decode(bytes: &[u8]) -> mcap::McapResult<Self> {
        let mut schemas = BTreeMap::new();
        let mut indices = BTreeMap::new();
        let mut episode = Self { channels: Vec::new(), messages: Vec::new() };
        let mut in_summary = false;
        for record in Records::of_complete(bytes) {
            match record? {
                // The summary repeats channels and schemas; reading it verifies that the file is complete.
                Record::DataEnd(_) => in_summary = true,
                _ if in_summary => {}
                Record::Schema { header, data } => {
                    schemas.insert(header.id, (header.name, header.encoding, data.into_owned()));
                }
                Record::Channel(channel) => {
                    indices.insert(channel.id, episode.channels.len());
                    episode.channels.push(ChannelDescription {
                        schema: schemas.get(&channel.schema_id).cloned(),
                        topic: channel.topic,
                        message_encoding: channel.message_encoding,
                    });
                }
                Record::Message { header, data } => {
                    let unknown = McapError::UnknownChannel(header.sequence, header.channel_id);
                    let channel = *indices.get(&header.channel_id).ok_or(unknown)?;
                    let (time_ns, data) = (header.log_time, data.into_owned());
                    episode.messages.push(TimedMessage { time_ns, channel, data });
                }
                _ => {}
            }
        }
        episode.messages.sort_by_key(|message| message.time_ns);
        Ok(episode)
    }

    /// Returns the time of the last message.
    pub(super) fn end_ns(&self) -> u64 {
        self.messages.last().map_or(0, |message| message.time_ns)
    }

    /// Returns the number of messages up to and including `time_ns`.
    pub(super) fn n_until(&self, time_ns: u64) -> usize {
        self.messages.partition_point(|message| message.time_ns <= time_ns)
    }

    /// Moves the episode to a later time, with the stamps within its messages.
    pub(super) fn shift(&mut self, offset_ns: u64) {
        for message in &mut self.messages {
            message.time_ns = message.time_ns.saturating_add(offset_ns);
            let schema = self.channels[message.channel].schema.as_ref();
            let name = schema.map_or("", |(name, _, _)| name.as_str());
            if let Some(shifted) = with_shifted_stamps(name, &message.data, offset_ns) {
                message.data = shifted;
            }
        }
    }
}

/// Returns a message whose stamps are later by `offset_ns`; `None` if its schema has no stamps, or it is damaged.
fn with_shifted_stamps(schema: &str, data: &[u8], offset_ns: u64) -> Option<Vec<u8>> {
    let shift = |stamp: &mut Option<Timestamp>| {
        if let Some(stamp) = stamp {
            *stamp = timestamp(stamp.total_nanos().saturating_add(offset_ns));
        }
    };
    match schema {
        "foxglove.SceneUpdate" => changed::<SceneUpdate>(data, |update| {
            update.entities.iter_mut().for_each(|entity| shift(&mut entity.timestamp));
        }),
        "foxglove.FrameTransforms" => changed::<FrameTransforms>(data, |frames| {
            frames.transforms.iter_mut().for_each(|frame| shift(&mut frame.timestamp));
        }),
        "foxglove.JointStates" => {
            changed::<JointStates>(data, |states| shift(&mut states.timestamp))
        }
        "foxglove.Log" => changed::<Log>(data, |line| shift(&mut line.timestamp)),
        _ => None,
    }
}

fn changed<M: Decode + Encode>(data: &[u8], change: impl FnOnce(&mut M)) -> Option<Vec<u8>> {
    let mut message = M::decode(data).ok()?;
    change(&mut message);
    let mut encoded = Vec::with_capacity(data.len());
    message.encode(&mut encoded).ok()?;
    Some(encoded)
}
