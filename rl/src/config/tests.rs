//! Recipes, derived numbers and refused values.

use tandem_core::Task;
use tandem_core::evaluation::TEST_SEED;

use super::*;

#[test]
fn every_recipe_passes_its_own_checks() {
    for (recipe, task, n_arms) in [
        (Recipe::Tandem, Task::Push, 1),
        (Recipe::Tandem, Task::PickAndPlace, 2),
        (Recipe::Paper, Task::Push, 2),
        (Recipe::Paper, Task::PickAndPlace, 1),
    ] {
        assert!(RunConfig::defaults(recipe, task, n_arms).checked().is_ok());
    }
}

#[test]
fn a_recipe_parses_from_the_name_that_files_have() {
    for recipe in Recipe::ALL {
        assert_eq!(serde_json::to_value(recipe).unwrap(), recipe.name());
        assert_eq!(recipe.to_string().parse(), Ok(recipe));
    }
    let message = "baselines".parse::<Recipe>().unwrap_err().to_string();
    assert_eq!(message, "recipe is \"baselines\": expected \"tandem\" or \"paper\"");
}

#[test]
fn the_papers_round_has_forty_updates() {
    let paper = RunConfig::defaults(Recipe::Paper, Task::Push, 2);
    assert_eq!((paper.episodes_per_round(), paper.updates_per_round()), (32, 40));
    let epoch = paper.rounds.per_epoch * paper.env_steps_per_round();
    assert_eq!((paper.evaluation.every_env_steps, paper.stop.max_env_steps), (epoch, 900 * epoch));
    assert_eq!(epoch, 80_000);
    assert_eq!(paper.advice_budget(), 8_000_000, "16 slots of 500,000");
}

#[test]
fn the_papers_epochs_follow_the_length_of_the_tasks_episodes() {
    for (n_arms, n_epochs) in [(1, 50), (2, 900)] {
        let push = TaskSpec::built_in(Task::Push, n_arms);
        let mut description = push.description().clone();
        (description.name, description.episode_steps) = ("lab/short".to_owned(), 20);
        let short = TaskSpec::new(description).expect("valid");
        for (task, epoch) in [(push, 80_000), (short, 32_000)] {
            let paper = RunConfig::defaults_of(Recipe::Paper, &task);
            assert_eq!(paper.env_steps_per_round() * paper.rounds.per_epoch, epoch);
            let (every, max) = (paper.evaluation.every_env_steps, paper.stop.max_env_steps);
            assert_eq!((every, max), (epoch, n_epochs * epoch), "{}", task.name());
        }
    }
}

#[test]
fn the_largest_slot_is_one_of_training_or_of_an_evaluation() {
    let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    let mut check = |rollouts, episodes, expected| {
        (config.rounds.rollouts, config.evaluation.episodes) = (rollouts, episodes);
        assert_eq!(config.largest_slot(), expected);
    };
    check(2, 240, 8);
    check(2, 4, 4);
    check(16, 240, 16);
}

#[test]
fn a_run_cools_down_over_its_last_fifth_if_it_has_an_end() {
    let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    config.stop.max_env_steps = 10_000;
    let first = (0..100).find(|round| config.at_round(*round).is_cooldown);
    assert_eq!((config.env_steps_per_round(), first), (800, Some(10)), "8,000 of 10,000");
    (config.ddpg.actor_learning_rate, config.ddpg.critic_learning_rate) = (3e-3, 4e-3);
    let rates = [9, 10].map(|round| {
        let update = config.at_round(round).update;
        (update.actor_learning_rate, update.critic_learning_rate)
    });
    assert_eq!(rates, [(3e-3, 4e-3), (2e-4, 2e-4)]);
    config.ddpg.cooldown_share = 0.0;
    assert!((0..=12).all(|round| !config.at_round(round).is_cooldown), "no share of it");
    config.stop.max_env_steps = 0;
    assert!((0..100).all(|round| !config.at_round(round).is_cooldown), "without an end");
}

#[test]
fn evaluations_are_denser_before_the_first_regular_one() {
    let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    let evaluated = |config: &RunConfig| {
        (0..=50).filter(|round| config.is_evaluated(*round)).collect::<Vec<u64>>()
    };
    assert_eq!(evaluated(&config), [0, 6, 12, 18, 25, 50], "25 rounds of 800 steps are 20,000");
    config.evaluation.early_points = 0;
    assert_eq!(evaluated(&config), [25, 50], "as before");
    (config.evaluation.early_points, config.evaluation.every_env_steps) = (4, 1_600);
    assert_eq!(evaluated(&config)[..4], [0, 1, 2, 4], "no round twice");
    config.evaluation.every_env_steps = u64::MAX;
    assert_eq!(evaluated(&config), [0]);
}

#[test]
fn the_cost_of_a_contact_grows_between_a_tenth_and_half_of_a_run() {
    let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    config.stop.max_env_steps = 80_000;
    assert!((0..=100).all(|round| config.at_round(round).contact_cost == 1.0), "a growth of 1");
    config.replay.contact_cost_growth = 9.0;
    let costs = [0, 10, 30, 50, 100].map(|round| config.at_round(round).contact_cost);
    assert_eq!(costs, [1.0, 1.0, 5.0, 9.0, 9.0], "rounds of 800 steps");
    assert_eq!(config.replay.lowest_reward(), -10.0, "the clip allows the highest cost");
    config.stop.max_env_steps = 0;
    assert_eq!(config.at_round(50).contact_cost, 1.0, "without an end");
}

