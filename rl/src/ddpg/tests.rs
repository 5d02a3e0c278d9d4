//! Comparison of the update with finite differences of a simple loss in double precision, and tests of repeatability.

use tandem_core::rng::{index, uniform};
use tandem_core::{Layout, Stream, Task, episode_rng};
use tandem_policy::MlpShape;

use super::actor_update::QFilter;
use super::critic_update::critic_target;
use super::{
    Batch, Ddpg, DdpgConfig, DdpgError, Rewards, UpdateLosses, UpdateSettings, heads_of_actions,
};

const LAYOUT: Layout = Layout::new(Task::Push, 1);

fn small(change: impl FnOnce(&mut DdpgConfig)) -> DdpgConfig {
    let mut config = DdpgConfig {
        n_hidden: 6,
        n_hidden_layers: 2,
        batch_size: 5,
        action_penalty: 0.0,
        bc_weight: 0.0,
        ..DdpgConfig::default()
    };
    change(&mut config);
    config
}

fn random_batch(n_heads: usize, batch_size: usize, number: u64) -> Batch {
    let mut rng = episode_rng(17, number, Stream::Replay);
    let mut batch = Batch::new(LAYOUT, n_heads, batch_size);
    for x in batch.inputs.iter_mut().chain(&mut batch.next_inputs).chain(&mut batch.actions) {
        *x = uniform(&mut rng, -1.0, 1.0);
    }
    batch.rewards.fill_with(|| if index(&mut rng, 2) == 0 { -1.0 } else { 0.0 });
    for row in batch.bc_mask.chunks_exact_mut(LAYOUT.n_action()) {
        row.fill(if index(&mut rng, 2) == 0 { 1.0 } else { 0.0 });
    }
    batch
}

/// Makes an update without schedules.
fn update(ddpg: &mut Ddpg, batch: &Batch) -> Result<UpdateLosses, DdpgError> {
    ddpg.update(ddpg.config().without_schedules(), batch)
}

fn exact(numbers: &[f32]) -> Vec<f64> {
    numbers.iter().copied().map(f64::from).collect()
}

/// One row through a network.
fn network(shape: &MlpShape, parameters: &[f64], input: Vec<f64>) -> Vec<f64> {
    (0..shape.n_layers()).fold(input, |row, layer| {
        let rows =
            parameters[shape.weight(layer)].chunks(row.len()).zip(&parameters[shape.bias(layer)]);
        let sums = rows.map(|(weights, bias)| {
            weights.iter().zip(&row).map(|(w, x)| w * x).sum::<f64>() + bias
        });
        if layer < shape.n_hidden_layers {
            sums.map(|sum| sum.max(0.0)).collect()
        } else {
            sums.collect()
        }
    })
}

fn policy(shape: &MlpShape, parameters: &[f64], input: &[f64]) -> Vec<f64> {
    network(shape, parameters, input.to_vec()).into_iter().map(f64::tanh).collect()
}

fn critic_loss(ddpg: &Ddpg, critic: &[f64], batch: &Batch) -> f64 {
    let (actor_shape, critic_shape) = (ddpg.actor_shape(), ddpg.critic_shape());
    let (target_actor, target_critic) = (exact(&ddpg.target_actor()), exact(&ddpg.target_critic()));
    let discount = f64::from(ddpg.config().discount);
    let rows =
        exact(&batch.inputs).chunks(actor_shape.n_input).map(<[f64]>::to_vec).collect::<Vec<_>>();
    let mut loss = 0.0;
    for (row, input) in rows.iter().enumerate() {
        let part = |vector: &[f32], n: usize| exact(&vector[row * n..(row + 1) * n]);
        let next_input = part(&batch.next_inputs, actor_shape.n_input);
        let next_action = policy(actor_shape, &target_actor, &next_input);
        let next_q = network(critic_shape, &target_critic, [next_input, next_action].concat());
        let q = network(critic_shape, critic, [input.clone(), part(&batch.actions, 3)].concat());
        for ((q, next_q), reward) in
            q.iter().zip(next_q).zip(part(&batch.rewards, critic_shape.n_output))
        {
            let target = (reward + discount * next_q).clamp(-1.0 / (1.0 - discount), 0.0);
            loss += (q - target).powi(2) / rows.len() as f64;
        }
    }
    loss
}

