//! Policies that survive export and import, and networks that are brought to a policy's form.

use std::path::Path;

use serde_json::json;
use tandem_core::rng::uniform;
use tandem_core::{Layout, Stream, Task, TaskDescription, episode_rng};

use super::*;
use crate::export;
use crate::network::{Column, Input, Layer, Network, Op, Step};

const LAYOUT: Layout = Layout::new(Task::Push, 1);

fn shipped(name: &str) -> Policy {
    let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("../policies");
    Policy::load(&directory.join(format!("{name}.safetensors"))).unwrap()
}

#[test]
fn a_policy_that_is_exported_and_imported_has_the_same_digest() {
    for name in [
        "teacher-push-classic",
        "student-push-classic",
        "teacher-pick-and-place-classic",
        "student-pick-and-place-classic",
    ] {
        let policy = shipped(name);
        let actor = Model::decode(&export::actor(&policy).unwrap()).unwrap();
        let critic = Model::decode(&export::critic(&policy).unwrap()).unwrap();
        assert_eq!(crate::binding::task_of(&actor, Role::Actor).unwrap(), policy.task);
        let imported = import(&actor, Some(&critic), &policy.task).unwrap();
        assert_eq!(imported.digest(), policy.digest(), "{name}");
        let kept =
            policy.metadata.iter().all(|(key, value)| imported.metadata.get(key) == Some(value));
        assert!(kept, "{name}: the metadata is restored");
        assert_eq!(imported.metadata["imported_critic"], critic.digest);
    }
}

#[test]
fn a_model_of_a_task_that_is_not_built_in_describes_it() {
    let mut policy = shipped("teacher-push-classic");
    let description =
        TaskDescription { name: "lab/reach".to_owned(), tolerance: 0.1, ..LAYOUT.description() };
    policy.task = TaskSpec::new(description).unwrap();
    let mut actor = Model::decode(&export::actor(&policy).unwrap()).unwrap();
    let task = |actor: &Model| crate::binding::task_of(actor, Role::Actor);
    assert_eq!(task(&actor).unwrap(), policy.task);
    assert!(!actor.metadata.contains_key("control_step_s"), "unknown of another task");

    let built_in = Model::decode(&export::actor(&shipped("teacher-push-classic")).unwrap());
    assert!(!built_in.unwrap().metadata.contains_key(metadata::TASK_DESCRIPTION));

    let without = |key: &str| {
        let mut actor = Model::decode(&export::actor(&shipped("teacher-push")).unwrap()).unwrap();
        actor.metadata.remove(key);
        task(&actor).unwrap_err().to_string()
    };
    let missing = |present: &str, missing: &str| {
        format!("metadata {present:?} is present, {missing:?} is missing")
    };
    assert_eq!(without(metadata::N_ARMS), missing(metadata::TASK, metadata::N_ARMS));
    assert_eq!(without(metadata::TASK), missing(metadata::N_ARMS, metadata::TASK));

    for (text, problem) in [
        ("{}", "missing field"),
        (&json!(policy.task.description()).to_string().replace("0.1", "-1.0"), "tolerance"),
    ] {
        actor.metadata.insert(metadata::TASK_DESCRIPTION.to_owned(), text.to_owned());
        let message = task(&actor).unwrap_err().to_string();
        assert!(message.contains("expected the description of a task: "), "{message}");
        assert!(message.contains(problem), "{message}");
    }
}

#[test]
fn a_model_names_the_duration_of_a_control_step_of_its_world() {
    for (name, step_s) in [("teacher-push-classic", "0.04"), ("teacher-push", "0.25")] {
        let actor = Model::decode(&export::actor(&shipped(name)).unwrap()).unwrap();
        assert_eq!(actor.metadata["control_step_s"], step_s, "{name}");
    }
}

