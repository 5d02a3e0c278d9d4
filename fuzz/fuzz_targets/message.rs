//! Messages: bytes are refused or decoded to a value that encodes to the same message.
//!
//! The first byte of the input chooses the message type, the second the task and the number of arms.
#![no_main]

use libfuzzer_sys::fuzz_target;
use prost::Message;
use tandem_core::task::MAX_ARMS;
use tandem_core::{Layout, Task};
use tandem_fuzz::with_bounded_memory;
use tandem_proto::environment::{decode_play_request, decode_reset_reply, decode_step_reply};
use tandem_proto::{DecodeError, pb};

/// Maximum length of an error message, which is sent in an HTTP/2 header.
const MAX_REFUSAL_BYTES: usize = 400;

fuzz_target!(|input: &[u8]| {
    let [message, layout, bytes @ ..] = input else { return };
    let task = Task::ALL[usize::from(*layout) % Task::ALL.len()];
    let layout = Layout::new(task, usize::from(*layout) / Task::ALL.len() % MAX_ARMS + 1);
    with_bounded_memory(|| read(*message, layout, bytes));
});

fn read(message: u8, layout: Layout, bytes: &[u8]) {
    match message % 12 {
        0 => check(bytes, |query: pb::StepQuery| {
            tandem_proto::decode_query(query, layout)
                .map(|query| tandem_proto::encode_query(&query))
        }),
        1 => check(bytes, |advice: pb::StepAdvice| {
            tandem_proto::decode_advice(advice, layout).map(|it| tandem_proto::encode_advice(&it))
        }),
        2 => check(bytes, |terms: pb::RunTerms| {
            // Terms of earlier versions have no advice terms, and are decoded to the default ones.
            let has_advice = terms.advice.is_some();
            let again = tandem_proto::encode_run_terms(&tandem_proto::decode_run_terms(terms)?);
            Ok(pb::RunTerms { advice: again.advice.filter(|_| has_advice), ..again })
        }),
        3 => check(bytes, |slot: pb::Slot| {
            tandem_proto::decode_slot(slot).map(|slot| tandem_proto::encode_slot(&slot))
        }),
        4 => check(bytes, |parameters: pb::Parameters| {
            tandem_proto::decode_actor(&parameters, layout)
                .map(|it| tandem_proto::encode_actor(&it))
        }),
        5 => check(bytes, |episode: pb::Episode| {
            tandem_proto::decode_episode(episode, layout)
                .map(|episode| tandem_proto::encode_episode(&episode))
        }),
        6 => check(bytes, |request: pb::OpenAccountRequest| {
            let name = tandem_proto::decode_account_name("name", request.name)?;
            Ok(pb::OpenAccountRequest { name, ..request })
        }),
        // Services create these messages themselves. Only their wire format is decoded here.
        7 => check(bytes, Ok::<pb::Progress, DecodeError>),
        8 => check(bytes, Ok::<pb::ExecuteRequest, DecodeError>),
        // Decoders of streams check a message against the environments of the stream.
        10 => check(bytes, |request: pb::PlayRequest| {
            decode_play_request(request.clone(), Some(2), &layout.into())?;
            Ok(request)
        }),
        11 => check(bytes, |reply: pb::PlayResponse| {
            let task = layout.into();
            let is_reset = !reply.goals.is_empty();
            match is_reset {
                true => decode_reset_reply(&reply, 2, &task).map(drop),
                false => decode_step_reply(&reply, 2, &task).map(drop),
            }?;
            Ok(reply)
        }),
        _ => check(bytes, Ok::<pb::AdviseRequest, DecodeError>),
    }
}

/// Decodes `bytes` as a message, and again what `convert` makes of it. Both must be the same message.
fn check<M: Message + Default + Clone>(
    bytes: &[u8],
    convert: impl Fn(M) -> Result<M, DecodeError>,
) {
    let Ok(message) = M::decode(bytes) else { return };
    let encoded = message.encode_to_vec();
    let again = M::decode(encoded.as_slice()).expect("what was encoded can be decoded");
    assert_eq!(again.encode_to_vec(), encoded);
    match convert(message) {
        Ok(converted) => assert_eq!(converted.encode_to_vec(), encoded),
        Err(refusal) => {
            let text = refusal.to_string();
            assert!(!refusal.field.is_empty() && text.len() < MAX_REFUSAL_BYTES, "{text}");
        }
    }
}
