//! Policies that go to ONNX and back on the command line, and runs whose teacher is an ONNX model.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;
use tandem_core::TaskSpec;
use tandem_core::task::Reflection;
use tandem_policy::{MlpShape, Policy};

const TEACHER: &str = "policies/teacher-push.safetensors";
/// An actor that PyTorch exported, with tanh between its layers.
const FOREIGN: &str = "onnx/tests/pytorch/normalized-tanh-actor.dynamo.onnx";

fn tandem(args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
    command.args(args).current_dir(env!("CARGO_MANIFEST_DIR")).output().expect("runs")
}

/// Runs a command that must succeed, and returns the JSON object on the last line of its output.
fn json(args: &[&str]) -> Value {
    let ended = tandem(args);
    assert!(ended.status.success(), "{args:?}: {}", String::from_utf8_lossy(&ended.stderr));
    let output = String::from_utf8(ended.stdout).expect("text");
    serde_json::from_str(output.lines().last().expect("a line")).expect("JSON")
}

/// Runs a command that must fail with `code` and one line that contains `expected`.
fn refused(args: &[&str], code: i32, expected: &str) {
    let ended = tandem(args);
    let line = String::from_utf8_lossy(&ended.stderr).into_owned();
    assert_eq!(ended.status.code(), Some(code), "{args:?}: {line}");
    assert!(line.contains(expected) && line.lines().count() == 1, "{line:?} lacks {expected:?}");
}

struct Files(tempfile::TempDir);

impl Files {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("a directory"))
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn name(&self, name: &str) -> String {
        self.path(name).to_str().expect("UTF-8").to_owned()
    }

    /// Exports the shipped teacher.
    fn export(&self) -> [String; 2] {
        let [actor, critic] = [self.name("actor.onnx"), self.name("critic.onnx")];
        json(&["policy", "export", TEACHER, "--onnx", &actor, "--critic-onnx", &critic, "--json"]);
        [actor, critic]
    }
}

#[test]
fn a_policy_comes_back_from_onnx_as_it_went() {
    let files = Files::new();
    let [actor, critic] = files.export();
    let shown = json(&["policy", "show", &actor, "--json"]);
    assert_eq!(shown["role"], "actor");
    assert_eq!(shown["metadata"]["success_rate"], "0.9958333333333333");
    assert!(shown["metadata"]["success_rate_low"].as_str() < Some("0.98"), "{shown}");
    let parts: Value =
        serde_json::from_str(shown["metadata"]["observation"].as_str().expect("text"))
            .expect("JSON");
    assert_eq!(parts[1]["name"], "object_position");
    assert_eq!((&parts[1]["start"], &parts[1]["end"]), (&3.into(), &6.into()));

    let back = files.name("back.safetensors");
    let imported =
        json(&["policy", "import", &actor, "--critic", &critic, "--out", &back, "--json"]);
    let original = json(&["policy", "show", TEACHER, "--json"]);
    assert_eq!(imported["digest"], original["digest"]);
    let shown = json(&["policy", "show", &back, "--json"]);
    assert_eq!(shown["metadata"]["env_steps"], original["metadata"]["env_steps"]);
}