#[test]
fn advice_is_filtered_from_a_fraction_of_a_run_with_a_limit() {
    let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    config.stop.max_env_steps = 100 * config.env_steps_per_round();
    let filters = |config: &RunConfig, round| config.at_round(round).update.filters_advice;
    let filtered = |config: &RunConfig| (0..100).filter(|round| filters(config, *round)).count();
    assert_eq!(filtered(&config), 0, "the recipe never filters");
    config.ddpg.bc_filter_start = 0.25;
    assert_eq!(filtered(&config), 75);
    assert!(filters(&config, 25) && !filters(&config, 24));
    config.ddpg.bc_filter_start = 0.0;
    assert_eq!(filtered(&config), 100);
    config.stop.max_env_steps = 0;
    assert_eq!(filtered(&config), 0, "without an end");
}

#[test]
fn cloning_fades_over_the_middle_half_of_a_run() {
    let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    config.stop.max_env_steps = 80_000;
    assert!(
        (0..=100).all(|round| config.at_round(round).update.bc_weight == 2.0),
        "all of it remains"
    );
    config.ddpg.bc_final_fraction = 0.25;
    let weights = [0, 25, 50, 75, 100].map(|round| config.at_round(round).update.bc_weight);
    assert_eq!(weights, [2.0, 2.0, 1.25, 0.5, 0.5], "rounds of 800 steps");
    config.stop.max_env_steps = 0;
    assert_eq!(config.at_round(50).update.bc_weight, 2.0, "without an end");
}

#[test]
fn the_horizon_of_the_discount_grows_over_the_middle_half_of_a_run() {
    let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    config.stop.max_env_steps = 80_000;
    config.ddpg.final_discount = 0.0;
    let discount = |config: &RunConfig, round| config.at_round(round).update.discount;
    assert!((0..=100).all(|round| discount(&config, round) == config.ddpg.discount), "it stays");
    (config.ddpg.discount, config.ddpg.final_discount) = (0.5, 0.875);
    let discounts = [0, 25, 50, 75, 100].map(|round| discount(&config, round));
    assert_eq!(discounts, [0.5, 0.5, 0.8, 0.875, 0.875], "horizons of 2, 5 and 8 steps");
    config.stop.max_env_steps = 0;
    assert_eq!(discount(&config, 50), 0.5, "without an end");
}

#[test]
fn greedy_episodes_get_more_over_the_middle_half_of_a_run() {
    let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
    config.stop.max_env_steps = 80_000;
    config.rounds.final_greedy_share = 0.5;
    let shares = [0, 25, 50, 75, 100].map(|round| config.at_round(round).greedy_share);
    assert_eq!(shares, [0.0, 0.0, 0.25, 0.5, 0.5], "rounds of 800 steps");
    config.stop.max_env_steps = 0;
    assert_eq!(config.at_round(50).greedy_share, 0.0, "without an end");
}

#[test]
fn a_bad_value_is_named() {
    let check = |change: fn(&mut RunConfig), key| {
        let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
        change(&mut config);
        let message = config.checked().expect_err("must be refused").to_string();
        assert!(message.contains(key), "{message:?} does not name {key:?}");
    };
    check(|config| config.arms = 3, "arms");
    check(|config| config.task = "shove".to_owned(), "shove");
    check(|config| config.advice.share = f64::NAN, "advice.share");
    check(|config| config.rounds.updates_per_env_step = 0.0, "rounds.updates_per_env_step");
    check(|config| config.rounds.updates_per_env_step = 1e-300, "updates_per_env_step");
    check(|config| config.replay.goal_tolerance_m = 1e-30, "replay.goal_tolerance_m");
    check(|config| config.stop.max_minutes = f64::INFINITY, "stop.max_minutes");
    check(|config| config.ddpg.actor_learning_rate = 1e-40, "ddpg.actor_learning_rate");
    check(|config| config.exploration.random_action_prob = 1.0, "exploration.random_action_prob");
    check(|config| config.name = "a/b".to_owned(), "name");
    check(|config| config.ddpg.discount = 1.0, "ddpg.discount");
    check(|config| config.seed = config.evaluation.seed, "another than evaluation.seed");
    check(|config| config.seed = TEST_SEED, "seed is 777: expected another seed");
    check(|config| config.evaluation.seed = TEST_SEED, "evaluation.seed is 777");
    check(|config| config.rounds.per_epoch = 0, "rounds.per_epoch");
    check(|config| (config.rounds.slots, config.rounds.rollouts) = (4096, 17), "rounds.slots");
    check(|config| config.rounds.final_greedy_share = f64::NAN, "rounds.final_greedy_share");
    check(|config| config.evaluation.early_points = 101, "evaluation.early_points");
    let too_much = |config: &mut RunConfig| {
        config.advice.budget_scope = BudgetScope::Slot;
        config.advice.budget = 1_000_000_000_000;
    };
    check(too_much, "advice.budget");
}