#[test]
fn a_policy_without_a_critic_says_so_and_values_nothing() {
    let policy = shipped("teacher-push-classic");
    let actor = Model::decode(&export::actor(&policy).unwrap()).unwrap();
    let imported = import(&actor, None, &policy.task).unwrap();
    assert_eq!(imported.actor, policy.actor);
    assert!(!imported.has_critic() && policy.has_critic());
    assert!(imported.critic.iter().all(|weight| *weight == 0.0));
    assert!(!imported.metadata.contains_key("seed"), "another policy than the exported one");
}

/// Returns layers of the given sizes with arbitrary numbers, and Relu between them.
fn steps(sizes: &[usize], last: Option<Op>, seed: u64) -> Vec<Step> {
    let mut rng = episode_rng(seed, 0, Stream::Initialisation);
    let mut steps = Vec::new();
    for (idx, pair) in sizes.windows(2).enumerate() {
        let mut draw = |n: usize| (0..n).map(|_| uniform(&mut rng, -0.4, 0.4)).collect::<Vec<_>>();
        let layer = Layer { weight: draw(pair[0] * pair[1]), bias: draw(pair[1]) };
        steps.push(Step::Layer(layer));
        if idx + 2 < sizes.len() {
            steps.push(Step::Each(vec![Op::Relu; pair[1]]));
        }
    }
    steps.extend(last.map(|op| Step::Each(vec![op; sizes[sizes.len() - 1]])));
    steps
}

fn model(inputs: &[(&str, usize)], ops: &[Op], steps: Vec<Step>) -> Model {
    let inputs: Vec<Input> = inputs
        .iter()
        .map(|(name, width)| Input { name: (*name).to_owned(), width: *width })
        .collect();
    let column = |input, index| Column { input, index, ops: ops.to_vec() };
    let widths = inputs.iter().map(|input| input.width).enumerate();
    let columns =
        widths.flat_map(|(input, width)| (0..width).map(move |index| column(input, index)));
    let columns = columns.collect();
    let last = steps.iter().rev().find_map(|step| match step {
        Step::Layer(layer) => Some(layer.bias.len()),
        Step::Each(_) => None,
    });
    Model {
        network: Network {
            inputs,
            output: "out".to_owned(),
            n_output: last.unwrap(),
            columns,
            steps,
        },
        metadata: BTreeMap::new(),
        producer: String::new(),
        ir_version: 8,
        opset: 17,
        digest: String::new(),
    }
}

/// Compares the models with their policy on random states, up to 1000 times the unit.
fn assert_same(actor: &Model, critic: &Model, policy: &Policy) {
    const N_ROWS: usize = 40;
    let task = &policy.task;
    let mut rng = episode_rng(9, 0, Stream::Reset);
    let mut draw = |n: usize, scale: f32| -> Vec<f32> {
        (0..N_ROWS * n).map(|_| uniform(&mut rng, -scale, scale)).collect()
    };
    for scale in [0.5, 20.0, 1000.0] {
        let (observations, goals) = (draw(task.n_observation(), scale), draw(task.n_goal(), scale));
        let actions = draw(task.n_action(), 1.0);
        let check = |what: &str, got: &[f32], expected: &[f32]| {
            for (got, expected) in got.iter().zip(expected) {
                let tolerance = 2e-5 * expected.abs().max(1.0);
                assert!((got - expected).abs() < tolerance, "{what} at {scale}: {got}, {expected}");
            }
        };
        let mut expected = vec![0.0; actions.len()];
        let mut got = expected.clone();
        let mut bound = BoundNetwork::new(actor, Role::Actor, task).unwrap();
        bound.run(&observations, &goals, &[], &mut expected);
        policy.actor().unwrap().act(&observations, &goals, &mut got);
        check("action", &got, &expected);
        let mut expected = vec![0.0; N_ROWS * policy.n_heads];
        let mut got = expected.clone();
        let mut bound = BoundNetwork::new(critic, Role::Critic, task).unwrap();
        bound.run(&observations, &goals, &actions, &mut expected);
        policy.critic().unwrap().q(&observations, &goals, &actions, &mut got);
        check("value", &got, &expected);
    }
}

