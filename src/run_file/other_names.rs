//! The names that other trainers give to settings. docs/recipes.md has the usual ones.

/// Names of other trainers, each with the settings that have that meaning here.
const OTHER_NAMES: [(&[&str], &str); 16] = [
    (&["gamma"], "ddpg.discount"),
    (&["tau"], "ddpg.polyak_keep, which is 1 - tau"),
    (&["polyak"], "ddpg.polyak_keep"),
    (&["learning_rate", "lr"], "ddpg.actor_learning_rate and ddpg.critic_learning_rate"),
    (&["actor_lr", "pi_lr", "policy_lr"], "ddpg.actor_learning_rate"),
    (&["critic_lr", "q_lr"], "ddpg.critic_learning_rate"),
    (&["learning_starts", "start_steps"], "rounds.warmup_env_steps"),
    (&["gradient_steps", "train_freq", "utd", "utd_ratio"], "rounds.updates_per_env_step"),
    (&["n_envs", "num_envs"], "rounds.slots times rounds.rollouts"),
    (&["total_timesteps", "total_steps"], "stop.max_env_steps"),
    (&["net_arch", "hidden_sizes"], "ddpg.n_hidden and ddpg.n_hidden_layers"),
    (&["buffer_size", "replay_size"], "replay.capacity_transitions"),
    (&["n_sampled_goal", "replay_k"], "replay.her_ratio, the hindsight share: k / (k + 1)"),
    (&["action_noise", "exploration_noise", "noise_eps"], "exploration.noise_std"),
    (&["random_eps"], "exploration.random_action_prob"),
    (&["eval_freq", "eval_interval"], "evaluation.every_env_steps"),
];

/// Returns the settings that another trainer calls `name`, with or without a section before it.
pub(super) fn meaning(name: &str) -> Option<&'static str> {
    let last = name.rsplit('.').next()?;
    OTHER_NAMES.iter().find(|(names, _)| names.contains(&last)).map(|(_, settings)| *settings)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run_file::{names_below, resolve};

    #[test]
    fn every_setting_of_the_table_exists() {
        let run = resolve(None, &[]).expect("the defaults");
        let known = names_below(&toml::Table::try_from(run).expect("a table"), "");
        let words = OTHER_NAMES.iter().flat_map(|(_, settings)| settings.split([' ', ',', ':']));
        let named: Vec<&str> = words.filter(|word| word.contains('.')).collect();
        assert!(named.len() >= OTHER_NAMES.len());
        for name in named {
            assert!(known.iter().any(|known| known == name), "{name}");
        }
        assert_eq!(meaning("ddpg.gamma"), meaning("gamma"));
        assert_eq!(meaning("train_freq"), meaning("gradient_steps"));
        assert_eq!(meaning("discount"), None);
    }
}
