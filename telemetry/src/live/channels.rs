//! The channels of a server, opened when the first log with them is played.

use std::collections::BTreeMap;
use std::sync::Arc;

use foxglove::{Context, FoxgloveError, PartialMetadata, RawChannel, Schema};

use super::episode::{ChannelDescription, Episode, TimedMessage};
use crate::error::Error;

/// Channels by topic.
pub(super) struct Channels {
    context: Arc<Context>,
    by_topic: BTreeMap<String, Arc<RawChannel>>,
}

impl Channels {
    pub(super) const fn new(context: Arc<Context>) -> Self {
        Self { context, by_topic: BTreeMap::new() }
    }

    /// Returns the context that channels are opened in.
    pub(super) const fn context(&self) -> &Arc<Context> {
        &self.context
    }

    /// Opens the channels that are not open yet. A topic keeps the schema that it had first.
    pub(super) fn open(&mut self, descriptions: &[ChannelDescription]) -> Result<(), Error> {
        for description in descriptions {
            if !self.by_topic.contains_key(&description.topic) {
                let channel = self.build(description);
                let channel = channel.map_err(|error| Error::Channel {
                    topic: description.topic.clone(),
                    problem: error.to_string(),
                })?;
                self.by_topic.insert(description.topic.clone(), channel);
            }
        }
        Ok(())
    }

    fn build(&self, description: &ChannelDescription) -> Result<Arc<RawChannel>, FoxgloveError> {
        let schema = description.schema.as_ref();
        let schema = schema.map(|(name, encoding, data)| {
            Schema::new(name.clone(), encoding.clone(), data.clone())
        });
        self.context
            .channel_builder(&description.topic)
            .schema(schema)
            .message_encoding(&description.message_encoding)
            .build_raw()
    }

    /// Publishes the messages of `episode` from `first` to before `end`, indices in order of time.
    pub(super) fn publish(&self, episode: &Episode, first: usize, end: usize) {
        for message in &episode.messages[first..end] {
            self.publish_at(episode, message.channel, &message.data, message.time_ns);
        }
    }

    /// Publishes the latest message of each channel among the first `end` ones, with the time `now_ns`. The scene is
    /// then the only one that viewers show.
    pub(super) fn publish_latest(&self, episode: &Episode, end: usize, now_ns: u64) {
        let mut latest: BTreeMap<usize, &TimedMessage> = BTreeMap::new();
        for message in &episode.messages[..end] {
            latest.insert(message.channel, message);
        }
        for (channel, message) in latest {
            let alone = episode.alone(message);
            let data = alone.as_deref().unwrap_or(&message.data);
            self.publish_at(episode, channel, data, now_ns);
        }
    }

    fn publish_at(&self, episode: &Episode, channel: usize, data: &[u8], time_ns: u64) {
        let topic = &episode.channels[channel].topic;
        if let Some(channel) = self.by_topic.get(topic) {
            channel.log_with_meta(data, PartialMetadata { log_time: Some(time_ns) });
        }
    }
}