fn actor_loss(ddpg: &Ddpg, filters_advice: bool, actor: &[f64], batch: &Batch) -> f64 {
    let (actor_shape, critic) = (ddpg.actor_shape(), exact(ddpg.critic()));
    let config = ddpg.config();
    let b = config.batch_size as f64;
    let value = |input: &[f64], action: &[f64]| {
        let q = network(ddpg.critic_shape(), &critic, [input, action].concat());
        q.iter().sum::<f64>()
    };
    // The filter has no gradient: it compares the actions before the update.
    let is_cloned = |row: usize, input: &[f64]| {
        let executed = exact(&batch.actions[row * 3..row * 3 + 3]);
        let own = policy(actor_shape, &exact(ddpg.actor()), input);
        !filters_advice || value(input, &executed) > value(input, &own)
    };
    let mut loss = 0.0;
    for (row, input) in exact(&batch.inputs).chunks(actor_shape.n_input).enumerate() {
        let action = policy(actor_shape, actor, input);
        loss -= value(input, &action) / b;
        for (i, action) in action.iter().enumerate() {
            loss += f64::from(config.action_penalty) * action * action / (b * 3.0);
            if batch.bc_mask[row * 3 + i] > 0.0 && is_cloned(row, input) {
                let error = action - f64::from(batch.actions[row * 3 + i]);
                loss += f64::from(config.bc_weight) * error * error / b;
            }
        }
    }
    loss
}

fn assert_is_gradient(what: &str, gradient: &[f32], at: &[f32], loss: impl Fn(&[f64]) -> f64) {
    const STEP: f64 = 1e-6;
    let along = |i: usize, step: f64| {
        let mut moved = exact(at);
        moved[i] += step;
        loss(&moved)
    };
    assert_eq!(gradient.len(), at.len());
    for (i, slope) in gradient.iter().enumerate() {
        let expected = (along(i, STEP) - along(i, -STEP)) / (2.0 * STEP);
        let tolerance = 2e-5 * expected.abs().max(1.0);
        assert!(
            (f64::from(*slope) - expected).abs() < tolerance,
            "{what} {i}: {slope} against {expected}"
        );
    }
}

#[test]
fn both_gradients_agree_with_finite_differences() {
    let check = |n_heads, filters_advice, change: fn(&mut DdpgConfig)| {
        let mut ddpg = Ddpg::new(small(change), LAYOUT, Rewards::sparse(n_heads), 4);
        let settings = UpdateSettings { filters_advice, ..ddpg.config().without_schedules() };
        let batch = random_batch(n_heads, 5, 0);
        let before = ddpg.clone();
        let losses = ddpg.update(settings, &batch).unwrap();
        let [actor, critic] = ddpg.gradients();
        let by_critic = |critic: &[f64]| critic_loss(&before, critic, &batch);
        let by_actor = |actor: &[f64]| actor_loss(&before, filters_advice, actor, &batch);
        assert!((losses.critic_loss - by_critic(&exact(before.critic()))).abs() < 1e-5);
        assert!((losses.actor_loss - by_actor(&exact(before.actor()))).abs() < 1e-5);
        assert_is_gradient("critic", critic, before.critic(), by_critic);
        assert_is_gradient("actor", actor, before.actor(), by_actor);
    };
    check(1, false, |_| {});
    check(2, false, |_| {});
    check(1, false, |config| config.action_penalty = 3.0);
    check(1, false, |config| config.bc_weight = 4.0);
    check(2, false, |config| (config.action_penalty, config.bc_weight) = (0.5, 2.0));
    check(1, true, |config| config.bc_weight = 4.0);
    check(2, true, |config| config.bc_weight = 4.0);
}

