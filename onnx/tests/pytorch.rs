//! Models that PyTorch exported, with both of its exporters. `scripts/pytorch_onnx.py` wrote them.

use std::path::{Path, PathBuf};

use serde_json::Value;
use tandem_core::{Layout, Task};
use tandem_onnx::binding::task_of;
use tandem_onnx::{BoundNetwork, Model, Role, import};

const LAYOUT: Layout = Layout::new(Task::Push, 1);
const EXPORTERS: [&str; 2] = ["torchscript", "dynamo"];

fn directory() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/pytorch")
}

fn model(name: &str, exporter: &str) -> Model {
    Model::load(&directory().join(format!("{name}.{exporter}.onnx"))).expect("as exported")
}

/// The states for which PyTorch computed outputs.
struct Cases(Value);

impl Cases {
    fn read() -> Self {
        let text = std::fs::read_to_string(directory().join("cases.json")).expect("as exported");
        Self(serde_json::from_str(&text).expect("as exported"))
    }

    /// Returns the rows at a JSON pointer, concatenated.
    fn rows(&self, pointer: &str) -> Vec<f32> {
        let rows =
            self.0.pointer(pointer).expect("as exported").as_array().expect("as exported").iter();
        let numbers = rows.flat_map(|row| row.as_array().expect("as exported"));
        #[expect(clippy::cast_possible_truncation, reason = "the numbers are float32")]
        numbers.map(|number| number.as_f64().expect("as exported") as f32).collect()
    }

    fn check(&self, name: &str, what: &str, got: &[f32]) {
        let expected = self.rows(&format!("/outputs/{name}"));
        assert_eq!(got.len(), expected.len(), "{name}, {what}");
        for (got, expected) in got.iter().zip(expected) {
            assert!((got - expected).abs() < 1e-5, "{name}, {what}: {got} against {expected}");
        }
    }
}

#[test]
fn exported_actors_act_as_in_pytorch() {
    let cases = Cases::read();
    let (observations, goals) = (cases.rows("/observations"), cases.rows("/goals"));
    for name in ["sb3-actor", "normalized-tanh-actor", "scaled-actor"] {
        for exporter in EXPORTERS {
            let model = model(name, exporter);
            assert_eq!(
                task_of(&model, Role::Actor).expect("as exported"),
                LAYOUT.into(),
                "{name}, {exporter}"
            );
            let mut actor = BoundNetwork::new(&model, Role::Actor, LAYOUT).expect("as exported");
            let mut actions = cases.rows("/actions");
            actor.run(&observations, &goals, &[], &mut actions);
            cases.check(name, exporter, &actions);
        }
    }
}

#[test]
fn an_exported_critic_values_as_in_pytorch() {
    let cases = Cases::read();
    let (observations, goals) = (cases.rows("/observations"), cases.rows("/goals"));
    for exporter in EXPORTERS {
        let model = model("sb3-critic", exporter);
        let mut critic = BoundNetwork::new(&model, Role::Critic, LAYOUT).expect("as exported");
        let mut values = vec![0.0; goals.len() / LAYOUT.n_goal()];
        critic.run(&observations, &goals, &cases.rows("/actions"), &mut values);
        cases.check("sb3-critic", exporter, &values);
    }
}

#[test]
fn actors_with_relu_become_policies_that_act_and_value_the_same() {
    let cases = Cases::read();
    let (observations, goals) = (cases.rows("/observations"), cases.rows("/goals"));
    for exporter in EXPORTERS {
        let critic = model("sb3-critic", exporter);
        for name in ["sb3-actor", "scaled-actor"] {
            let policy =
                import(&model(name, exporter), Some(&critic), LAYOUT).expect("as exported");
            let mut actions = cases.rows("/actions");
            policy.actor().expect("as exported").act(&observations, &goals, &mut actions);
            cases.check(name, exporter, &actions);
            let mut values = vec![0.0; goals.len() / LAYOUT.n_goal()];
            let proposed = cases.rows("/actions");
            policy.critic().expect("as exported").q(&observations, &goals, &proposed, &mut values);
            cases.check("sb3-critic", exporter, &values);
        }
        let refusal = import(&model("normalized-tanh-actor", exporter), None, LAYOUT);
        let refusal = refusal.expect_err("tanh between layers").to_string();
        assert!(refusal.contains("Tanh follows hidden layer 1, expected Relu"), "{refusal}");
    }
}
