//! A recorded episode as messages on a timeline.

use std::collections::BTreeMap;
use std::path::Path;

use foxglove::messages::scene_entity_deletion::Type;
use foxglove::messages::{
    FrameTransforms, JointStates, Log, SceneEntityDeletion, SceneUpdate, Timestamp,
};
use foxglove::{Decode, Encode};
use mcap::McapError;
use mcap::records::Record;

use crate::arms_messages::SCENE;
use crate::error::Error;
use crate::log_file::timestamp;
use crate::records::{Records, read_mcap};

const SCENE_SCHEMA: &str = "foxglove.SceneUpdate";

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

    /// Moves the episode to a later time, with the stamps within its messages. Its first scene then deletes those of
    /// the episodes before it.
    pub(super) fn shift(&mut self, offset_ns: u64) {
        self.ensure_scene();
        for message in &mut self.messages {
            message.time_ns = message.time_ns.saturating_add(offset_ns);
            let schema = self.channels[message.channel].schema_name();
            if let Some(shifted) = with_shifted_stamps(schema, &message.data, offset_ns) {
                message.data = shifted;
            }
        }
        let alone =
            self.messages.iter().enumerate().find_map(|(idx, it)| Some((idx, self.alone(it)?)));
        if let Some((first_idx, alone)) = alone {
            self.messages[first_idx].data = alone;
        }
    }

    /// Adds an empty scene at the start, unless the episode has a scene.
    fn ensure_scene(&mut self) {
        let is_scene = |it: &TimedMessage| self.channels[it.channel].schema_name() == SCENE_SCHEMA;
        if self.messages.iter().any(is_scene) {
            return;
        }
        let schema = SceneUpdate::get_schema();
        let schema = schema.map(|it| (it.name, it.encoding, it.data.into_owned()));
        let (time_ns, channel, data) = (0, self.channels.len(), Vec::new());
        self.messages.insert(0, TimedMessage { time_ns, channel, data });
        self.channels.push(ChannelDescription {
            topic: SCENE.to_owned(),
            message_encoding: SceneUpdate::get_message_encoding(),
            schema,
        });
    }

    /// Returns a message with a scene that also deletes everything shown before. Viewers keep an entity until another
    /// one replaces or a message deletes it. Returns `None` for other messages.
    pub(super) fn alone(&self, message: &TimedMessage) -> Option<Vec<u8>> {
        if self.channels[message.channel].schema_name() != SCENE_SCHEMA {
            return None;
        }
        changed::<SceneUpdate>(&message.data, |update| {
            // Entities of this stamp or a later one are kept.
            let stamp = update.entities.first().and_then(|entity| entity.timestamp);
            let stamp = stamp.unwrap_or_else(|| timestamp(message.time_ns));
            let everything = SceneEntityDeletion {
                timestamp: Some(stamp),
                r#type: Type::All.into(),
                id: String::new(),
            };
            update.deletions = vec![everything];
        })
    }
}

impl ChannelDescription {
    fn schema_name(&self) -> &str {
        self.schema.as_ref().map_or("", |(name, _, _)| name.as_str())
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
        SCENE_SCHEMA => changed::<SceneUpdate>(data, |update| {
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

#[cfg(test)]
mod tests {
    use foxglove::messages::SceneEntity;

    use super::*;

    /// Returns an episode with a scene of one entity at each of `times_ns`.
    fn episode(times_ns: &[u64]) -> Episode {
        let mut episode = Episode { channels: Vec::new(), messages: Vec::new() };
        episode.ensure_scene();
        episode.messages.clear();
        for time_ns in times_ns {
            let stamp = Some(timestamp(*time_ns));
            let entity =
                SceneEntity { timestamp: stamp, id: "arm0".to_owned(), ..SceneEntity::default() };
            let update = SceneUpdate { deletions: Vec::new(), entities: vec![entity] };
            let mut data = Vec::new();
            update.encode(&mut data).expect("encodes");
            episode.messages.push(TimedMessage { time_ns: *time_ns, channel: 0, data });
        }
        episode
    }

    #[test]
    fn only_the_first_scene_deletes_those_of_earlier_episodes() {
        let check = |times_ns: &[u64], expected: &[(u64, usize, usize)]| {
            let mut episode = episode(times_ns);
            episode.shift(3_000_000_000);
            let shifted = episode.messages.iter().map(|message| {
                let update = SceneUpdate::decode(message.data.as_slice()).expect("a scene");
                let stamp = Some(timestamp(message.time_ns));
                for deletion in &update.deletions {
                    assert_eq!((deletion.r#type(), deletion.timestamp), (Type::All, stamp));
                }
                assert!(update.entities.iter().all(|entity| entity.timestamp == stamp));
                (message.time_ns, update.deletions.len(), update.entities.len())
            });
            assert_eq!(shifted.collect::<Vec<_>>(), expected);
        };
        check(&[0, 500_000_000], &[(3_000_000_000, 1, 1), (3_500_000_000, 0, 1)]);
        check(&[250_000_000], &[(3_250_000_000, 1, 1)]);
        check(&[], &[(3_000_000_000, 1, 0)]);
    }

    #[test]
    fn a_scene_deletes_what_is_older_than_it_at_most_once() {
        let mut episode = episode(&[0]);
        episode.shift(1_000_000_000);
        let first = &episode.messages[0];
        assert_eq!(episode.alone(first).as_ref(), Some(&first.data));
    }
}
