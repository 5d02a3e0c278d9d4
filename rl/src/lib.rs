//! The learning algorithm: DDPG with hindsight experience replay (HER), Polyak-averaged target networks and behaviour
//! cloning of advised actions.
//!
//! The crate is pure: it reads no clock and no file, uses no network protocol, and does not know how an episode is
//! simulated or played. A [`trainer::Trainer`] takes whole episodes and makes the updates of a round.
//!
//! Reading order: [`config`] (the run file), [`ddpg`] (the update, in the order of the paper), [`replay`] and [`her`]
//! (the replay buffer and how batches are sampled from it), [`trainer`] (a round).
//!
//! # A tour
//!
//! ```
//! use tandem_core::{Episode, Stream, Task, episode_rng};
//! use tandem_policy::NormalizerSnapshot;
//! use tandem_rl::RunConfig;
//! use tandem_rl::config::Recipe;
//! use tandem_rl::ddpg::{Batch, Ddpg, Rewards};
//! use tandem_rl::her::{Sampler, Statistics};
//! use tandem_rl::replay::ReplayBuffer;
//!
//! // A recipe gives every setting a value; this run pushes with one arm, and its networks are small.
//! let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 1);
//! config.ddpg.n_hidden = 16;
//! config.ddpg.batch_size = 32;
//! let config = config.checked()?;
//! let task = config.task_spec()?;
//!
//! // The replay buffer stores whole episodes. A real one comes from a worker; this one is all zeros.
//! let mut buffer = ReplayBuffer::new(&task, config.replay.capacity_transitions);
//! buffer.push(&Episode::zeros(&task, 0));
//!
//! // HER samples transitions, gives most of them a goal that their episode achieved later, and recomputes rewards.
//! let n_heads = config.replay.reward.n_heads(&task);
//! let mut batch = Batch::new(&task, n_heads, config.ddpg.transitions_per_update());
//! let observation = NormalizerSnapshot::identity(task.n_observation());
//! let goal = NormalizerSnapshot::identity(task.n_goal());
//! let statistics = Statistics { observation: &observation, goal: &goal };
//! let mut rng = episode_rng(config.seed, 0, Stream::Replay);
//! Sampler::new(&config.replay, &task).fill(&buffer, statistics, &mut rng, &mut batch);
//! assert!(batch.rewards.iter().all(|reward| *reward == 0.0), "the object rests at its goal");
//!
//! // One update of critic and actor, then Polyak averaging of their target networks.
//! let rewards = Rewards { n_heads, lowest: config.replay.lowest_reward() };
//! let settings = config.at_round(0).update;
//! let mut ddpg = Ddpg::new(config.ddpg, &task, rewards, config.seed);
//! let losses = ddpg.update(settings, &batch)?;
//! ddpg.polyak();
//! assert!(losses.critic_loss.is_finite() && ddpg.n_updates() == 1);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![warn(missing_docs)]

pub mod config;
pub mod ddpg;
pub mod ensemble;
pub mod her;
pub mod jump_start;
pub mod replay;
pub mod trainer;

pub use config::RunConfig;
