//! Encoded messages: the descriptors still give every field its name, type and value, and the generated types preserve
//! all fields.

use std::path::Path;

use prost::Message;
use prost_reflect::{DescriptorPool, DynamicMessage};
use serde_json::Value;
use tandem_proto::pb;

fn samples(version: &Path) -> Vec<(String, Vec<u8>, String)> {
    let samples = super::json(&version.join("messages.json"));
    let text = |sample: &Value, key: &str| sample[key].as_str().expect("a text").to_owned();
    let samples = samples.as_array().expect("a list").iter();
    let read = |it| (text(it, "message"), from_hex(&text(it, "bytes")), text(it, "content"));
    samples.map(read).collect()
}

fn from_hex(text: &str) -> Vec<u8> {
    let byte = |pair: &[u8]| {
        let digits = str::from_utf8(pair).expect("ASCII");
        u8::from_str_radix(digits, 16).expect("hexadecimal digits")
    };
    text.as_bytes().chunks(2).map(byte).collect()
}

#[test]
fn every_field_of_every_message_keeps_its_meaning() {
    let pool = DescriptorPool::decode(tandem_proto::FILE_DESCRIPTOR_SET).expect("descriptors");
    for (name, bytes, content) in super::versions().iter().flat_map(|version| samples(version)) {
        let message = pool.get_message_by_name(&format!("tandem.v1.{name}"));
        let message = message.unwrap_or_else(|| panic!("message {name} is gone"));
        let decoded = DynamicMessage::decode(message, bytes.as_slice()).expect("decodes");
        assert_eq!(decoded.to_text_format(), content, "message {name}");
    }
}

#[test]
fn generated_types_keep_every_field() {
    for (name, bytes, _) in super::versions().iter().flat_map(|version| samples(version)) {
        let again = read_and_write(&name, &bytes);
        assert_eq!(again, bytes, "message {name}");
    }
}

/// Decodes and encodes `bytes` as the generated type called `name`.
fn read_and_write(name: &str, bytes: &[u8]) -> Vec<u8> {
    macro_rules! one_of {
        ($($message:ident),* $(,)?) => {
            match name {
                $(stringify!($message) => again::<pb::$message>(bytes),)*
                _ => panic!("message {name} is not listed here"),
            }
        };
    }
    one_of! {
        AcceptedMotion, Account, AcquireRequest, AcquireResponse, AdviseRequest, AdviseResponse,
        ArmAdvice, ArmDescription, ArmMap, ArmMotion, ArmState, ArmWayPoint, BridgeLimits,
        BridgeStatusRequest, BridgeStatusResponse, BridgeStop, BridgeWayPoint, CheckRequest,
        CheckResponse, DescribeBridgeRequest, DescribeBridgeResponse, DescribeRequest,
        DescribeResponse, Episode, EpisodeOrder, Evaluation, ExecuteRequest, ExecuteResponse,
        ExecuteStart, Exploration, Finished, GetAccountRequest, GetParametersRequest,
        IndexRange, JoinRequest, JoinResponse, JointDescription, JointMotion, JointSample,
        Lease, MotionDone, MotionOutcome, MotionProgress, MotionRefusal, MotionRequest,
        NextWorkRequest, NextWorkResponse, OpenAccountRequest, OpenLeasesRequest,
        OpenLeasesResponse, Parameters, Progress, ReleaseRequest, ReleaseResponse, ResetRequest,
        ResetResponse, RunTerms, SettleLeasesRequest, SignOfLife, Slot, StatusRequest,
        StepAdvice, StepQuery, StopRequest, StopResponse, SubmitEpisodesRequest,
        SubmitEpisodesResponse, TaskFrameDescription, Wait, WatchRequest, WayPoints,
        WorkerProgress, WorldTerms
    }
}

fn again<M: Message + Default>(bytes: &[u8]) -> Vec<u8> {
    M::decode(bytes).expect("decodes").encode_to_vec()
}
