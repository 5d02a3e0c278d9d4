//! The arms of a bridge, live.

use std::net::SocketAddr;

use foxglove::messages::{FrameTransforms, JointStates, Log, SceneUpdate};
use foxglove::{Channel, Context, Encode, PartialMetadata};

use super::Server;
use crate::arms_messages::{
    ARMS, ArmsEncoder, ArmsMessage, Detail, LOG, MEASURED, PLANNED, SCENE, TF,
};
use crate::arms_view::ArmsView;
use crate::error::Error;
use crate::log_file::nanoseconds;
use crate::messages::pb;

/// Shows the arms of a bridge to viewers, with the channels of the logs of motions. Times count from the start of the
/// bridge.
pub struct LiveArms {
    server: Server,
    address: SocketAddr,
    channels: Channels,
    encoder: ArmsEncoder,
}

impl LiveArms {
    /// Listens on `address`, for a bridge with `n_arms` arms; port 0 selects a free port.
    ///
    /// # Errors
    /// If the address cannot be listened on.
    pub fn start(address: SocketAddr, n_arms: usize) -> Result<Self, Error> {
        let server = Server::start(address, "tandem bridge", None, None)?;
        let channels = Channels::open(server.channels.context());
        let (address, encoder) = (server.address(address), ArmsEncoder::new(n_arms));
        Ok(Self { server, address, channels, encoder })
    }

    /// Returns the address that viewers connect to.
    #[must_use]
    pub const fn address(&self) -> SocketAddr {
        self.address
    }

    /// Publishes a state. It waits for no viewer.
    pub fn publish(&mut self, view: &ArmsView) {
        let Ok(time_ns) = nanoseconds(view.time_s) else { return };
        self.server.handle.broadcast_time(time_ns);
        for message in self.encoder.encode(view, time_ns, Detail::NumbersAndShapes) {
            self.channels.publish(&message, time_ns);
        }
    }

    /// Closes all connections.
    pub fn stop(self) {
        self.server.stop();
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
    fn open(context: &std::sync::Arc<Context>) -> Self {
        fn channel<T: Encode>(context: &std::sync::Arc<Context>, topic: &str) -> Channel<T> {
            context.channel_builder(topic).build()
        }
        Self {
            scene: channel(context, SCENE),
            tf: channel(context, TF),
            measured: channel(context, MEASURED),
            planned: channel(context, PLANNED),
            arms: channel(context, ARMS),
            log: channel(context, LOG),
        }
    }

    fn publish(&self, message: &ArmsMessage, time_ns: u64) {
        let at = PartialMetadata { log_time: Some(time_ns) };
        match message {
            ArmsMessage::Scene(update) => self.scene.log_with_meta(update, at),
            ArmsMessage::Tf(transforms) => self.tf.log_with_meta(transforms, at),
            ArmsMessage::Measured(states) => self.measured.log_with_meta(states, at),
            ArmsMessage::Planned(states) => self.planned.log_with_meta(states, at),
            ArmsMessage::Arms(state) => self.arms.log_with_meta(state, at),
            ArmsMessage::Log(line) => self.log.log_with_meta(line, at),
        }
    }
}