#[test]
fn the_filter_keeps_advice_to_an_arm_that_its_own_value_prefers() {
    let layout = Layout::new(Task::Push, 2);
    assert_eq!(heads_of_actions(&layout.into(), 1), [None; 6]);
    let heads = heads_of_actions(&layout.into(), 2);
    assert_eq!(heads, [0, 0, 0, 1, 1, 1].map(Some));
    let filter = QFilter { executed_q: &[-1.0, -5.0, -2.0, -2.0], heads: &heads };
    let mut bc_mask = vec![1.0; 12];
    bc_mask[0] = 0.0;
    filter.apply(&[-2.0, -3.0, -2.0, -4.0], &mut bc_mask);
    assert_eq!(bc_mask, [0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0]);
    let joint = QFilter { heads: &[None; 6], ..filter };
    let mut bc_mask = vec![1.0; 12];
    joint.apply(&[-2.0, -3.0, -2.0, -4.0], &mut bc_mask);
    assert_eq!(bc_mask, [[0.0; 6], [1.0; 6]].concat());
}

/// Learns on `n_threads` threads from batches of `batch_size` and returns the state and the losses.
fn learn(
    config: &DdpgConfig,
    n_heads: usize,
    n_threads: usize,
) -> (Vec<(&'static str, Vec<f32>)>, Vec<UpdateLosses>) {
    let n_rows = config.transitions_per_update();
    let mut ddpg = Ddpg::new(config.clone(), LAYOUT, Rewards::sparse(n_heads), 9);
    ddpg.set_threads(n_threads);
    let filters_advice = config.bc_weight > 0.0;
    let settings = UpdateSettings { filters_advice, ..config.without_schedules() };
    let mut losses = Vec::new();
    for number in 0..4 {
        losses.push(ddpg.update(settings, &random_batch(n_heads, n_rows, number)).unwrap());
        ddpg.polyak();
    }
    (ddpg.state().map(|(name, vector)| (name, vector.to_vec())).to_vec(), losses)
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let narrow = small(|config| (config.n_hidden, config.batch_size) = (64, 300));
    let uneven = small(|config| (config.n_hidden, config.batch_size) = (130, 101));
    let single = small(|config| {
        (config.n_hidden, config.batch_size, config.batches_per_update) = (64, 300, 2);
    });
    let filtered = small(|config| {
        (config.n_hidden, config.batch_size) = (64, 300);
        config.bc_weight = 2.0;
    });
    let on = |n_pool, config, n_heads, n_threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_pool).build().unwrap();
        pool.install(|| learn(config, n_heads, n_threads))
    };
    for (config, n_heads) in [(&narrow, 2), (&uneven, 2), (&single, 1), (&filtered, 2)] {
        let alone = learn(config, n_heads, 1);
        for n_threads in [2, 3, 5, 16] {
            let together = on(n_threads, config, n_heads, n_threads);
            assert!(together == alone, "{n_threads} threads, batch of {}", config.batch_size);
        }
        assert!(on(1, config, n_heads, 16) == alone, "a pool of one thread");
        assert!(on(3, config, n_heads, 2) == alone, "a pool of more threads");
    }
}

/// Appends the rows of `second` to those of `first`.
fn joined(first: &Batch, second: &Batch) -> Batch {
    let join = |a: &[f32], b: &[f32]| [a, b].concat();
    Batch {
        inputs: join(&first.inputs, &second.inputs),
        actions: join(&first.actions, &second.actions),
        rewards: join(&first.rewards, &second.rewards),
        next_inputs: join(&first.next_inputs, &second.next_inputs),
        bc_mask: join(&first.bc_mask, &second.bc_mask),
    }
}

