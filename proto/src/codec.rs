//! The codec of servers.

use std::marker::PhantomData;

use prost::Message;
use prost::bytes::Buf as _;
use prost::encoding::{DecodeContext, WireType, decode_key, decode_varint, skip_field};
use tonic::Status;
use tonic::codec::{Codec, DecodeBuf, Decoder};
use tonic_prost::ProstEncoder;

use crate::pb;

/// The largest number of messages within a request, at any depth. An empty message takes two bytes there and about a
/// hundred once it is decoded, so the length of a request alone does not bound its memory. The longest joint motion of
/// a bridge has 120,002 samples.
const MAX_MESSAGES: usize = 131_072;

/// Decodes requests of type `U` and encodes responses of type `T`, as Protobuf.
///
/// A malformed request, or one of too many messages, is the client's error, so the status is `INVALID_ARGUMENT`.
/// Clients use `ProstCodec`, which reports a malformed response as `INTERNAL`.
#[derive(Debug)]
pub(crate) struct RequestCodec<T, U>(PhantomData<(T, U)>);

impl<T, U> Default for RequestCodec<T, U> {
    fn default() -> Self {
        Self(PhantomData)
    }
}

impl<T, U> Codec for RequestCodec<T, U>
where
    T: Message + Send + 'static,
    U: Message + MessageFields + Default + Send + 'static,
{
    type Encode = T;
    type Decode = U;
    type Encoder = ProstEncoder<T>;
    type Decoder = RequestDecoder<U>;

    fn encoder(&mut self) -> Self::Encoder {
        ProstEncoder::default()
    }

    fn decoder(&mut self) -> Self::Decoder {
        RequestDecoder(PhantomData)
    }
}

/// Decodes requests of type `U`.
#[derive(Debug)]
pub(crate) struct RequestDecoder<U>(PhantomData<U>);

impl<U: Message + MessageFields + Default> Decoder for RequestDecoder<U> {
    type Item = U;
    type Error = Status;

    fn decode(&mut self, buffer: &mut DecodeBuf<'_>) -> Result<Option<U>, Status> {
        let request = buffer.copy_to_bytes(buffer.remaining());
        decode_request(&request).map(Some)
    }
}

fn decode_request<U: Message + MessageFields + Default>(request: &[u8]) -> Result<U, Status> {
    let n_messages = count_messages::<U>(request);
    if n_messages > MAX_MESSAGES {
        let message = format!(
            "the request has too many messages: expected at most {MAX_MESSAGES}, got {n_messages}"
        );
        return Err(Status::invalid_argument(message));
    }
    let refused = |error| Status::invalid_argument(format!("the request is malformed: {error}"));
    U::decode(request).map_err(refused)
}

/// Counts the messages within an encoded message.
type Counter = fn(&[u8]) -> usize;

/// The fields of a message that are messages. No message contains itself, so the recursion over them is bounded.
pub(crate) trait MessageFields {
    /// Returns the counter for the message in field `tag`; `None` if the field is no message.
    fn counter(_tag: u32) -> Option<Counter> {
        None
    }
}

include!(concat!(env!("OUT_DIR"), "/message_fields.rs"));

/// Counts the messages within `message`, at any depth, up to the first malformed field of each.
fn count_messages<M: MessageFields>(mut message: &[u8]) -> usize {
    let mut n_messages = 0;
    while let Ok((tag, wire_type)) = decode_key(&mut message) {
        let counter = M::counter(tag).filter(|_| wire_type == WireType::LengthDelimited);
        n_messages += usize::from(counter.is_some());
        let rest = message;
        if skip_field(wire_type, tag, &mut message, DecodeContext::default()).is_err() {
            break;
        }
        if let Some(counter) = counter {
            let mut within = &rest[..rest.len() - message.len()];
            // The length precedes the message.
            n_messages += decode_varint(&mut within).map_or(0, |_| counter(within));
        }
    }
    n_messages
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pb::motion_request::Motion;
    use crate::pb::play_request::Command;

    fn advice(n_steps: usize) -> pb::AdviseRequest {
        pb::AdviseRequest { steps: vec![pb::StepQuery::default(); n_steps], ..Default::default() }
    }

    fn resets(n: usize) -> pb::PlayRequest {
        let environments = vec![pb::EnvironmentReset::default(); n];
        pb::PlayRequest { command: Some(Command::Reset(pb::ResetEnvironments { environments })) }
    }

    /// A motion of two arms with seven joints each.
    fn joint_motion(n_samples: usize) -> pb::CheckRequest {
        let joints = || vec![0.5; 7];
        let sample =
            pb::JointSample { angles_rad: joints(), velocities_radps: joints(), opening: 0.5 };
        let arms = vec![pb::ArmMotion { samples: vec![sample; n_samples] }; 2];
        let motion = Some(Motion::JointMotion(pb::JointMotion { period_s: 0.01, arms }));
        pb::CheckRequest { motion: Some(pb::MotionRequest { motion, speed: 1.0 }) }
    }

    /// A motion of one arm whose samples are empty.
    fn empty_samples(n: usize) -> pb::CheckRequest {
        let arms = vec![pb::ArmMotion { samples: vec![pb::JointSample::default(); n] }];
        let motion = Some(Motion::JointMotion(pb::JointMotion { period_s: 0.01, arms }));
        pb::CheckRequest { motion: Some(pb::MotionRequest { motion, speed: 1.0 }) }
    }

    #[test]
    fn a_small_request_cannot_become_large_in_memory() {
        fn check<U>(most: &U, more: &U)
        where
            U: Message + MessageFields + Default + PartialEq + std::fmt::Debug,
        {
            assert_eq!(decode_request::<U>(&most.encode_to_vec()).unwrap(), *most);
            let encoded = more.encode_to_vec();
            assert!(encoded.len() < 1 << 20);
            let refused = decode_request::<U>(&encoded).unwrap_err();
            let expected = "the request has too many messages: expected at most 131072, got 131073";
            let got = (refused.code(), refused.message());
            assert_eq!(got, (tonic::Code::InvalidArgument, expected));
        }
        check(&advice(MAX_MESSAGES), &advice(MAX_MESSAGES + 1));
        // The resets are within one message.
        check(&resets(MAX_MESSAGES - 1), &resets(MAX_MESSAGES));
        // The samples are within an arm's motion, the motion of joints and the motion.
        check(&empty_samples(MAX_MESSAGES - 3), &empty_samples(MAX_MESSAGES - 2));
    }

    #[test]
    fn the_largest_requests_are_decoded() {
        let motion = joint_motion(60_001);
        assert_eq!(decode_request::<pb::CheckRequest>(&motion.encode_to_vec()).unwrap(), motion);
        // Numbers are not read as messages, even if their bytes look like some.
        let episode = pb::Episode { observations: [0x0a, 0].repeat(100_000), ..Default::default() };
        let submission =
            pb::SubmitEpisodesRequest { episodes: vec![episode], ..Default::default() };
        let encoded = submission.encode_to_vec();
        assert_eq!(count_messages::<pb::SubmitEpisodesRequest>(&encoded), 1);
        assert_eq!(decode_request::<pb::SubmitEpisodesRequest>(&encoded).unwrap(), submission);
    }

    #[test]
    fn a_malformed_request_is_refused_by_its_first_fault() {
        let mut encoded = advice(2).encode_to_vec();
        encoded.push(0x12);
        assert_eq!(count_messages::<pb::AdviseRequest>(&encoded), 3, "the last one has no length");
        let refused = decode_request::<pb::AdviseRequest>(&encoded).unwrap_err();
        assert!(refused.message().starts_with("the request is malformed: "), "{refused}");
    }
}
