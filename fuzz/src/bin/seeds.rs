//! Writes the seed inputs of every fuzz target below the directory given on the command line.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

// Not called: the instrumentation of the build needs its symbols.
use libfuzzer_sys as _;
use mcap::records::{MessageHeader, Record};
use prost::Message as _;
use tandem_core::task::{ArmDescription, Manipulation, Norm, Reflection};
use tandem_core::work::{
    EpisodeExploration, EpisodeOrder, EpisodeStart, PublishedActor, RunTerms, SlotOrder,
};
use tandem_core::{
    AdviceTerms, ArmAdvice, Contacts, EpisodeKind, Exploration, Layout, StepAdvice, StepQuery,
    Task, TaskDescription, TaskSpec, WorldSettings,
};
use tandem_fuzz::sample;
use tandem_learner::checkpoint::{self, Resumption};
use tandem_learner::evaluation_store::{EvaluationHistory, PendingEvaluation};
use tandem_proto::environment::{encode_reset, encode_reset_reply, encode_step_reply};
use tandem_proto::pb;
use tandem_rl::trainer::Trainer;
use tandem_telemetry::MetricsRow;

type AnyError = Box<dyn std::error::Error>;

const LAYOUT: Layout = Layout::new(Task::Push, 1);

fn main() -> Result<(), AnyError> {
    let seeds = std::env::args_os().nth(1).map(PathBuf::from).ok_or("expected a directory")?;
    let scratch = tempfile::tempdir()?;
    for target in ["checkpoint", "policy", "onnx", "log", "message", "task"] {
        fs::create_dir_all(seeds.join(target))?;
    }
    write_checkpoints(&seeds.join("checkpoint"), scratch.path())?;
    write_policies(&seeds.join("policy"))?;
    write_models(&seeds.join("onnx"))?;
    write_logs(&seeds.join("log"), scratch.path())?;
    write_messages(&seeds.join("message"))?;
    write_tasks(&seeds.join("task"))
}

fn write_checkpoints(to: &Path, scratch: &Path) -> Result<(), AnyError> {
    for (name, trainer) in [("new", sample::trainer(0)), ("trained", sample::trainer(1))] {
        let saved = checkpoint::save(scratch, &trainer, &resumption(&trainer), 1)?;
        fs::rename(saved.path, to.join(name))?;
    }
    Ok(())
}

/// Returns the state that a run keeps besides its trainer during an evaluation.
fn resumption(trainer: &Trainer) -> Resumption {
    let policy = trainer.policy(BTreeMap::from([("name".to_owned(), "sample".to_owned())]));
    let row = MetricsRow { round: 1, success_per_arm: vec![0.5], ..MetricsRow::default() };
    let pending = PendingEvaluation {
        counters: trainer.counters(),
        stats: trainer.stats(),
        wall_s: 1.5,
        policy: policy.clone(),
    };
    Resumption {
        acting: trainer.publish(),
        history: EvaluationHistory {
            rows: vec![row],
            best: Some(policy.clone()),
            last: Some(policy),
        },
        pending: vec![pending],
        wall_s: 2.5,
        teacher_policy: Some("5f3a".repeat(16)),
        had_other_policy: false,
        account: None,
    }
}