#[test]
fn the_gradients_of_an_updates_batches_are_summed_and_its_losses_averaged() {
    let with = |n_batches| {
        let config = small(|config| {
            (config.action_penalty, config.bc_weight) = (0.5, 2.0);
            config.batches_per_update = n_batches;
        });
        Ddpg::new(config, LAYOUT, Rewards::sparse(1), 3)
    };
    let batches = [random_batch(1, 5, 0), random_batch(1, 5, 1)];
    let alone = [0, 1].map(|idx| {
        let mut ddpg = with(1);
        let losses = update(&mut ddpg, &batches[idx]).unwrap();
        (ddpg.gradients().map(<[f32]>::to_vec), losses)
    });
    let mut together = with(2);
    let losses = update(&mut together, &joined(&batches[0], &batches[1])).unwrap();
    for (network, gradient) in together.gradients().iter().enumerate() {
        let parts = alone[0].0[network].iter().zip(&alone[1].0[network]);
        for (got, (first, second)) in gradient.iter().zip(parts) {
            assert!((got - (first + second)).abs() < 1e-5, "{got} is not {first} + {second}");
        }
    }
    let mean = |loss: fn(&UpdateLosses) -> f64| (loss(&alone[0].1) + loss(&alone[1].1)) / 2.0;
    for loss in [
        (|l: &UpdateLosses| l.critic_loss) as fn(&UpdateLosses) -> f64,
        |l| l.actor_loss,
        |l| l.mean_q,
    ] {
        assert!((loss(&losses) - mean(loss)).abs() < 1e-5);
    }
}

#[test]
fn the_critic_fits_a_fixed_target() {
    let mut ddpg = Ddpg::new(small(|config| config.n_hidden = 32), LAYOUT, Rewards::sparse(1), 1);
    let batch = random_batch(1, 5, 0);
    let first = update(&mut ddpg, &batch).unwrap().critic_loss;
    let last = (0..200).map(|_| update(&mut ddpg, &batch).unwrap().critic_loss).last().unwrap();
    assert!(last < 1e-3 * first, "the target is fixed, the loss went from {first} to {last}");
}

#[test]
fn polyak_averaging_moves_only_the_targets() {
    let mut ddpg =
        Ddpg::new(small(|config| config.polyak_keep = 0.5), LAYOUT, Rewards::sparse(1), 1);
    update(&mut ddpg, &random_batch(1, 5, 0)).unwrap();
    let before = ddpg.clone();
    ddpg.polyak();
    assert_eq!((ddpg.actor(), ddpg.critic()), (before.actor(), before.critic()));
    for (target, (old, online)) in [
        (ddpg.target_actor(), (before.target_actor(), before.actor())),
        (ddpg.target_critic(), (before.target_critic(), before.critic())),
    ] {
        let expected: Vec<f32> =
            old.iter().zip(online).map(|(old, online)| 0.5 * old + 0.5 * online).collect();
        assert_eq!(target, expected);
        assert_ne!(target, old);
    }
}

#[test]
fn targets_are_clipped_to_the_sum_of_lowest_rewards() {
    assert_eq!(critic_target(0.5, -1.0, -1.0, -9.0), -2.0);
    assert_eq!(critic_target(0.5, -3.0, -1.0, -9.0), -5.5);
    assert_eq!(critic_target(0.5, -3.0, -3.0, -9.0), -6.0);
    assert_eq!(critic_target(0.5, -3.0, 0.0, 9.0), 0.0);
}

#[test]
fn a_restored_learner_continues_with_the_same_bits() {
    let config = small(|_| {});
    let mut first = Ddpg::new(config.clone(), LAYOUT, Rewards::sparse(2), 1);
    for number in 0..3 {
        update(&mut first, &random_batch(2, 5, number)).unwrap();
        first.polyak();
    }
    let stored = first.state().map(|(name, vector)| (name.to_owned(), vector.to_vec()));
    let mut second = Ddpg::new(config, LAYOUT, Rewards::sparse(2), 2);
    second.restore(&stored, first.n_updates()).unwrap();
    let batch = random_batch(2, 5, 3);
    assert_eq!(update(&mut first, &batch), update(&mut second, &batch));
    assert_eq!(first.state(), second.state());
    assert_eq!(second.n_updates(), 4);
}

