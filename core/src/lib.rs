//! The types that Tandem's other crates share: tasks and the layout of vectors, the sparse reward, episodes and their
//! outcomes, and random number streams.
//!
//! A type lives here only if two crates need it. The crate performs no input or output, reads no clock and knows no
//! wire format. The environments are in `tandem_sim`, the networks in `tandem_policy`, the learning algorithm in
//! `tandem_rl`.
//!
//! # Tasks
//!
//! A [`TaskSpec`] is everything that the learner, the teacher and the workers know about a task: the length of every
//! vector, the part of each vector that belongs to each arm, the sparse reward and the length of an episode. It is made
//! from a [`TaskDescription`], which is plain data.
//!
//! ```
//! use tandem_core::task::{ArmDescription, Manipulation, Norm, Reflection};
//! use tandem_core::{ArmIndex, TaskDescription, TaskSpec};
//!
//! // A point on a line: its observation is position and speed, its goal a position.
//! let arm = ArmDescription {
//!     observation: vec![0, 1],
//!     goal: vec![0],
//!     action: vec![0],
//!     position: vec![],
//!     lateral: vec![],
//!     hand: vec![],
//! };
//! let task = TaskSpec::new(TaskDescription {
//!     name: "point".to_owned(),
//!     n_observation: 2,
//!     n_goal: 1,
//!     n_action: 1,
//!     achieved_goal: vec![0],
//!     episode_steps: 20,
//!     tolerance: 0.1,
//!     norm: Norm::Euclidean,
//!     interchangeable_arms: false,
//!     reports_contacts: false,
//!     origin_distance: 0.0,
//!     recombination_gap: 0.0,
//!     base: 0.0,
//!     contact_distances: Vec::new(),
//!     observation_bound: vec![2.0, 1.0],
//!     goal_bound: vec![2.0],
//!     arms: vec![arm],
//!     manipulation: Manipulation::default(),
//!     reflection: Reflection::default(),
//! })?;
//! assert!(task.is_success(&[0.45, 0.0], &[0.5]));
//! # Ok::<(), tandem_core::task::InvalidTask>(())
//! ```
//!
//! # Built-in tasks
//!
//! A [`Layout`] is a built-in [`Task`] and a number of arms, which the simulator implements: with two arms, an
//! observation has 56 numbers, a goal 6 and an action 6 (push) or 8 (pick and place). `TaskSpec::from` describes it.
//!
//! ```
//! use tandem_core::{ArmIndex, Layout, Task};
//!
//! let layout = Layout::new(Task::PickAndPlace, 2);
//! assert_eq!(layout.n_observation(), 56);
//! assert_eq!(layout.n_goal(), 6);
//! assert_eq!(layout.n_action(), 8);
//! ```
//!
//! The vector of several arms is the concatenation of the vectors of each arm. Positions are metres, angles radians and
//! actions numbers in [−1, 1]; each arm's part is in the arm's own frame (origin on the table ahead of its base, x away
//! from the base, z up). A policy for one arm can therefore use a part unchanged, which is how a one-arm teacher
//! advises a two-arm student:
//!
//! ```
//! # use tandem_core::{ArmIndex, Layout, Task};
//! # let layout = Layout::new(Task::PickAndPlace, 2);
//! let observation = vec![0.0_f32; layout.n_observation()];
//! let second_arm = &observation[layout.observation_of(ArmIndex(1))];
//! assert_eq!(second_arm.len(), layout.single_arm().n_observation());
//! ```
//!
//! # Rewards
//!
//! The [`reward`] of a step is sparse: in the built-in tasks, 0 if the distance from the goal is at most 5 cm and −1
//! otherwise. One function serves success rates and hindsight relabelling alike.
//!
//! ```
//! use tandem_core::reward::{REWARD_ACHIEVED, REWARD_PENDING, sparse_reward};
//!
//! let goal = [0.10, 0.05, 0.02];
//! assert_eq!(sparse_reward(&[0.11, 0.05, 0.02], &goal), REWARD_ACHIEVED);
//! assert_eq!(sparse_reward(&[0.20, 0.05, 0.02], &goal), REWARD_PENDING);
//! ```
//!
//! # Random numbers
//!
//! [`episode_rng`] is the only way to create a generator. It takes the run's seed, the episode's number and the
//! [`Stream`], so an episode repeats on any worker and any thread.
//!
//! ```
//! use tandem_core::{Stream, episode_rng, rng};
//!
//! let mut first = episode_rng(7, 3, Stream::Exploration);
//! let mut second = episode_rng(7, 3, Stream::Exploration);
//! assert_eq!(rng::uniform(&mut first, -1.0, 1.0), rng::uniform(&mut second, -1.0, 1.0));
//! ```
//!
//! # Episodes and evaluations
//!
//! Workers return whole [`Episode`]s. An [`EpisodeOutcome`] is derived from an episode's transitions, and an
//! [`EvaluationSummary`] aggregates outcomes into rates with [`Wilson`] intervals.
//!
//! ```
//! use tandem_core::layout::EPISODE_STEPS;
//! use tandem_core::{Contacts, Episode, EpisodeKind, EpisodeOutcome, EvaluationSummary, Layout, Task};
//!
//! let layout = Layout::new(Task::Push, 1);
//! let episode = Episode {
//!     number: 0,
//!     kind: EpisodeKind::Evaluation,
//!     parameter_version: 0,
//!     task: layout.into(),
//!     observations: vec![0.0; (EPISODE_STEPS + 1) * layout.n_observation()],
//!     goal: vec![0.0, 0.0, 0.02],
//!     actions: vec![0.0; EPISODE_STEPS * layout.n_action()],
//!     advised_arms: vec![0; EPISODE_STEPS],
//!     contacts: vec![Contacts::NONE; EPISODE_STEPS],
//!     advice_charged: 0,
//!     avoidance_steps: None,
//!     queried_steps: None,
//! };
//! let summary = EvaluationSummary::of(&[EpisodeOutcome::of(&episode)]);
//! assert_eq!(summary.success, 1.0);
//! assert!(summary.interval.low < 0.3, "one episode proves little");
//! ```
//!
//! # Modules in reading order
//!
//! [`task`], [`layout`] (the built-in tasks), [`reward`], [`rng`], [`episode`], [`evaluation`]; then [`settings`] and
//! [`work`] (what a learner assigns to workers), [`strategy`] (the names of the strategies), [`advice`] (queries to a
//! teacher and its answers), [`bounds`] (plausible ranges of observations), [`scene`] (snapshots for pictures and logs)
//! and [`text`] (texts in messages).
#![warn(missing_docs)]

pub mod advice;
pub mod bounds;
pub mod episode;
pub mod evaluation;
pub mod layout;
pub mod reward;
pub mod rng;
pub mod scene;
pub mod settings;
pub mod strategy;
pub mod task;
pub mod text;
pub mod work;

pub use advice::{ArmAdvice, StepAdvice, StepQuery};
pub use episode::{Contacts, Episode, EpisodeKind};
pub use evaluation::{EpisodeOutcome, EvaluationSummary, Wilson};
pub use layout::{ArmIndex, Layout, Task, World};
pub use rng::{Stream, episode_rng};
pub use settings::{AdviceTerms, AdviceUnit, Exploration, JudgedAction, WorldSettings};
pub use strategy::{Strategy, UnknownStrategy};
pub use task::{TaskDescription, TaskSpec};