#[test]
fn networks_of_other_sizes_are_padded() {
    let actor = model(&[("obs", 31)], &[], steps(&[31, 20, 9, 3], Some(Op::Tanh), 1));
    let critic = model(&[("obs", 31), ("action", 3)], &[], steps(&[34, 12, 7, 16, 5, 1], None, 2));
    let policy = import(&actor, Some(&critic), LAYOUT).unwrap();
    assert_eq!((policy.n_hidden, policy.n_hidden_layers), (20, 4));
    assert_same(&actor, &critic, &policy);
}

#[test]
fn other_clips_and_repeated_inputs_become_a_policys_normalisation() {
    let inputs = [("achieved_goal", 3), ("desired_goal", 3), ("observation", 28)];
    let ops = [Op::Sub(0.25), Op::Div(0.5), Op::Clip(-10.0, 10.0), Op::Mul(0.75), Op::Add(0.125)];
    let actor = model(&inputs, &ops, steps(&[34, 8, 3], Some(Op::Tanh), 3));
    let critic = model(&inputs, &ops, steps(&[34, 8, 1], None, 4));
    let policy = import(&actor, Some(&critic), LAYOUT).unwrap();
    assert_eq!((policy.goal_normalizer.mean[0], policy.goal_normalizer.std[0]), (0.25, 1.0));
    assert_same(&actor, &critic, &policy);
}

#[test]
fn wide_clips_and_wide_observations_are_kept() {
    let mut policy = shipped("teacher-push-classic");
    policy.observation_normalizer.std[0] = 300.0;
    let actor = Model::decode(&export::actor(&policy).unwrap()).unwrap();
    let critic = Model::decode(&export::critic(&policy).unwrap()).unwrap();
    assert_eq!(import(&actor, Some(&critic), LAYOUT).unwrap().digest(), policy.digest());

    let mut description = TaskDescription { name: "lab/mm".to_owned(), ..LAYOUT.description() };
    description.observation_bound[0] = 5000.0;
    description.observation_bound[1] = f32::MAX;
    let task = TaskSpec::new(description).unwrap();
    let unclipped = model(&[("x", 31)], &[], steps(&[31, 8, 3], Some(Op::Tanh), 9));
    let policy = import(&unclipped, None, &task).unwrap();
    let stds = &policy.observation_normalizer.std;
    assert_eq!([stds[0], stds[2]], [1024.0, 256.0]);
    assert!(0.01 / stds[1] > 1e-30, "{}: ordinary numbers remain normal floats", stds[1]);

    let open = [Op::Clip(-1e38, f32::INFINITY)];
    let open = model(&[("x", 31)], &open, steps(&[31, 8, 3], Some(Op::Tanh), 9));
    assert_eq!(import(&open, None, LAYOUT).unwrap().observation_normalizer.std[0], 256.0);
}

#[test]
fn an_uneven_clip_and_a_negative_scale_keep_their_values() {
    let ops = [Op::Mul(-2.0), Op::Clip(-1.0, f32::INFINITY), Op::Clip(f32::NEG_INFINITY, 4.0)];
    let actor = model(&[("x", 31)], &ops, steps(&[31, 8, 3], Some(Op::Tanh), 5));
    let critic = model(&[("obs", 31), ("action", 3)], &[], steps(&[34, 8, 1], None, 6));
    let refusal =
        import(&actor, Some(&critic), LAYOUT).expect_err("two normalisations").to_string();
    assert!(refusal.contains("observation 0 is normalised in two ways"), "{refusal}");
    let policy = import(&actor, None, LAYOUT).unwrap();
    let unvalued = model(&[("obs", 31), ("action", 3)], &[], steps(&[34, 8, 1], None, 6));
    let zero = |step: &mut Step| {
        if let Step::Layer(layer) = step {
            layer.weight.fill(0.0);
            layer.bias.fill(0.0);
        }
    };
    let mut unvalued = unvalued;
    unvalued.network.steps.iter_mut().for_each(zero);
    assert_same(&actor, &unvalued, &policy);
}