#[test]
fn the_learning_rates_of_an_update_are_those_of_its_settings() {
    let batch = random_batch(2, 5, 0);
    let learned = |initial: f32, rate: f32| {
        let config = small(|config| {
            (config.actor_learning_rate, config.critic_learning_rate) = (initial, initial);
        });
        let settings = UpdateSettings {
            actor_learning_rate: rate,
            critic_learning_rate: rate,
            ..config.without_schedules()
        };
        let mut ddpg = Ddpg::new(config, LAYOUT, Rewards::sparse(2), 1);
        ddpg.update(settings, &batch).unwrap();
        ddpg.state().map(|(_, vector)| vector.to_vec())
    };
    assert_eq!(learned(1e-3, 1e-4), learned(1e-4, 1e-4));
    assert_ne!(learned(1e-3, 1e-4), learned(1e-3, 1e-3));
}

#[test]
fn a_state_that_does_not_fit_is_refused_and_changes_nothing() {
    let mut ddpg = Ddpg::new(small(|_| {}), LAYOUT, Rewards::sparse(1), 1);
    let untouched = ddpg.clone();
    let mut stored =
        ddpg.state().map(|(name, vector)| (name.to_owned(), vec![0.5; vector.len()])).to_vec();
    let (_, last) = stored.last_mut().unwrap();
    let expected = last.len();
    last.pop();
    let refusal = |got| Err(DdpgError::Restore { name: "critic.adam.second", got, expected });
    assert_eq!(ddpg.restore(&stored, 1), refusal(expected - 1));
    stored.pop();
    assert_eq!(ddpg.restore(&stored, 1), refusal(0));
    assert_eq!((ddpg.state(), ddpg.n_updates()), (untouched.state(), 0));
}

#[test]
fn non_finite_numbers_are_errors() {
    let check = |spoil: fn(&mut Batch), what| {
        let mut ddpg = Ddpg::new(small(|_| {}), LAYOUT, Rewards::sparse(1), 1);
        let mut batch = random_batch(1, 5, 0);
        spoil(&mut batch);
        assert_eq!(update(&mut ddpg, &batch), Err(DdpgError::NotFinite { what, update: 1 }));
    };
    check(|batch| batch.rewards[4] = f32::NAN, "a critic loss");
    check(|batch| batch.actions[0] = f32::INFINITY, "a critic loss");
}

#[test]
fn settings_out_of_range_are_named() {
    assert_eq!(DdpgConfig::default().check(), Ok(()));
    let check = |change: fn(&mut DdpgConfig), key| {
        assert_eq!(small(change).check().map_err(|error| error.key), Err(key));
    };
    check(|config| config.discount = 1.0, "ddpg.discount");
    check(|config| config.final_discount = f32::NAN, "ddpg.final_discount");
    check(|config| config.polyak_keep = f32::NAN, "ddpg.polyak_keep");
    check(|config| config.bc_weight = -1.0, "ddpg.bc_weight");
    check(|config| config.action_penalty = f32::INFINITY, "ddpg.action_penalty");
    check(|config| config.actor_learning_rate = 0.0, "ddpg.actor_learning_rate");
    check(|config| config.cooldown_share = 1.5, "ddpg.cooldown_share");
    check(|config| config.cooldown_learning_rate = f32::NAN, "ddpg.cooldown_learning_rate");
    check(|config| config.batch_size = 0, "ddpg.batch_size");
    check(|config| config.n_hidden_layers = 0, "ddpg.n_hidden_layers");
    check(|config| config.batches_per_update = 0, "ddpg.batches_per_update");
    let too_many = |config: &mut DdpgConfig| {
        (config.batch_size, config.batches_per_update) = (65_536, 2);
    };
    check(too_many, "ddpg.batches_per_update");
}
