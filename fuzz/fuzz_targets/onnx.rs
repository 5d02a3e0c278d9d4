//! ONNX models: a file is refused, or holds a network that runs and, if it fits a policy, becomes one.
#![no_main]

use libfuzzer_sys::fuzz_target;
use tandem_fuzz::with_bounded_memory;
use tandem_onnx::binding::task_of;
use tandem_onnx::{BoundNetwork, Model, Role, import};

fuzz_target!(|file: &[u8]| {
    let Ok(model) = with_bounded_memory(|| Model::decode(file)) else { return };
    for role in [Role::Actor, Role::Critic] {
        let Ok(task) = task_of(&model, role) else { continue };
        let Ok(mut network) = BoundNetwork::new(&model, role, &task) else { continue };
        let (observation, goal) = (vec![0.5; task.n_observation()], vec![-0.5; task.n_goal()]);
        let mut output = vec![f32::NAN; model.network.n_output];
        network.run(&observation, &goal, &vec![0.25; task.n_action()], &mut output);
        if let Ok(policy) = import(&model, None, task) {
            policy.check().expect("an imported policy is valid");
        }
    }
});