#[test]
fn a_policy_of_a_wide_task_goes_to_onnx() {
    let files = Files::new();
    let mut policy = Policy::load(Path::new(TEACHER)).expect("shipped");
    let mut description = policy.task.description().clone();
    description.name = "lab/wide".to_owned();
    description.reflection = Reflection::default();
    let n_added = 1100 - description.n_observation;
    description.n_observation = 1100;
    description.observation_bound.resize(1100, 1.0);
    // The added numbers, which belong to no arm, follow the others, and have the weight 0.
    let widened = |shape: MlpShape, parameters: &[f32], n_goal_and_action: usize| {
        let n_in = shape.layer_input(0);
        let rows = parameters[shape.weight(0)].chunks(n_in);
        let mut wide: Vec<f32> = Vec::new();
        for row in rows {
            let (observation, rest) = row.split_at(n_in - n_goal_and_action);
            wide.extend(observation.iter().chain(&vec![0.0; n_added]).chain(rest));
        }
        wide.extend(&parameters[shape.weight(0).end..]);
        wide
    };
    let n_goal = policy.task.n_goal();
    policy.actor = widened(policy.actor_shape(), &policy.actor, n_goal);
    let n_rest = n_goal + policy.task.n_action();
    policy.critic = widened(policy.critic_shape(), &policy.critic, n_rest);
    policy.observation_normalizer.mean.resize(1100, 0.0);
    policy.observation_normalizer.std.resize(1100, 1.0);
    policy.task = TaskSpec::new(description).expect("consistent");
    let wide = files.name("wide.safetensors");
    policy.save(Path::new(&wide)).expect("valid");

    let [actor, critic, back] = ["a.onnx", "c.onnx", "b.safetensors"].map(|name| files.name(name));
    json(&["policy", "export", &wide, "--onnx", &actor, "--critic-onnx", &critic, "--json"]);
    let import = ["policy", "import", &actor, "--critic", &critic, "--out", &back, "--json"];
    assert_eq!(json(&import)["digest"], policy.digest());
}

#[test]
fn a_symmetrised_policy_has_no_result_of_an_evaluation() {
    let files = Files::new();
    let [student, out] =
        ["student.safetensors", "symmetrised.safetensors"].map(|name| files.name(name));
    let mut policy = Policy::load(Path::new("policies/student-push.safetensors")).expect("shipped");
    policy.metadata.remove("symmetrized");
    policy.save(Path::new(&student)).expect("valid");
    let student = student.as_str();
    assert!(tandem(&["policy", "symmetrize", student, "--out", &out]).status.success());
    let metadata = |file: &str| json(&["policy", "show", file, "--json"])["metadata"].clone();
    let (before, after) = (metadata(student), metadata(&out));
    assert!(before["evaluation_success"].is_string() && after["evaluation_success"].is_null());
    assert!(after["evaluation_episodes"].is_null());
    assert_eq!(before["evaluation_seed"], after["evaluation_seed"]);
    refused(&["policy", "symmetrize", student, "--out", student], 64, "is the same file");
}

#[test]
fn a_network_from_elsewhere_takes_the_task_of_a_server() {
    let files = Files::new();
    let import = |more: &[&str]| {
        let out = files.name("policy.safetensors");
        let args = ["policy", "import", "onnx/tests/pytorch/sb3-actor.dynamo.onnx", "--out", &out];
        json(&[&args[..], &["--json"], more].concat())
    };
    assert_eq!(import(&[])["task"], "push");
    let program = env!("CARGO_BIN_EXE_tandem");
    let server = format!("exec '{program}' env --task push --arms 1");
    assert_eq!(import(&["--env-command", &server])["task"], "shared-push");
}

