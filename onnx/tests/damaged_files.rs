//! Damaged models: every one is refused or gives a network that runs.

use std::path::{Path, PathBuf};

use tandem_onnx::binding::task_of;
use tandem_onnx::{BoundNetwork, Model, Role, import};

fn file(name: &str) -> Vec<u8> {
    let directory: PathBuf = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/pytorch");
    std::fs::read(directory.join(name)).expect("as exported")
}

/// Decodes `file` and uses the network, if there is one. Returns true if there is.
fn is_usable(file: &[u8]) -> bool {
    let Ok(model) = Model::decode(file) else { return false };
    for role in [Role::Actor, Role::Critic] {
        let Ok(task) = task_of(&model, role) else { continue };
        let Ok(mut network) = BoundNetwork::new(&model, role, &task) else { continue };
        let (observation, goal) = (vec![0.5; task.n_observation()], vec![-0.5; task.n_goal()]);
        let mut output = vec![0.0; model.network.n_output];
        network.run(&observation, &goal, &vec![0.25; task.n_action()], &mut output);
        if let Ok(policy) = import(&model, None, task) {
            policy.check().expect("an imported policy is valid");
        }
    }
    true
}

#[test]
fn a_truncated_model_is_refused() {
    for name in ["sb3-actor.dynamo.onnx", "scaled-actor.torchscript.onnx"] {
        let whole = file(name);
        assert!(is_usable(&whole), "{name}");
        let usable = (0..whole.len()).filter(|length| is_usable(&whole[..*length])).count();
        // Only metadata after the last required field may be missing, up to the end of any entry.
        assert!(usable <= 4, "{name}: {usable} truncations are usable");
    }
}

#[test]
fn no_changed_byte_makes_a_model_panic() {
    for name in ["sb3-actor.dynamo.onnx", "normalized-tanh-actor.torchscript.onnx"] {
        let whole = file(name);
        let n_usable = (0..whole.len())
            .flat_map(|at| [0x01_u8, 0x10, 0x80, 0xff].map(|bits| (at, bits)))
            .filter(|(at, bits)| {
                let mut changed = whole.clone();
                changed[*at] ^= bits;
                is_usable(&changed)
            })
            .count();
        // Most bytes are weights: nearly any other number is as good.
        assert!(n_usable > 2 * whole.len(), "{name}: {n_usable} of {}", 4 * whole.len());
    }
}
