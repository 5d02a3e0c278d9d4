//! The codec of servers.

use std::marker::PhantomData;

use prost::Message;
use prost::bytes::Buf as _;
use prost::encoding::{DecodeContext, WireType, decode_key, skip_field};
use tonic::Status;
use tonic::codec::{Codec, DecodeBuf, Decoder};
use tonic_prost::ProstEncoder;

/// The largest number of messages, texts and vectors directly in a request. An empty message takes two bytes there and
/// about a hundred once it is decoded, so the length of a request alone does not bound its memory.
const MAX_PARTS: usize = 65_536;

/// Decodes requests of type `U` and encodes responses of type `T`, as Protobuf.
///
/// A malformed request, or one of too many parts, is the client's error, so the status is `INVALID_ARGUMENT`. Clients
/// use `ProstCodec`, which reports a malformed response as `INTERNAL`.
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
    U: Message + Default + Send + 'static,
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

impl<U: Message + Default> Decoder for RequestDecoder<U> {
    type Item = U;
    type Error = Status;

    fn decode(&mut self, buffer: &mut DecodeBuf<'_>) -> Result<Option<U>, Status> {
        let request = buffer.copy_to_bytes(buffer.remaining());
        decode_request(&request).map(Some)
    }
}

fn decode_request<U: Message + Default>(request: &[u8]) -> Result<U, Status> {
    let n_parts = count_parts(request);
    if n_parts > MAX_PARTS {
        let message =
            format!("the request has too many parts: expected at most {MAX_PARTS}, got {n_parts}");
        return Err(Status::invalid_argument(message));
    }
    let refused = |error| Status::invalid_argument(format!("the request is malformed: {error}"));
    U::decode(request).map_err(refused)
}

/// Counts the messages, texts and vectors directly in `request`, up to the first malformed field.
fn count_parts(mut request: &[u8]) -> usize {
    let mut n_parts = 0;
    while let Ok((tag, wire_type)) = decode_key(&mut request) {
        n_parts += usize::from(wire_type == WireType::LengthDelimited);
        if skip_field(wire_type, tag, &mut request, DecodeContext::default()).is_err() {
            break;
        }
    }
    n_parts
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pb;

    fn request(n_steps: usize) -> pb::AdviseRequest {
        pb::AdviseRequest { steps: vec![pb::StepQuery::default(); n_steps], ..Default::default() }
    }

    #[test]
    fn a_small_request_cannot_become_large_in_memory() {
        let most = request(MAX_PARTS);
        assert_eq!(decode_request::<pb::AdviseRequest>(&most.encode_to_vec()).unwrap(), most);
        let encoded = request(MAX_PARTS + 1).encode_to_vec();
        assert!(encoded.len() < 1 << 20);
        let refused = decode_request::<pb::AdviseRequest>(&encoded).unwrap_err();
        let expected = "the request has too many parts: expected at most 65536, got 65537";
        assert_eq!((refused.code(), refused.message()), (tonic::Code::InvalidArgument, expected));
    }

    #[test]
    fn a_malformed_request_is_refused_by_its_first_fault() {
        let mut encoded = request(2).encode_to_vec();
        encoded.push(0x0a);
        assert_eq!(count_parts(&encoded), 3, "the last one has no length");
        let refused = decode_request::<pb::AdviseRequest>(&encoded).unwrap_err();
        assert!(refused.message().starts_with("the request is malformed: "), "{refused}");
    }
}