#[test]
fn what_cannot_be_converted_is_refused_in_one_line() {
    let files = Files::new();
    let [actor, critic] = files.export();
    let out = files.name("out.safetensors");
    refused(
        &["policy", "import", FOREIGN, "--out", &out],
        65,
        "Tanh follows hidden layer 1, expected Relu (`tandem teacher` can serve the model itself)",
    );
    let pick = ["--task", "pick-and-place", "--arms", "1", "--out", &out];
    refused(
        &[&["policy", "import", &actor][..], &pick].concat(),
        65,
        "it has 3 numbers, an action of shared-pick-and-place with 1 arm has 4",
    );
    refused(&["policy", "import", TEACHER, "--out", &out], 65, "it is not a complete ONNX file");
    refused(
        &["policy", "import", &actor, "--critic", FOREIGN, "--out", &out],
        65,
        "normalized-tanh-actor.dynamo.onnx\" is not a usable ONNX model",
    );
    let bar = ["--task", "carry-bar", "--arms", "1", "--out", &out];
    refused(&[&["policy", "import", &actor][..], &bar].concat(), 64, "carry-bar takes two arms");
    refused(&["eval", "--policy", &actor], 64, "is an ONNX model: convert it with `tandem policy");
    refused(&["policy", "export", TEACHER, "--onnx", "/no/such/actor.onnx"], 64, "cannot write");
    let twice = ["teacher", "--ledger", "memory", "--policy", &actor, "--critic", &actor];
    refused(&twice, 64, "is not a critic");
    json(&["policy", "import", &actor, "--out", &out, "--json"]);
    refused(&["policy", "export", &out, "--critic-onnx", &critic], 64, "has no critic");
    refused(
        &["train", "--teacher", &out, "--out", &files.name("run")],
        64,
        "strategy mc-q:0.1 compares values of actions, and the teacher's policy has no critic",
    );
    refused(
        &["train", "--teacher", FOREIGN, "--out", &files.name("run")],
        64,
        "is a teacher for push, the run is for shared-push: its file names no task and was taken for the one that its \
         vectors fit, so add the metadata \"task\" and \"n_arms\", or convert it with `tandem policy import`",
    );
    let pick = ["train", "--task", "pick-and-place", "--teacher", &actor, "--out"];
    let refusal = tandem(&[&pick[..], &[&files.name("run")]].concat());
    let line = String::from_utf8_lossy(&refusal.stderr).into_owned();
    assert!(line.trim_end().ends_with("the run is for shared-pick-and-place"), "{line}");
    assert!(!files.path("run").exists(), "a refused run leaves no directory");
}

/// Trains a run that is too short to learn anything.
fn train(out: &Path, more: &[&str]) -> Value {
    let out = out.to_str().expect("UTF-8");
    let mut args = vec!["train", "--out", out, "--workers", "1", "--json"];
    args.extend(more);
    json(&args)
}

const SMALL: [&str; 14] = [
    "--set",
    "rounds.updates_per_env_step=0.01",
    "--set",
    "rounds.warmup_env_steps=0",
    "--set",
    "evaluation.every_env_steps=800",
    "--set",
    "evaluation.episodes=4",
    "--set",
    "evaluation.test_episodes=4",
    "--set",
    "ddpg.n_hidden=16",
    "--set",
    "ddpg.cooldown_share=0",
];

#[test]
fn onnx_models_advise_as_the_policy_file_and_are_kept_for_a_resume() {
    let files = Files::new();
    let [actor, critic] = files.export();
    let steps = ["--max-env-steps", "800"];
    let models = ["--teacher", &actor, "--teacher-critic", &critic, "--strategy", "mc-act:0.5"];
    let out = files.path("run");
    let summary = train(&out, &[&models[..], &steps, &SMALL].concat());
    assert!(summary["advice_spent"].as_u64() > Some(0), "{summary}");
    let copy = |name: &str| fs::read(out.join("policy").join(name)).expect(name);
    assert_eq!(copy("teacher.onnx"), fs::read(&actor).expect("readable"));
    assert_eq!(copy("teacher-critic.onnx"), fs::read(&critic).expect("readable"));

    fs::remove_file(&actor).expect("removed");
    let summary = train(&out, &["--resume", "--max-env-steps", "1600"]);
    assert!(summary["env_steps"].as_u64() >= Some(1600), "{summary}");
    let out = out.to_str().expect("UTF-8");
    refused(
        &["train", "--resume", "--out", out, "--max-env-steps", "2400", "--teacher", TEACHER],
        64,
        "is another policy: leave --teacher out, or start a new run",
    );
}

#[test]
fn a_network_with_tanh_layers_advises_by_its_actions() {
    let files = Files::new();
    let out = files.path("run");
    let teacher =
        ["--world", "classic", "--teacher", FOREIGN, "--strategy", "ea", "--max-env-steps", "800"];
    let summary = train(&out, &[&teacher[..], &SMALL].concat());
    assert!(summary["advice_spent"].as_u64() > Some(0), "{summary}");
    assert!(!out.join("policy/teacher-critic.onnx").exists());
}
