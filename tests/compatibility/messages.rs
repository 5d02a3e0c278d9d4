//! Encoded messages: the descriptors still give every field its name, type and value, and the generated types preserve
//! all fields.

use std::collections::BTreeSet;
use std::path::Path;

use prost::Message;
use prost_reflect::{DescriptorPool, DynamicMessage};
use serde_json::Value;
use tandem_proto::pb;

fn samples(version: &Path) -> Vec<(String, Vec<u8>, String)> {
    let samples = super::read_json(&version.join("messages.json"));
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

/// A version in development may gain message types. The example `sample_files` writes samples of all types.
#[test]
fn the_corpus_contains_every_message_type() {
    let versions = super::versions();
    let samples = versions.iter().flat_map(|version| samples(version));
    let known: BTreeSet<String> = samples.map(|(name, ..)| name).collect();
    let pool = DescriptorPool::decode(tandem_proto::FILE_DESCRIPTOR_SET).expect("descriptors");
    let messages = pool.all_messages().filter(|message| message.package_name() == "tandem.v1");
    let names: BTreeSet<String> = messages.map(|message| message.name().to_owned()).collect();
    let missing: Vec<&String> = names.difference(&known).collect();
    assert!(!names.is_empty() && missing.is_empty(), "no version has samples of {missing:?}");
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
        AcceptedMotion, Account, AcquireRequest, AcquireResponse, AdviceTerms, AdviseRequest,
        AdviseResponse, ArmAdvice, ArmDescription, ArmManipulation, ArmMap, ArmMotion, ArmState,
        ArmWayPoint, BridgeLimits, BridgeStatusRequest, BridgeStatusResponse, BridgeStop,
        BridgeWayPoint, CheckRequest, CheckResponse, ClearFaults, Condition, DescribeBridgeRequest,
        DescribeBridgeResponse, DescribeEnvironmentRequest, DescribePolicyRequest, DescribeRequest,
        DescribeResponse, EnvironmentCheck, EnvironmentDescription, EnvironmentReset, Episode,
        EpisodeOrder, EvaluatePolicyRequest, EvaluatePolicyResponse, Evaluation, ExecuteRequest,
        ExecuteResponse, ExecuteStart, Exploration, FaultInjection, Finished, GetAccountRequest,
        GetParametersRequest, IndexRange, InjectRequest, InjectResponse, JoinRequest, JoinResponse,
        JointDescription, JointMotion, JointSample, Lease, MotionDone, MotionOutcome,
        MotionProgress, MotionRefusal, MotionRequest, MovedNumber, NextWorkRequest,
        NextWorkResponse, OpenAccountRequest, OpenLeasesRequest, OpenLeasesResponse, Parameters,
        PlayRequest, PlayResponse, PolicyDescription, Progress, Reflection, ReleaseRequest,
        ReleaseResponse, ResetEnvironments, ResetRequest, ResetResponse, RunTerms,
        SettleLeasesRequest, SignOfLife, Slot, StatusRequest, StepAdvice, StepEnvironments,
        StepQuery, StopRequest, StopResponse, SubmitEpisodesRequest, SubmitEpisodesResponse,
        TaskArm, TaskDescription, TaskFrameDescription, TaskManipulation, Wait, WatchRequest,
        WayPoints, WorkerProgress, WorldTerms
    }
}

fn again<M: Message + Default>(bytes: &[u8]) -> Vec<u8> {
    M::decode(bytes).expect("decodes").encode_to_vec()
}
