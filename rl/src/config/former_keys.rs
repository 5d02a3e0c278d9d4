//! Keys of settings that earlier versions used.
//!
//! Run files, checkpoints and `--set` may use a former key; files are written with current keys only.

/// Settings that have a new key: former and current dotted name.
pub const RENAMED: [(&str, &str); 8] = [
    ("exploration.random_share", "exploration.random_action_prob"),
    ("exploration.random_hold_mean_steps", "exploration.sticky_random_mean_steps"),
    ("world.gripped_start_share", "world.grasped_start_prob"),
    ("replay.her_future_share", "replay.her_ratio"),
    ("replay.moved_share", "replay.displaced_fraction"),
    ("replay.recombined_share", "replay.coda_fraction"),
    ("replay.swap_share", "replay.arm_swap_prob"),
    ("ddpg.cloning_weight", "ddpg.bc_weight"),
];

/// Settings that no longer exist. Their value was 0 in every recipe, so a file that sets one to 0 means the same run
/// without it.
pub const REMOVED: [&str; 2] = ["world.wide_start_share", "replay.advised_share"];

/// Settings that earlier versions did not have, and the values that mean what those versions did, as JSON and TOML. A
/// file with all settings of an earlier version, and a checkpoint, have these values where they have none.
pub const ADDED: [(&str, &str); 20] = [
    ("advice.budget_scope", "\"run\""),
    ("advice.unit", "\"env-step\""),
    ("advice.judged_action", "\"executed\""),
    ("rounds.per_epoch", "50"),
    ("rounds.final_greedy_share", "0.0"),
    ("exploration.joint_random_actions", "false"),
    ("world.grasped_start_env_steps", "0"),
    ("world.randomization", "0.0"),
    ("replay.joint_goal_statistics", "false"),
    ("replay.displaced_hindsight", "false"),
    ("replay.contact_cost_growth", "1.0"),
    ("replay.reflection_prob", "0.0"),
    ("replay.coda_contact_prob", "0.0"),
    ("ddpg.batches_per_update", "1"),
    ("ddpg.cooldown_share", "0.0"),
    ("ddpg.final_discount", "0.0"),
    ("ddpg.bc_final_fraction", "1.0"),
    ("ddpg.bc_filter_start", "1.0"),
    ("evaluation.early_points", "0"),
    ("evaluation.symmetrized", "false"),
];

/// Returns the value that a setting had, in effect, before it existed.
#[must_use]
pub fn before_added(key: &str) -> Option<&'static str> {
    ADDED.iter().find(|(added, _)| *added == key).map(|(_, value)| *value)
}

/// Returns the current name of the setting `key`, which may be a former one.
#[must_use]
pub fn current(key: &str) -> &str {
    RENAMED.iter().find(|(former, _)| *former == key).map_or(key, |(_, current)| current)
}

/// Returns the former name of the setting whose current name is `key`, if it has one.
#[must_use]
pub fn former(key: &str) -> Option<&'static str> {
    RENAMED.iter().find(|(_, current)| *current == key).map(|(former, _)| *former)
}
