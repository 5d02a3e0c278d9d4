//! The update against numbers that `scripts/ddpg_reference.py` computed independently, in double precision.

use serde_json::Value;
use tandem_core::{Layout, Task};
use tandem_rl::ddpg::{Batch, Ddpg, DdpgConfig, Rewards};

const REFERENCE: &str = include_str!("data/ddpg_reference.json");
/// Single precision's share in a loss, a gradient or a step, of numbers of 1 and more.
const TOLERANCE: f64 = 1e-6;

fn f64s(value: &Value) -> Vec<f64> {
    value
        .as_array()
        .expect("a list")
        .iter()
        .map(|number| number.as_f64().expect("a number"))
        .collect()
}

#[expect(clippy::cast_possible_truncation, reason = "the reference starts from single precision")]
fn f32s(value: &Value) -> Vec<f32> {
    f64s(value).into_iter().map(|number| number as f32).collect()
}

fn batch(stored: &Value) -> Batch {
    Batch {
        inputs: f32s(&stored["inputs"]),
        actions: f32s(&stored["actions"]),
        rewards: f32s(&stored["rewards"]),
        next_inputs: f32s(&stored["next_inputs"]),
        bc_mask: f32s(&stored["bc_mask"]),
    }
}

fn assert_close(what: &str, got: &[f32], expected: &Value) {
    let expected = f64s(expected);
    assert_eq!(got.len(), expected.len(), "{what}");
    for (i, (got, expected)) in got.iter().zip(expected).enumerate() {
        assert!(
            (f64::from(*got) - expected).abs() < TOLERANCE * expected.abs().max(1.0),
            "{what} {i}: {got} against {expected}"
        );
    }
}

#[test]
fn every_update_agrees_with_the_reference() {
    let reference: Value = serde_json::from_str(REFERENCE).unwrap();
    let config: DdpgConfig = serde_json::from_value(reference["config"].clone()).unwrap();
    let settings = config.without_schedules();
    let mut ddpg = Ddpg::new(config, Layout::new(Task::Push, 1), Rewards::sparse(2), 0);
    for (n_before, update) in (0..).zip(reference["updates"].as_array().unwrap()) {
        let before = update["before"].as_object().unwrap();
        let before: Vec<_> =
            before.iter().map(|(name, vector)| (name.clone(), f32s(vector))).collect();
        ddpg.restore(&before, n_before).unwrap();
        let losses = ddpg.update(settings, &batch(&update["batch"])).unwrap();
        ddpg.polyak();
        for (name, got) in [
            ("critic_loss", losses.critic_loss),
            ("actor_loss", losses.actor_loss),
            ("mean_q", losses.mean_q),
        ] {
            let expected = update["losses"][name].as_f64().unwrap();
            assert!(
                (got - expected).abs() < TOLERANCE * expected.abs().max(1.0),
                "{name}: {got} against {expected}"
            );
        }
        let [actor, critic] = ddpg.gradients();
        assert_close("actor gradient", actor, &update["gradient"]["actor"]);
        assert_close("critic gradient", critic, &update["gradient"]["critic"]);
        for (name, vector) in ddpg.state() {
            assert_close(name, &vector, &update["after"][name]);
        }
    }
}