fn write_policies(to: &Path) -> Result<(), AnyError> {
    let policy = sample::trainer(0).policy(BTreeMap::new());
    let path = to.join("with-digest");
    policy.save(&path)?;
    // Changed numbers are accepted without a digest, so that the fuzzer gets past the checksum.
    let file = fs::read(&path)?;
    let entry = format!(r#","digest":"{}""#, policy.digest());
    fs::write(to.join("without-digest"), without_header_text(&file, &entry)?)?;
    Ok(())
}

fn write_models(to: &Path) -> Result<(), AnyError> {
    let policy = sample::trainer(0).policy(BTreeMap::new());
    fs::write(to.join("actor"), tandem_onnx::export::actor(&policy)?)?;
    fs::write(to.join("critic"), tandem_onnx::export::critic(&policy)?)?;
    Ok(())
}

/// Returns the safetensors `file` without the first `text` in its header.
fn without_header_text(file: &[u8], text: &str) -> Result<Vec<u8>, AnyError> {
    let (length, rest) = file.split_first_chunk::<8>().ok_or("expected a header length")?;
    let (header, tensors) = rest.split_at(usize::try_from(u64::from_le_bytes(*length))?);
    let shorter = String::from_utf8(header.to_vec())?.replacen(text, "", 1);
    if shorter.len() == header.len() {
        return Err(format!("expected {text:?} in the header").into());
    }
    let length = (shorter.len() as u64).to_le_bytes();
    Ok([length.as_slice(), shorter.as_bytes(), tensors].concat())
}

fn write_logs(to: &Path, scratch: &Path) -> Result<(), AnyError> {
    let recorded = sample::record_episode(&scratch.join("episode.mcap"))?;
    let recorded = fs::read(recorded)?;
    let short = |compression| small_log(&recorded, compression);
    fs::write(to.join("uncompressed"), short(None)?)?;
    fs::write(to.join("zstd"), short(Some(mcap::Compression::Zstd))?)?;
    fs::write(to.join("lz4"), short(Some(mcap::Compression::Lz4))?)?;
    let whole = short(None)?;
    fs::write(to.join("cut-short"), &whole[..whole.len() / 2])?;
    Ok(())
}

/// Returns a log with the transitions, outcome and metadata of `log` only, without schemas and with no metadata
/// checksum.
fn small_log(log: &[u8], compression: Option<mcap::Compression>) -> Result<Vec<u8>, AnyError> {
    let options = mcap::WriteOptions::new().compression(compression).compression_threads(0);
    let mut writer = options.create(std::io::Cursor::new(Vec::new()))?;
    let mut channels = BTreeMap::new();
    for record in mcap::read::ChunkFlattener::new(log)? {
        match record? {
            Record::Metadata(mut metadata) => {
                metadata.metadata.remove("checksum");
                writer.write_metadata(&metadata)?;
            }
            Record::Channel(channel)
                if matches!(channel.topic.as_str(), "/transition" | "/outcome") =>
            {
                let id = writer.add_channel(0, &channel.topic, "protobuf", &BTreeMap::new())?;
                channels.insert(channel.id, id);
            }
            Record::Message { header, data } => {
                if let Some(channel_id) = channels.get(&header.channel_id) {
                    let header = MessageHeader { channel_id: *channel_id, ..header };
                    writer.write_to_known_channel(&header, &data)?;
                }
            }
            Record::DataEnd(_) => break,
            _ => {}
        }
    }
    writer.finish()?;
    Ok(writer.into_inner().into_inner())
}

fn write_messages(to: &Path) -> Result<(), AnyError> {
    let terms = RunTerms {
        symmetrized_evaluation: true,
        run: "run-7".to_owned(),
        task: LAYOUT.into(),
        account: Some("run-7".to_owned()),
        advice: AdviceTerms::default(),
        exploration: Exploration {
            noise_std: 0.2,
            random_action_prob: 0.3,
            sticky_random_mean_steps: 4.0,
            joint_random_actions: false,
        },
        world: WorldSettings::default(),
    };
    let order = EpisodeOrder {
        number: 64,
        seed: 42,
        advised: true,
        exploration: EpisodeExploration::Noise,
        record: true,
        advised_steps: None,
    };
    let kind = EpisodeKind::Evaluation;
    let slot = SlotOrder { slot: 3, parameter_version: 9, kind, episodes: vec![order] };
    let account = pb::OpenAccountRequest {
        name: "run-7".to_owned(),
        budget: 500_000,
        strategy: "mc-q:0.1".to_owned(),
    };
    let progress =
        pb::Progress { workers: vec![pb::WorkerProgress::default()], ..Default::default() };
    let query = tandem_proto::encode_query(&query());
    let asked = pb::AdviseRequest {
        account: "run-7".to_owned(),
        steps: vec![query.clone()],
        ..Default::default()
    };
    let actor: PublishedActor = sample::trainer(0).publish();
    let start = EpisodeStart { number: 3, seed: 42, kind, world: WorldSettings::default() };
    let seeds = [
        ("query", query.encode_to_vec()),
        ("advice", tandem_proto::encode_advice(&advice()).encode_to_vec()),
        ("terms", tandem_proto::encode_run_terms(&terms).encode_to_vec()),
        ("slot", tandem_proto::encode_slot(&slot).encode_to_vec()),
        ("parameters", tandem_proto::encode_actor(&actor).encode_to_vec()),
        ("episode", tandem_proto::encode_episode(&sample::episode(7)).encode_to_vec()),
        ("account", account.encode_to_vec()),
        ("progress", progress.encode_to_vec()),
        ("execute", execute_request().encode_to_vec()),
        ("advise", asked.encode_to_vec()),
        ("play", encode_reset(&[start]).encode_to_vec()),
        (
            "played",
            encode_step_reply(&[0.25; 56], &[Contacts::ARM_ARM, Contacts::NONE]).encode_to_vec(),
        ),
    ];
    for (message, (name, bytes)) in (0_u8..).zip(seeds) {
        fs::write(to.join(name), [&[message, 0], bytes.as_slice()].concat())?;
    }
    // A second message of the last type: the response to a reset of two environments.
    let started = encode_reset_reply(&[0.25; 56], &[0.5; 6]).encode_to_vec();
    fs::write(to.join("started"), [&[11, 0], started.as_slice()].concat())?;
    Ok(())
}

fn write_tasks(to: &Path) -> Result<(), AnyError> {
    // Two points whose numbers alternate, and which carry an object to a common goal.
    let arm = |arm_idx: usize| ArmDescription {
        lateral: Vec::new(),
        hand: Vec::new(),
        observation: vec![arm_idx, arm_idx + 2],
        goal: vec![arm_idx],
        action: vec![arm_idx],
        position: Vec::new(),
    };
    let carry = TaskDescription {
        base: 0.0,
        contact_distances: Vec::new(),
        name: "lab/carry".to_owned(),
        n_observation: 5,
        n_goal: 3,
        n_action: 2,
        arms: vec![arm(0), arm(1)],
        achieved_goal: vec![0, 1, 4],
        episode_steps: 20,
        tolerance: 0.1,
        norm: Norm::Maximum,
        interchangeable_arms: true,
        reports_contacts: false,
        origin_distance: 0.0,
        recombination_gap: 0.0,
        observation_bound: vec![2.0; 5],
        goal_bound: vec![1.0; 3],
        manipulation: Manipulation::default(),
        reflection: Reflection::default(),
    };
    let tasks = [
        ("push", TaskSpec::built_in(Task::Push, 2)),
        ("carry-bar", TaskSpec::built_in(Task::CarryBar, 2)),
        ("pick-and-place", TaskSpec::built_in(Task::PickAndPlace, 1)),
        ("carry", TaskSpec::new(carry)?),
    ];
    for (name, task) in tasks {
        fs::write(to.join(name), tandem_proto::encode_task(&task).encode_to_vec())?;
    }
    Ok(())
}

fn query() -> StepQuery {
    StepQuery {
        episode: 300,
        step: 7,
        observation: vec![0.25; LAYOUT.n_observation()],
        goal: vec![0.5; LAYOUT.n_goal()],
        proposed_action: vec![-1.0; LAYOUT.n_action()],
        judged_action: Some(vec![0.5; LAYOUT.n_action()]),
        payer: Some(300),
    }
}

fn advice() -> StepAdvice {
    let arm = ArmAdvice {
        teacher_action: vec![0.5; LAYOUT.n_action()],
        q_teacher: -1.5,
        q_student: -2.0,
        importance: 0.5,
        distance: 0.75,
        overridden: true,
    };
    StepAdvice {
        action: vec![0.5; LAYOUT.n_action()],
        charged: true,
        arms: vec![arm],
        repeated: false,
    }
}

fn execute_request() -> pb::ExecuteRequest {
    let sample = pb::JointSample {
        angles_rad: vec![0.5; 6],
        velocities_radps: vec![0.0; 6],
        ..Default::default()
    };
    let arm = pb::ArmMotion { samples: vec![sample] };
    let motion = pb::JointMotion { arms: vec![arm], ..Default::default() };
    let motion = pb::motion_request::Motion::JointMotion(motion);
    let motion = pb::MotionRequest { motion: Some(motion), ..Default::default() };
    let start = pb::ExecuteStart { motion: Some(motion), ..Default::default() };
    pb::ExecuteRequest { request: Some(pb::execute_request::Request::Start(start)) }
}
