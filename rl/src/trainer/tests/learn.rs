//! The updates of a round: targets of the values, schedules and Polyak averaging.

use tandem_core::Contacts;

use super::*;

/// Rounds of 50 environment steps in the run that [`config`] describes.
const N_ROUNDS: u64 = 8;

/// Returns the settings of a run with tiny networks and two updates per round, and no schedule.
fn config() -> RunConfig {
    let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    (config.rounds.slots, config.rounds.rollouts) = (1, 1);
    config.rounds.updates_per_env_step = 2.0 / 50.0;
    config.stop.max_env_steps = N_ROUNDS * 50;
    (config.ddpg.n_hidden, config.ddpg.n_hidden_layers) = (6, 2);
    config.ddpg.batch_size = 16;
    config.ddpg.cooldown_share = 0.0;
    config
}

/// Returns an episode far from its goals. The teacher decides for both arms on every other step, and the arms touch in
/// the second half.
fn advised_episode() -> Episode {
    let mut episode = drifting_episode(Layout::new(Task::Push, 2), 0, 0.01);
    episode.goal.fill(9.0);
    episode.actions.fill(0.5);
    episode.advised_arms.iter_mut().skip(1).step_by(2).for_each(|arms| *arms = 0b11);
    episode.contacts[25..].fill(Contacts::ARM_ARM);
    episode
}

/// Returns a new run's state after it has learned from [`advised_episode`] in round `round`.
fn learned(config: RunConfig, round: u64) -> Trainer {
    let mut trainer = Trainer::new(config).expect("valid");
    trainer.counters.round = round;
    trainer.ingest(&[advised_episode()]);
    trainer.learn(|_| ()).expect("finite");
    trainer
}

#[test]
fn intervention_feedback_lowers_the_lowest_value() {
    let targets = |strategy: &str| {
        let mut config = config();
        strategy.clone_into(&mut config.advice.strategy);
        (config.replay.her_ratio, config.replay.contact_cost) = (0.0, 0.5);
        // The value of a step is then its reward, and the lowest value is the lowest reward.
        (config.ddpg.discount, config.ddpg.final_discount) = (0.0, 0.0);
        let trainer = learned(config, 0);
        assert!(trainer.jump_start.is_none(), "{strategy} has no horizon");
        let mut targets = trainer.ddpg.critic_batch().targets.to_vec();
        targets.sort_by(f32::total_cmp);
        targets.dedup();
        targets
    };
    assert_eq!(targets("none"), [-1.5, -1.0], "a pending goal, and a contact");
    assert_eq!(targets("rlif:0.2"), [-2.5, -2.0, -1.5, -1.0], "or an intervention as well");
}

/// A setting that changes during a run.
struct Schedule {
    name: &'static str,
    /// The first round of [`N_ROUNDS`] with another value than that of round 0.
    first_round: u64,
    /// Adds the schedule to [`config`].
    schedule: fn(&mut RunConfig),
    /// Replaces the schedule by its value in a round.
    freeze: fn(&mut RunConfig, u64),
}

const SCHEDULES: [Schedule; 5] = [
    Schedule {
        name: "cooldown",
        first_round: 6,
        schedule: |config| config.ddpg.cooldown_share = 0.25,
        freeze: |config, _| {
            let ddpg = &mut config.ddpg;
            ddpg.cooldown_share = 0.0;
            ddpg.actor_learning_rate = ddpg.cooldown_learning_rate;
            ddpg.critic_learning_rate = ddpg.cooldown_learning_rate;
        },
    },
    Schedule {
        name: "discount",
        first_round: 3,
        schedule: |config| config.ddpg.final_discount = 0.98,
        freeze: |config, round| {
            config.ddpg.discount = config.at_round(round).update.discount;
            config.ddpg.final_discount = 0.0;
        },
    },
    Schedule {
        name: "weight of cloning",
        first_round: 3,
        schedule: |config| config.ddpg.bc_final_fraction = 0.0,
        freeze: |config, round| {
            config.ddpg.bc_weight = config.at_round(round).update.bc_weight;
            config.ddpg.bc_final_fraction = 1.0;
        },
    },
    Schedule {
        name: "filter of advice",
        first_round: 4,
        schedule: |config| config.ddpg.bc_filter_start = 0.5,
        freeze: |config, _| config.ddpg.bc_filter_start = 0.0,
    },
    Schedule {
        name: "cost of a contact",
        first_round: 1,
        schedule: |config| config.replay.contact_cost_growth = 4.0,
        freeze: |config, round| {
            config.replay.contact_cost = config.at_round(round).contact_cost;
            config.replay.contact_cost_growth = 1.0;
        },
    },
];

#[test]
fn a_round_is_learned_with_the_value_of_every_schedule_in_that_round() {
    for Schedule { name, first_round, schedule, freeze } in SCHEDULES {
        let digest = |config: &RunConfig, round| learned(config.clone(), round).digest();
        let (constant, mut scheduled) = (config(), config());
        schedule(&mut scheduled);
        let before = first_round - 1;
        assert_eq!(digest(&scheduled, before), digest(&constant, before), "{name} starts early");
        let mut frozen = scheduled.clone();
        freeze(&mut frozen, first_round);
        let with_schedule = digest(&scheduled, first_round);
        assert_ne!(with_schedule, digest(&constant, first_round), "{name} has no effect");
        assert_eq!(with_schedule, digest(&frozen, first_round), "{name} has another value");
    }
}

/// Returns the parameters of both online networks, then those of both target networks.
fn online_and_target(trainer: &Trainer) -> [Vec<f32>; 2] {
    let ddpg = &trainer.ddpg;
    [[ddpg.actor(), ddpg.critic()].concat(), [ddpg.target_actor(), ddpg.target_critic()].concat()]
}

#[test]
fn targets_move_once_a_round_or_after_each_of_its_updates() {
    let after = |polyak_every, n_updates: u32| {
        let mut config = config();
        config.ddpg.polyak_keep = 0.5;
        config.rounds.polyak_every = polyak_every;
        config.rounds.updates_per_env_step = f64::from(n_updates) / 50.0;
        online_and_target(&learned(config, 0))
    };
    let middle = |target: &[f32], online: &[f32]| -> Vec<f32> {
        target.iter().zip(online).map(|(target, online)| 0.5 * target + 0.5 * online).collect()
    };
    let [_, start] = online_and_target(&Trainer::new(config()).expect("valid"));
    let [online, target] = after(PolyakEvery::Round, 2);
    assert_eq!(target, middle(&start, &online), "once, after both updates");
    let [online, first_target] = after(PolyakEvery::Update, 1);
    assert_eq!(first_target, middle(&start, &online), "after the first update");
    let [online, target] = after(PolyakEvery::Update, 2);
    assert_eq!(target, middle(&first_target, &online), "and again after the second one");
}