#[test]
fn constant_factors_between_layers_move_into_them() {
    let mut scaled = steps(&[31, 8, 3], Some(Op::Tanh), 7);
    scaled.insert(1, Step::Each(vec![Op::Mul(0.5); 8]));
    scaled.insert(2, Step::Each(vec![Op::Add(0.25); 8]));
    scaled.push(Step::Each(vec![Op::Mul(1.0); 3]));
    scaled.push(Step::Each(vec![Op::Clip(-1.0, 1.0); 3]));
    let actor = model(&[("x", 31)], &[], scaled);
    let critic = model(&[("obs", 31), ("action", 3)], &[], steps(&[34, 8, 1], None, 8));
    assert_same(&actor, &critic, &import(&actor, Some(&critic), LAYOUT).unwrap());
}

#[test]
fn networks_that_a_policy_file_cannot_represent_are_refused() {
    let check = |steps: Vec<Step>, ops: &[Op], expected: &str| {
        let refusal = import(&model(&[("x", 31)], ops, steps), None, LAYOUT).expect_err("refused");
        let refusal = refusal.to_string();
        assert!(refusal.contains(expected), "{refusal:?} lacks {expected:?}");
    };
    let tanh = Some(Op::Tanh);
    let mut hidden = steps(&[31, 8, 3], tanh, 1);
    hidden[1] = Step::Each(vec![Op::Tanh; 8]);
    check(hidden, &[], "Tanh follows hidden layer 1, expected Relu (`tandem teacher` can serve");
    check(steps(&[31, 8, 3], None, 1), &[], "the actor does not end with Tanh");
    let critic = model(&[("obs", 31), ("action", 3)], &[], steps(&[34, 8, 2], None, 1));
    let actor = model(&[("x", 31)], &[], steps(&[31, 8, 3], tanh, 1));
    let refusal = import(&actor, Some(&critic), LAYOUT).expect_err("refused").to_string();
    assert!(refusal.contains("has 2 values, expected 1, or one for each of 1 arm"), "{refusal}");
    check(steps(&[31, 3], tanh, 1), &[], "it has no hidden layer");
    check(steps(&[31, 8, 3], tanh, 1), &[Op::Relu], "observation 0 is transformed by Relu");
    check(
        steps(&[31, 8, 3], tanh, 1),
        &[Op::Clip(0.0, f32::INFINITY)],
        "expected two finite bounds",
    );
    let mut sizes = vec![31, 12_000];
    sizes.extend([1; 20]);
    sizes.push(3);
    check(steps(&sizes, tanh, 1), &[], "with layers of equal width it has");
    sizes.extend([3; 60]);
    check(steps(&sizes, tanh, 1), &[], "it has 81 hidden layers, expected at most 64");
    let mut linear = steps(&[31, 8, 3], tanh, 1);
    linear.remove(1);
    check(linear, &[], "no activation follows layer 1");
}

#[test]
fn inputs_that_do_not_fit_the_task_are_named() {
    let check = |inputs: &[(&str, usize)], n_out: usize, role, expected: &str| {
        let n_in = inputs.iter().map(|(_, width)| width).sum();
        let model = model(inputs, &[], steps(&[n_in, 4, n_out], None, 1));
        let refusal = BoundNetwork::new(&model, role, LAYOUT).expect_err("refused").to_string();
        assert!(refusal.contains(expected), "{refusal:?} lacks {expected:?}");
    };
    check(&[("x", 30)], 3, Role::Actor, "input \"x\": it has 30 numbers, push with 1 arm has 31");
    check(&[("obs", 28), ("g", 3)], 3, Role::Actor, "input \"g\": the name is unknown");
    check(&[("obs", 28), ("action", 3)], 3, Role::Actor, "input \"action\": the name is unknown");
    check(&[("obs", 31)], 4, Role::Actor, "output \"out\": it has 4 numbers, an action of push");
    check(
        &[("obs", 31), ("action", 4)],
        1,
        Role::Critic,
        "it has 4 numbers, push with 1 arm has 3",
    );
}
